"""Work of one step, known before anything runs: the shapes of all values from the constants and the inputs.

A graph with static shapes has a fixed cost. The file's statements on shapes in between are not used: each operator's
result follows from its inputs by the rules of ONNX, opset 18 to 21. An operator whose result's shape is computed in the
graph itself is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from math import prod
from typing import TypeAlias

from loopwright.serving.graph.operators import require_signature

Shape: TypeAlias = tuple[int, ...]

FLOAT, INT32, INT64, BOOL, DOUBLE = 1, 6, 7, 9, 11  # TensorProto.DataType
ITEM_BYTES = {FLOAT: 4, INT32: 4, INT64: 8, BOOL: 1, DOUBLE: 8}
MAX_RANK = 8  # dimensions of a value
# At most 200 ms of ordinary numbers and two seconds of subnormal ones. A predictive law has 1 to 2 million with one
# loop, which take .2 ms, and up to 10 with three.
MAX_WORK = 20_000_000
# An element read or written counts as so many multiply-adds: a power or a cosine takes 10 to 50 ns,
# a multiply-add in a product of matrices .3 to 1 ns.
ELEMENT_WORK = 32
MOVED_WORK = 4  # of an element that is only copied: 1 to 2 ns, whatever its value


@dataclass(frozen=True, slots=True)
class TensorValue:
    """A tensor's shape and element type, and the bytes of a constant."""

    shape: Shape
    dtype: int
    raw: bytes | None = None

    @property
    def size(self) -> int:
        """Number of elements."""
        return prod(self.shape)

    def integers(self) -> list[int]:
        """The numbers of a constant of int64; ValueError if it is no such constant."""
        if self.raw is None:
            raise ValueError("a shape, an axis or a length is computed in the graph; it must be a constant")
        if self.dtype != INT64 or len(self.shape) > 1 or self.size > 1_000:
            raise ValueError("shapes, axes and lengths must be int64 constants of rank 1 and at most 1000 entries")
        return list(struct.unpack(f"<{self.size}q", self.raw))


@dataclass(frozen=True, slots=True)
class Node:
    """An operator: its inputs (None: left out), its attributes, the number of its outputs."""

    op: str
    inputs: tuple[TensorValue | None, ...]
    attributes: Mapping[str, object]
    n_out: int

    @property
    def present(self) -> list[TensorValue]:
        """The inputs that are not left out."""
        return [v for v in self.inputs if v is not None]

    def input(self, i: int) -> TensorValue:
        """Input ``i``; ValueError if it is missing."""
        value = self.optional(i)
        if value is None:
            raise ValueError(f"input {i} is missing")
        return value

    def optional(self, i: int) -> TensorValue | None:
        """Input ``i``, or None where it is left out."""
        return self.inputs[i] if i < len(self.inputs) else None

    def integer(self, name: str, default: int | None = None) -> int:
        """An attribute; ValueError if it is missing or no integer."""
        value = self.attributes.get(name, default)
        if not isinstance(value, int):
            raise ValueError(f"the attribute {name!r} is {value!r}; it must be an integer")
        return value


def results(node: Node) -> tuple[list[TensorValue], int]:
    """The shapes and types of an operator's outputs, and its work in multiply-adds.

    Raises ValueError where the rules of ONNX do not allow the inputs or the attributes.
    """
    require_signature(node.op, [v is not None for v in node.inputs], node.attributes)
    if node.op in FLOAT_ONLY and node.input(0).dtype not in (FLOAT, DOUBLE):
        # An integer divided by -1 may overflow, and the processor then kills the process.
        raise ValueError("it divides integers; cast them to double first")
    shapes = RULES[node.op](node)
    if len(shapes) != node.n_out:
        raise ValueError(f"it has {node.n_out} outputs; it must have {len(shapes)}")
    dtype = _dtype(node)
    values = [TensorValue(shape, dtype) for shape in shapes]
    for shape in shapes:
        if len(shape) > MAX_RANK or max(shape, default=0) > MAX_WORK:
            raise ValueError(f"its result has more than {MAX_RANK} dimensions or one above {MAX_WORK}")
    written = sum(v.size for v in values)
    if node.op in ELEMENTWISE:
        elements = written * (1 + len(node.inputs))
    elif node.op in PRODUCTS:
        elements = written
    else:
        elements = written + sum(v.size for v in node.present)
    work = elements * (MOVED_WORK if node.op in MOVES else ELEMENT_WORK)
    if node.op in PRODUCTS:
        a = node.input(0).shape
        work += written * a[0 if node.op == "Gemm" and node.integer("transA", 0) else -1]
    return values, work


def _dtype(node: Node) -> int:
    """The element type of an operator's outputs."""
    if node.op == "Cast":
        to = node.integer("to")
        if to not in ITEM_BYTES:
            raise ValueError(f"it casts to type {to}; allowed are {', '.join(map(str, ITEM_BYTES))}")
        return to
    if node.op in TO_BOOL:
        return BOOL
    if node.op in ("ArgMax", "ArgMin"):
        return INT64
    return node.input(1 if node.op == "Where" else 0).dtype


# ---------------------------------------------------------------------- rules: a node -> its outputs' shapes
def _axis(axis: int, rank: int) -> int:
    if not -rank <= axis < rank:
        raise ValueError(f"axis {axis} is not within a rank of {rank}")
    return axis % rank


def _axes(axes: list[int], rank: int) -> list[int]:
    found = [_axis(a, rank) for a in axes]
    if len(set(found)) < len(found):
        raise ValueError(f"the axes {axes} name one twice")
    return found


def _broadcast(*shapes: Shape) -> Shape:
    result: Shape = ()
    for shape in shapes:
        pairs = list(zip_longest(reversed(result), reversed(shape), fillvalue=1))
        if any(a != b and 1 not in (a, b) for a, b in pairs):
            raise ValueError(f"the shapes {result} and {shape} do not fit together")
        result = tuple(b if a == 1 else a for a, b in reversed(pairs))
    return result


def _elementwise(node: Node) -> list[Shape]:
    return [_broadcast(node.input(0).shape, *(v.shape for v in node.present))]


def _same(node: Node) -> list[Shape]:
    return [node.input(0).shape]


def _matmul(node: Node) -> list[Shape]:
    a, b = node.input(0).shape, node.input(1).shape
    if not a or not b:
        raise ValueError("it multiplies a scalar")
    left, right = (a if len(a) > 1 else (1, *a)), (b if len(b) > 1 else (*b, 1))
    if left[-1] != right[-2]:
        raise ValueError(f"the shapes {a} and {b} cannot be multiplied")
    batch = _broadcast(left[:-2], right[:-2])
    return [(*batch, *left[-2:-1][: len(a) - 1], *right[-1:][: len(b) - 1])]


def _gemm(node: Node) -> list[Shape]:
    a, b = node.input(0).shape, node.input(1).shape
    if len(a) != 2 or len(b) != 2:
        raise ValueError(f"it multiplies the shapes {a} and {b}; both must have rank 2")
    a, b = (a[::-1] if node.integer("transA", 0) else a), (b[::-1] if node.integer("transB", 0) else b)
    if a[1] != b[0]:
        raise ValueError(f"the shapes {a} and {b} cannot be multiplied")
    return [(a[0], b[1])]


def _reduce(node: Node) -> list[Shape]:
    shape, given = node.input(0).shape, node.optional(1)
    axes = _axes(given.integers(), len(shape)) if given else []
    if not axes and not node.integer("noop_with_empty_axes", 0):
        axes = list(range(len(shape)))
    return [_without(shape, axes, keep=node.integer("keepdims", 1) != 0)]


def _arg(node: Node) -> list[Shape]:
    shape = node.input(0).shape
    return [_without(shape, [_axis(node.integer("axis", 0), len(shape))], keep=node.integer("keepdims", 1) != 0)]


def _without(shape: Shape, axes: list[int], *, keep: bool) -> Shape:
    """The shape with axes of length 1 in place of ``axes``, or without them."""
    if any(shape[a] == 0 for a in axes):
        raise ValueError(f"it reduces an axis of length 0 of the shape {shape}")
    return tuple(1 if i in axes else n for i, n in enumerate(shape) if keep or i not in axes)


def _concat(node: Node) -> list[Shape]:
    first = node.input(0).shape
    axis = _axis(node.integer("axis"), len(first))
    for value in node.present:
        if len(value.shape) != len(first) or any(
            a != b for i, (a, b) in enumerate(zip(first, value.shape, strict=True)) if i != axis
        ):
            raise ValueError(f"the shapes {first} and {value.shape} do not fit together")
    return [(*first[:axis], sum(v.shape[axis] for v in node.present), *first[axis + 1 :])]


def _expand(node: Node) -> list[Shape]:
    return [_broadcast(node.input(0).shape, _lengths(node.input(1)))]


def _lengths(value: TensorValue) -> Shape:
    lengths = value.integers()
    if any(n < 0 for n in lengths):
        raise ValueError(f"the lengths {lengths} hold a negative one")
    return tuple(lengths)


def _flatten(node: Node) -> list[Shape]:
    shape = node.input(0).shape
    axis, rank = node.integer("axis", 1), len(shape)
    if not -rank <= axis <= rank:
        raise ValueError(f"axis {axis} is not within a rank of {rank}")
    axis += rank if axis < 0 else 0
    return [(prod(shape[:axis]), prod(shape[axis:]))]


def _gather(node: Node) -> list[Shape]:
    shape = node.input(0).shape
    axis = _axis(node.integer("axis", 0), len(shape))
    return [(*shape[:axis], *node.input(1).shape, *shape[axis + 1 :])]


def _gather_elements(node: Node) -> list[Shape]:
    return [node.input(1).shape]


def _reshape(node: Node) -> list[Shape]:
    old, new = node.input(0), node.input(1).integers()
    if not node.integer("allowzero", 0):
        if any(n == 0 and i >= len(old.shape) for i, n in enumerate(new)):
            raise ValueError(f"the shape {old.shape} has no length for each 0 of {new}")
        new = [old.shape[i] if n == 0 else n for i, n in enumerate(new)]
    if -1 in new:
        rest = prod(n for n in new if n != -1)
        new = [old.size // rest if n == -1 and rest else n for n in new]
    if any(n < 0 for n in new) or prod(new) != old.size:
        raise ValueError(f"the shape {old.shape} cannot become {new}")
    return [tuple(new)]


def _slice(node: Node) -> list[Shape]:
    shape = node.input(0).shape
    starts, ends = node.input(1).integers(), node.input(2).integers()
    given_axes, given_steps = node.optional(3), node.optional(4)
    axes = _axes(given_axes.integers() if given_axes else list(range(len(starts))), len(shape))
    steps = given_steps.integers() if given_steps else [1] * len(starts)
    if not len(starts) == len(ends) == len(axes) == len(steps) or 0 in steps:
        raise ValueError("its starts, ends, axes and steps differ in number, or a step is zero")
    new = list(shape)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        n = shape[axis]
        start, end = (start + n if start < 0 else start), (end + n if end < 0 else end)
        if step > 0:
            start, end = min(max(start, 0), n), min(max(end, 0), n)
        else:
            start, end = min(max(start, 0), n - 1), min(max(end, -1), n)
        new[axis] = max(0, -((start - end) // step))
    return [tuple(new)]


def _split(node: Node) -> list[Shape]:
    shape, given = node.input(0).shape, node.optional(1)
    axis = _axis(node.integer("axis", 0), len(shape))
    if given:
        lengths = list(_lengths(given))
    else:
        parts = node.integer("num_outputs")
        if parts != node.n_out:
            raise ValueError(f"it has {node.n_out} outputs; its attribute says {parts}")
        each = -(-shape[axis] // parts)
        lengths = [each] * (parts - 1)
        lengths.append(shape[axis] - sum(lengths))
        if lengths[-1] <= 0:  # onnxruntime gives the last part no length of zero
            raise ValueError(f"an axis of {shape[axis]} cannot be split in {parts} parts of {each}")
    if any(n < 0 for n in lengths) or sum(lengths) != shape[axis]:
        raise ValueError(f"the lengths {lengths} are not those of an axis of {shape[axis]}")
    return [(*shape[:axis], n, *shape[axis + 1 :]) for n in lengths]


def _squeeze(node: Node) -> list[Shape]:
    shape, given = node.input(0).shape, node.optional(1)
    axes = _axes(given.integers(), len(shape)) if given else [i for i, n in enumerate(shape) if n == 1]
    if any(shape[a] != 1 for a in axes):
        raise ValueError(f"the axes {axes} of the shape {shape} are not all of length 1")
    return [tuple(n for i, n in enumerate(shape) if i not in axes)]


def _unsqueeze(node: Node) -> list[Shape]:
    shape, given = list(node.input(0).shape), node.input(1).integers()
    for axis in sorted(_axes(given, len(shape) + len(given))):
        shape.insert(axis, 1)
    return [tuple(shape)]


def _tile(node: Node) -> list[Shape]:
    shape, repeats = node.input(0).shape, _lengths(node.input(1))
    if len(repeats) != len(shape):
        raise ValueError(f"it repeats the shape {shape} by {repeats}")
    return [tuple(n * r for n, r in zip(shape, repeats, strict=True))]


def _transpose(node: Node) -> list[Shape]:
    shape = node.input(0).shape
    perm = node.attributes.get("perm", list(range(len(shape)))[::-1])
    if not isinstance(perm, list) or sorted(perm) != list(range(len(shape))):
        raise ValueError(f"the order {perm} is none of the axes of {shape}")
    return [tuple(shape[i] for i in perm)]


# fmt: off
TO_BOOL = frozenset(
    {"And", "Equal", "Greater", "GreaterOrEqual", "IsInf", "IsNaN", "Less", "LessOrEqual", "Not", "Or", "Xor"}
)
ELEMENTWISE = TO_BOOL | {
    "Abs", "Add", "Atan", "Cast", "Ceil", "Clip", "Cos", "Div", "Elu", "Erf", "Exp", "Floor", "HardSigmoid",
    "Identity", "LeakyRelu", "Log", "Max", "Mean", "Min", "Mod", "Mul", "Neg", "Pow", "Reciprocal", "Relu",
    "Round", "Sigmoid", "Sign", "Sin", "Softplus", "Softsign", "Sqrt", "Sub", "Sum", "Tan", "Tanh", "Where",
}
REDUCTIONS = frozenset(
    {
        "ReduceL1", "ReduceL2", "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceProd",
        "ReduceSum", "ReduceSumSquare",
    }
)
MOVES = frozenset(
    {
        "Concat", "Expand", "Flatten", "Gather", "GatherElements", "Reshape", "Slice", "Split", "Squeeze", "Tile",
        "Transpose", "Unsqueeze",
    }
)
# fmt: on
PRODUCTS = frozenset({"MatMul", "Gemm"})
FLOAT_ONLY = frozenset({"Div", "Mod", "Mean", "ReduceMean", "Reciprocal"})
RULES: dict[str, Callable[[Node], list[Shape]]] = {
    **dict.fromkeys(ELEMENTWISE, _elementwise),
    **dict.fromkeys(REDUCTIONS, _reduce),
    **dict.fromkeys(("CumSum", "Softmax"), _same),
    **dict.fromkeys(("ArgMax", "ArgMin"), _arg),
    "MatMul": _matmul,
    "Gemm": _gemm,
    "Concat": _concat,
    "Expand": _expand,
    "Flatten": _flatten,
    "Gather": _gather,
    "GatherElements": _gather_elements,
    "Reshape": _reshape,
    "Slice": _slice,
    "Split": _split,
    "Squeeze": _squeeze,
    "Tile": _tile,
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
}
