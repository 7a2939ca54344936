"""Bounds of what a graph computes from finite inputs, whatever they are: enough to see that a divisor is positive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf, sqrt
from typing import TypeAlias

import numpy as np

from loopwright.pipeline.export.fusion.affine import AffineValue, Array, Block, Operand

Interval: TypeAlias = tuple[float, float]
ALL: Interval = (-inf, inf)
LARGEST_POWER = 700.0  # of e that is finite
MOVES = frozenset(
    {
        "Reshape", "Squeeze", "Unsqueeze", "Flatten", "Identity", "Expand", "Tile", "Transpose", "Gather", "Slice",
        "Split", "ReduceMax", "ReduceMin", "ReduceMean",
    }
)  # fmt: skip
FIXED: dict[str, Interval] = {
    "Tanh": (-1.0, 1.0), "Sigmoid": (0.0, 1.0), "Softmax": (0.0, 1.0), "Sign": (-1.0, 1.0), "Exp": (0.0, inf)
}  # fmt: skip


def interval(operand: Operand, blocks: Sequence[Block]) -> Interval:
    """Bounds of all elements of an operand."""
    if operand is None:
        return ALL
    if not isinstance(operand, AffineValue):
        return (float(np.min(operand)), float(np.max(operand))) if operand.size else ALL
    if operand.affine is None:
        return ALL if operand.block is None else (operand.block.low, operand.block.high)
    low, high = operand.affine.constant, operand.affine.constant
    with np.errstate(invalid="ignore"):  # of an infinite constant and a block without bounds
        for number, matrix in operand.affine.parts.items():
            up, down = np.maximum(matrix, 0).sum(axis=0), np.minimum(matrix, 0).sum(axis=0)
            low = low + _times(up, blocks[number].low) + _times(down, blocks[number].high)
            high = high + _times(up, blocks[number].high) + _times(down, blocks[number].low)
    low, high = np.where(np.isnan(low), -inf, low), np.where(np.isnan(high), inf, high)
    return float(np.min(low, initial=inf)), float(np.max(high, initial=-inf))


def _times(weights: Array, bound: float) -> Array:
    """Weights times a bound, where zero times infinity is zero."""
    return np.multiply(weights, bound, out=np.zeros_like(weights), where=weights != 0)


def bounds(op: str, operands: Sequence[Operand], given: Sequence[Interval]) -> Interval:
    """Bounds of what an operator gives, by those of its operands."""
    if op in FIXED:
        return FIXED[op]
    if op == "Cast":
        return (0.0, 1.0) if given[0] == ALL else given[0]  # of a condition; of a number its bounds
    if op in MOVES:
        return given[0]
    rule = RULES.get(op)
    if rule is not None:
        return rule(given)
    if op == "Mul":
        return (max(given[0][0], 0.0) ** 2, inf) if operands[0] is operands[1] else _product(given)
    return ALL


def finite(op: str, given: Sequence[Interval]) -> bool:
    """Whether an operator gives finite numbers for finite operands within their bounds."""
    if op == "Div":
        return given[1][0] > 0
    if op == "Sqrt":
        return given[0][0] >= 0
    if op == "Log":
        return given[0][0] > 0
    return op == "Exp" and given[0][1] < LARGEST_POWER


def _quotient(given: Sequence[Interval]) -> Interval:
    (low, high), (least, most) = given
    return (low / most, high / least) if low >= 0 and least > 0 else ALL


def _product(given: Sequence[Interval]) -> Interval:
    (a, b), (c, d) = given
    return (a * c, inf if inf in (b, d) else b * d) if a >= 0 and c >= 0 else ALL


RULES: dict[str, Callable[[Sequence[Interval]], Interval]] = {
    "Abs": lambda g: (0.0, max(abs(g[0][0]), abs(g[0][1]))),
    "Relu": lambda g: (max(g[0][0], 0.0), max(g[0][1], 0.0)),
    "Sqrt": lambda g: (sqrt(max(g[0][0], 0.0)), inf),
    "Max": lambda g: (max(low for low, _ in g), max(high for _, high in g)),
    "Min": lambda g: (min(low for low, _ in g), min(high for _, high in g)),
    "Clip": lambda g: (g[1][0], g[2][1]) if len(g) == 3 else ALL,
    "Where": lambda g: (min(g[1][0], g[2][0]), max(g[1][1], g[2][1])),
    "Concat": lambda g: (min(low for low, _ in g), max(high for _, high in g)),
    "Add": lambda g: (g[0][0] + g[1][0], g[0][1] + g[1][1]),
    "ReduceSum": lambda g: (max(g[0][0], 0.0), inf) if g[0][0] >= 0 else ALL,
    "Div": _quotient,
}
