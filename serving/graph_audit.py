"""What a controller's graph may hold, read from the file's bytes without the onnx package.

A controller runs at a fixed cost with nothing outside its file: no loops or branches, no external
tensors, no functions, only operators of the list. ONNX is a protobuf, so a walker over its wire
format is enough to prove that before any runtime touches the bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from serving.errors import ArtifactError

MAX_BYTES = 64 * 2**20
MAX_NODES = 20_000
MAX_IR = 10  # newer ones fail to load in today's runtimes
MAX_OPSET = 21

# fmt: off
ALLOWED_OPS = frozenset(
    {
        # elementwise
        "Abs", "Add", "Atan", "Cast", "Ceil", "Clip", "Cos", "Div", "Elu", "Erf", "Exp", "Floor",
        "HardSigmoid", "Identity", "LeakyRelu", "Log", "Max", "Mean", "Min", "Mod", "Mul", "Neg", "Pow",
        "Reciprocal", "Relu", "Round", "Sigmoid", "Sign", "Sin", "Softplus", "Softsign", "Sqrt", "Sub", "Sum",
        "Tan", "Tanh", "Where",
        # comparisons and logic
        "And", "Equal", "Greater", "GreaterOrEqual", "IsInf", "IsNaN", "Less", "LessOrEqual", "Not", "Or",
        "Xor",
        # linear algebra and reductions
        "ArgMax", "ArgMin", "CumSum", "Gemm", "MatMul", "ReduceL1", "ReduceL2", "ReduceLogSumExp",
        "ReduceMax", "ReduceMean", "ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare", "Softmax",
        # shape
        "Concat", "Expand", "Flatten", "Gather", "GatherElements", "Reshape", "Slice", "Split", "Squeeze",
        "Tile", "Transpose", "Unsqueeze",
    }
)
# fmt: on


@dataclass(frozen=True, slots=True)
class GraphSummary:
    """What the walker saw: versions, operators with their counts, and the file's metadata."""

    ir_version: int
    opset: int
    ops: dict[str, int]
    metadata: dict[str, str]

    @property
    def nodes(self) -> int:
        """Number of operators in the graph."""
        return sum(self.ops.values())


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (field number, integer or bytes) of one protobuf message; ValueError if malformed."""
    at, end = 0, len(data)

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            if at >= end or shift > 63:
                raise ValueError("a number runs past its message")
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7

    while at < end:
        key = varint()
        wire = key & 7
        if wire == 0:
            yield key >> 3, varint()
            continue
        if wire not in (1, 2, 5):
            raise ValueError(f"wire type {wire} is not in use")
        size = {1: 8, 5: 4}.get(wire) or varint()
        if at + size > end:
            raise ValueError("a field runs past its message")
        yield key >> 3, data[at : at + size]
        at += size


def _children(message: int | memoryview, number: int) -> Iterator[memoryview]:
    if isinstance(message, int):
        raise ValueError("a number stands where a message belongs")
    for key, value in _fields(message):
        if key == number:
            if isinstance(value, int):
                raise ValueError("a number stands where a message belongs")
            yield value


def _text(message: memoryview, number: int) -> str:
    return b"".join(bytes(v) for v in _children(message, number)).decode()


def _integer(message: memoryview, number: int) -> int:
    return next((v for k, v in _fields(message) if k == number and isinstance(v, int)), 0)


def _audit_tensor(tensor: memoryview) -> None:
    # TensorProto: external_data = 13, data_location = 14 (1: external)
    if any(True for _ in _children(tensor, 13)) or _integer(tensor, 14):
        raise ArtifactError(f"tensor {_text(tensor, 8)!r} lies outside the file; a controller is one file")


def _audit_node(node: memoryview) -> str:
    # NodeProto: op_type = 4, attribute = 5, domain = 7; AttributeProto: t = 5, g = 6, graphs = 11
    op, domain = _text(node, 4), _text(node, 7)
    if domain not in ("", "ai.onnx") or op not in ALLOWED_OPS:
        name = f"{domain}.{op}" if domain else op
        raise ArtifactError(f"operator {name} is not on the list of what a controller may compute")
    for attribute in _children(node, 5):
        for key, value in _fields(attribute):
            if key in (6, 11):
                raise ArtifactError(f"operator {op} holds a subgraph; a controller has a fixed cost")
            if key == 5 and isinstance(value, memoryview):
                _audit_tensor(value)
    return op


def audit(data: bytes) -> GraphSummary:
    """The summary of an ONNX file's bytes; ArtifactError where a controller may not look so.

    Refused: a file over 64 MiB, a malformed protobuf, IR above 10 or opset above 21, an operator
    off the list, a subgraph, a function, training data, sparse or external tensors.
    """
    if len(data) > MAX_BYTES:
        raise ArtifactError(f"the file has {len(data)} bytes; a controller has at most {MAX_BYTES}")
    ops: Counter[str] = Counter()
    metadata: dict[str, str] = {}
    ir = opset = graphs = 0
    try:
        # ModelProto: ir_version = 1, graph = 7, opset_import = 8, metadata_props = 14,
        # training_info = 20, functions = 25
        for key, value in _fields(memoryview(data)):
            if isinstance(value, int):
                ir = value if key == 1 else ir
            elif key == 7:
                graphs += 1
                for inner, item in _fields(value):
                    # GraphProto: node = 1, initializer = 5, sparse_initializer = 15
                    if isinstance(item, int):
                        continue
                    if inner == 1:
                        ops[_audit_node(item)] += 1
                    elif inner == 5:
                        _audit_tensor(item)
                    elif inner == 15:
                        raise ArtifactError("the graph holds sparse tensors, which a controller may not")
            elif key == 8 and _text(value, 1) in ("", "ai.onnx"):
                opset = _integer(value, 2)
            elif key == 14:
                metadata[_text(value, 1)] = _text(value, 2)
            elif key in (20, 25):
                raise ArtifactError("the file holds functions or training data, which a controller may not")
    except (ValueError, UnicodeDecodeError) as error:
        raise ArtifactError(f"the file is not an ONNX model: {error}") from error
    if graphs != 1:
        raise ArtifactError(
            "the file is not an ONNX model: it has no graph" if not graphs else "the file has two graphs"
        )
    if not 1 <= ir <= MAX_IR or not 1 <= opset <= MAX_OPSET:
        raise ArtifactError(f"IR {ir}, opset {opset}: this runtime reads IR up to {MAX_IR}, opset up to {MAX_OPSET}")
    if ops.total() > MAX_NODES:
        raise ArtifactError(f"the graph has {ops.total()} operators; a controller has at most {MAX_NODES}")
    return GraphSummary(ir, opset, dict(ops.most_common()), metadata)
