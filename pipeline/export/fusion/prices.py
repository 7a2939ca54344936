"""Price of an operator in onnxruntime on one core [ns]: measured on rows of equal operators, rounded."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

from loopwright.pipeline.export.fusion.affine import Shape

DEAR = frozenset({"Tanh", "Log", "Exp", "Sigmoid", "Softmax", "Pow"})
FIXED = {
    "Concat": 90.0, "Split": 95.0, "Gather": 205.0, "Slice": 375.0, "Reshape": 235.0, "Unsqueeze": 220.0,
    "Squeeze": 220.0, "Cast": 130.0, "Where": 665.0, "Clip": 200.0, "ReduceSum": 385.0, "ReduceSumSquare": 385.0,
    "Transpose": 240.0, "Tile": 300.0, "Expand": 300.0, "Identity": 100.0, "Neg": 160.0, "Relu": 170.0, "And": 145.0,
}  # fmt: skip
INPUT, OUTPUT = 90.0, 155.0  # of a Concat, of a Split
PRODUCT, MULTIPLY_ADD, LARGE, BATCHED = 415.0, 0.21, 0.35, 0.4
LARGE_FROM = 4_000  # multiply-adds


def price(op: str, inputs: Sequence[Shape], outputs: Sequence[Shape]) -> float:
    """Price of one operator. Shapes of its inputs that are no settings (axes, lengths) come first."""
    n = sum(prod(s) for s in outputs)
    if op in ("MatMul", "Gemm"):
        return product(inputs[0], inputs[1], outputs[0])
    fixed = FIXED.get(op, 200.0)
    if op == "Concat":
        fixed += INPUT * len(inputs)
    elif op == "Split":
        fixed += OUTPUT * len(outputs)
    elif op == "Gather":
        return fixed + 3 * n
    elif op in ("ReduceSum", "ReduceSumSquare"):
        n = prod(inputs[0])
    return fixed + (3.0 if op in DEAR else 0.5) * n


def product(left: Shape, right: Shape, out: Shape) -> float:
    """Price of a MatMul. A single column costs as much as eight."""
    columns = right[-1] if len(right) > 1 else 1
    inner = left[-1]
    rows = max(1, prod(out) // max(columns, 1))
    work = rows * inner * -(-columns // 8) * 8
    each = (LARGE if work > LARGE_FROM else MULTIPLY_ADD) * (BATCHED if rows > 1 else 1.0)
    return PRODUCT + each * work
