"""A graph as blocks (inputs, results of nonlinear operators) and the affine functions of them between these."""

from __future__ import annotations

from math import inf, prod
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from loopwright.pipeline.export.fusion import intervals, reading
from loopwright.pipeline.export.fusion.affine import (
    DENSE,
    Affine,
    AffineValue,
    Array,
    Attributes,
    Block,
    Operand,
    Origin,
    Shape,
    applied,
    numbers,
    whole,
)
from loopwright.pipeline.export.fusion.plan import OUTPUT, price
from loopwright.serving.graph.audit import graph_values
from loopwright.serving.graph.onnx_bytes import read_model

DOUBLE = onnx.TensorProto.DOUBLE
BROADCASTING = frozenset({"Mul", "Div", "Min", "Max", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Equal"})
GATHERED = 200  # elements of a Where that may be chosen by a Gather, at most


# ---------------------------------------------------------------------- Where
def switched(reading: GraphReading, operands: list[Operand], shape: Shape) -> AffineValue | None:
    """Where between constants, or a value and zero, by the condition as 0 or 1, if that gives the same numbers."""
    condition, one, other = operands
    if not isinstance(condition, AffineValue) or prod(shape) ** 2 > DENSE:
        return None
    if isinstance(one, AffineValue) and isinstance(other, np.ndarray) and not other.any():
        return _kept(reading, condition, one, shape)
    if isinstance(other, AffineValue) and isinstance(one, np.ndarray) and not one.any():
        kept = _kept(reading, condition, other, shape)
        if kept is None or kept.affine is None or other.affine is None:
            return None
        return reading.value(other.affine.spread(shape).plus(kept.affine.times(np.array(-1.0))))
    if not (isinstance(one, np.ndarray) and isinstance(other, np.ndarray)):
        return None
    with np.errstate(invalid="ignore"):
        change = one - other
    if not (other + change == one).all() or not np.isfinite(other).all():
        return None
    number = _number(reading, condition).affine
    assert number is not None
    return reading.value(number.spread(shape).times(change).plus(Affine(np.asarray(other), {})))


def _kept(reading: GraphReading, condition: AffineValue, value: AffineValue, shape: Shape) -> AffineValue | None:
    """A value where the condition holds, else zero: their product, if the value is surely finite."""
    if value.affine is None or reading.risky(value):
        return None
    return reading.computed("Mul", {}, [value, _number(reading, condition)], [""], [shape])[0]


def _number(reading: GraphReading, condition: AffineValue) -> AffineValue:
    """A condition as 0 or 1."""
    return reading.computed("Cast", {"to": DOUBLE}, [condition], [""], [condition.shape])[0]


def wide(reading: GraphReading, operands: list[Operand], shape: Shape) -> AffineValue | None:
    """The branches of a Where on a single condition as one vector, the second first; None where it may not be one."""
    condition, *branches = operands
    n = prod(shape)
    if not isinstance(condition, AffineValue) or prod(condition.shape) != 1 or n > GATHERED:
        return None
    flat: list[Affine] = []
    for branch in reversed(branches):
        affine = branch.affine if isinstance(branch, AffineValue) else Affine(np.asarray(branch), {})
        if affine is None:
            return None
        flat.append(affine.spread(shape).picked(np.arange(n)))
    blocks = {b: len(m) for f in flat for b, m in f.parts.items()}
    if 2 * n * sum(blocks.values()) > DENSE:
        return None
    joined = applied("Concat", {"axis": 0}, flat, [(2 * n,)])
    assert joined is not None
    pieces: list[Operand] = [reading.value(f) if f.parts else f.constant for f in flat]
    return reading.value(joined[0], Origin("Concat", pieces, {"axis": 0}, [(2 * n,)]))


# ---------------------------------------------------------------------- operands
def narrowed(reading: GraphReading, op: str, operands: list[Operand], shape: Shape) -> list[Operand]:
    """The operands without the axes of length one, and without the copies, that the operator makes itself."""
    if op not in BROADCASTING:
        return operands
    found = list(operands)
    for place, operand in enumerate(found):
        others = [o.shape for i, o in enumerate(found) if i != place and o is not None]
        if isinstance(operand, AffineValue) and operand.affine is not None and others:
            found[place] = _narrow(reading, operand, operand.affine, np.broadcast_shapes(*others), shape)
    return found


def _narrow(reading: GraphReading, operand: AffineValue, affine: Affine, others: Shape, shape: Shape) -> AffineValue:
    """One operand beside others that broadcast to a shape."""
    if affine.shape == shape == others and affine.constant.size > 1:
        first = affine.picked(np.zeros((1,) * len(shape), dtype=int))
        if len(first.parts) == len(affine.parts) and all(
            (matrix == first.parts[b]).all() for b, matrix in affine.parts.items()
        ):
            return reading.value(first) if (affine.constant == first.constant).all() else operand
    origin = operand.origin
    if origin is not None and origin.op in ("Unsqueeze", "Reshape") and len(others) == len(shape):
        bare = origin.operands[0]
        if isinstance(bare, AffineValue):
            ones = len(operand.shape) - len(bare.shape)
            if ones > 0 and operand.shape == (1,) * ones + bare.shape:
                return bare
    return operand


def without_factors(
    reading: GraphReading, op: str, operands: list[Operand], shape: Shape
) -> tuple[list[Operand], Array | None]:
    """The operands of a Mul or a Div without constant factors, and the factor of the result, None without any."""
    if prod(shape) ** 2 > DENSE:
        return operands, None
    found, factor, changed = list(operands), np.ones(shape), False
    for place, operand in enumerate(operands):
        stripped = (
            _stripped(operand.affine) if isinstance(operand, AffineValue) and operand.affine is not None else None
        )
        if stripped is not None:
            changed = True
            found[place] = reading.value(stripped[0])
            with np.errstate(over="ignore"):
                factor = factor / stripped[1] if op == "Div" and place == 1 else factor * stripped[1]
    if not changed or not np.isfinite(factor).all() or not factor.all():
        return operands, None
    return found, factor


def _stripped(affine: Affine) -> tuple[Affine, Array] | None:
    """A multiple of a selection from one block as the selection and the multiples; None if it is none, or bare."""
    if len(affine.parts) != 1 or affine.constant.any():
        return None
    ((block, matrix),) = affine.parts.items()
    marks = matrix != 0
    factor = matrix.sum(axis=0)
    if not (marks.sum(axis=0) == 1).all() or (factor == 1).all() or not numbers(factor).all():
        return None
    return Affine(affine.constant, {block: marks.astype(np.float64)}), factor


# ---------------------------------------------------------------------- MatMul
def by_vector(reading: GraphReading, operands: list[Operand], shape: Shape) -> AffineValue | None:
    """The product of a matrix and a vector that was made a row or a column for it, by the vector itself."""
    left, right = operands
    if (
        not isinstance(left, AffineValue)
        or not isinstance(right, AffineValue)
        or len(left.shape) != 2
        or len(right.shape) != 2
    ):
        return None
    row, column = _vector(left, (1, left.shape[1])), _vector(right, (right.shape[0], 1))
    if (row is None) == (column is None):
        return None
    inner: list[Operand] = [left if row is None else row, right if column is None else column]
    (product,) = reading.computed("MatMul", {}, inner, [""], [(max(shape),) if 1 in shape else shape])
    if product.affine is None:
        return None
    (spread,) = applied("Reshape", {}, [product.affine, np.array(shape)], [shape]) or (None,)
    return None if spread is None else reading.value(spread, Origin("Reshape", [product, np.array(shape)], {}, [shape]))


def _vector(value: AffineValue, shape: Shape) -> AffineValue | None:
    """The vector that stands behind a row or a column of this shape."""
    origin = value.origin
    if value.shape != shape or origin is None or origin.op not in ("Unsqueeze", "Reshape"):
        return None
    bare = origin.operands[0]
    return bare if isinstance(bare, AffineValue) and len(bare.shape) == 1 else None


# ---------------------------------------------------------------------- Min
def clipped(
    reading: GraphReading, operands: list[Operand], attributes: Attributes, shape: Shape
) -> tuple[str, list[Operand], Attributes]:
    """Min(Max(x, low), high) with one finite number each as a Clip, which passes on what is not a number as well."""
    unchanged = "Min", operands, attributes
    outer = _bound(operands)
    if outer is None or outer[0].affine is None or len(outer[0].affine.parts) != 1:
        return unchanged
    value, high = outer
    block = reading.blocks[next(iter(outer[0].affine.parts))]
    inner = _floor(block) if whole(value, block) else None
    if inner is None or not (inner[0].shape == block.shape == value.shape == shape) or inner[1] > high:
        return unchanged
    return "Clip", [inner[0], np.array(inner[1]), np.array(high)], {}


def _floor(block: Block) -> tuple[AffineValue, float] | None:
    """The value and the number of a block that is max(value, number)."""
    if block.op == "Relu":
        return (block.operands[0], 0.0) if isinstance(block.operands[0], AffineValue) else None
    return _bound(block.operands) if block.op == "Max" else None


def _bound(operands: list[Operand]) -> tuple[AffineValue, float] | None:
    """The value and the number of a Max or Min of a value and one finite number."""
    values = [o for o in operands if isinstance(o, AffineValue)]
    constants = [o for o in operands if isinstance(o, np.ndarray)]
    if len(values) != 1 or len(constants) != 1 or constants[0].size == 0:
        return None
    number = float(constants[0].flat[0])
    return (values[0], number) if np.isfinite(number) and (constants[0] == number).all() else None


# ---------------------------------------------------------------------------------------------- the graph that is read
OWN = ""  # the name of a value that the graph does not have; it is a double
# What these give may be infinite or no number, and so may what is made of that, but for what the guards give of it.
RISKS = frozenset({"Div", "Log", "Exp", "Pow", "Sqrt", "Reciprocal", "Tan"})
GUARDS = frozenset({"Where", "Clip", "Min", "Max", "Tanh", "Sigmoid", "Softmax", "Sign"})


class GraphReading:
    """The graph, read. ``price_before`` is what its operators cost [ns]; without ``factors`` products keep theirs.

    ``without_factors`` says whether any product had one to lose, so that the two readings may differ.
    """

    def __init__(self, model: onnx.ModelProto, *, factors: bool) -> None:
        graph = model.graph
        found, _ = graph_values(read_model(model.SerializeToString())["graph"])
        self._shapes = {name: v.shape for name, v in found.items()}
        self._types = {OWN: DOUBLE, **{name: v.dtype for name, v in found.items()}}
        self._factors, self.without_factors = factors, False
        self._known: dict[Any, AffineValue] = {}
        self._computed: dict[Any, list[AffineValue]] = {}
        self._sliced: set[str] = set()
        self.blocks: list[Block] = []
        self.values: list[AffineValue] = []
        self.price_before = 0.0
        self.names: dict[str, Operand] = {"": None}
        for tensor in graph.initializer:
            self.names[tensor.name] = numpy_helper.to_array(tensor)
        for given in graph.input:
            self.names[given.name] = self._of_block(self._block(given.name, self._shapes[given.name]))
        for node in graph.node:
            self._read(node)
        self.outputs = [(o.name, self.names[o.name]) for o in graph.output]

    # ------------------------------------------------------------------ values
    def value(self, affine: Affine, origin: Origin | None = None) -> AffineValue:
        """The value of an affine function, the same for equal functions."""
        key = affine.key()
        if key not in self._known:
            level = max((self.blocks[b].level for b in affine.parts), default=-1)
            self._known[key] = AffineValue(len(self.values), affine.shape, level, affine, None, origin)
            self.values.append(self._known[key])
        return self._known[key]

    def risky(self, value: AffineValue) -> bool:
        """Whether a value may be infinite or no number while the inputs are finite."""
        if value.affine is None:
            return value.block is not None and value.block.risky
        return any(self.blocks[b].risky for b in value.affine.parts)

    def _block(self, name: str, shape: Shape, **more: Any) -> Block:
        block = Block(len(self.blocks), name, shape, **more)
        self.blocks.append(block)
        return block

    def _of_block(self, block: Block) -> AffineValue:
        """The value that is a block."""
        if self._types[block.name] == DOUBLE and 0 < prod(block.shape) ** 2 <= DENSE:
            return self.value(Affine.block(block.number, block.shape))
        value = AffineValue(len(self.values), block.shape, block.level, None, block)
        self.values.append(value)
        return value

    # ------------------------------------------------------------------ operators
    def _read(self, node: onnx.NodeProto) -> None:
        op, names = node.op_type, list(node.output)
        attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        operands = [self.names[n] for n in node.input]
        shapes = [self._shapes[n] for n in names]
        if op == "Slice" and node.input[0] in self._sliced:
            self.price_before += OUTPUT  # onnxruntime makes one Split of them
        else:
            self.price_before += price(op, [self._shapes[n] for n in node.input if n], shapes)
        if op == "Slice":
            self._sliced.add(node.input[0])
        results = self._affine(op, attributes, operands, names, shapes)
        if results is None:
            results = self.computed(op, attributes, operands, names, shapes)
        self.names.update(zip(names, results, strict=True))

    def _affine(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[AffineValue] | None:
        """The outputs of an operator as affine functions; None where they are not, or have too large matrices."""
        if any(self._types[n] != DOUBLE for n in names):
            return None
        if op == "Where":
            switched = reading.switched(self, operands, shapes[0])
            return None if switched is None else [switched]
        if any(isinstance(o, AffineValue) and o.affine is None for o in operands):
            return None
        arguments = [o.affine if isinstance(o, AffineValue) else o for o in operands]
        blocks = {b: len(m) for a in arguments if isinstance(a, Affine) for b, m in a.parts.items()}
        if not blocks or sum(blocks.values()) * max(map(prod, shapes)) > DENSE:
            return None
        results = applied(op, attributes, arguments, shapes)
        if results is None:
            return None
        return [self.value(r, Origin(op, operands, attributes, shapes, i)) for i, r in enumerate(results)]

    def computed(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[AffineValue]:
        """The outputs of an operator that is computed as it stands, the same for equal ones."""
        factor: Array | None = None
        operands = reading.narrowed(self, op, operands, shapes[0])
        if op == "MatMul":
            found = reading.by_vector(self, operands, shapes[0])
            if found is not None:
                return [found]
        if self._factors and op in ("Mul", "Div"):
            known = len(self.values)
            operands, factor = reading.without_factors(self, op, operands, shapes[0])
            self.without_factors |= factor is not None or len(self.values) > known
        if op == "Min":
            op, operands, attributes = reading.clipped(self, operands, attributes, shapes[0])
        key = (op, tuple(map(_key, operands)), tuple(sorted((k, str(v)) for k, v in attributes.items())))
        if key not in self._computed:
            self._computed[key] = self._made(op, attributes, operands, names, shapes)
        results = self._computed[key]
        if factor is None:
            return results
        affine = results[0].affine
        assert affine is not None
        return [self.value(affine.times(factor))]

    def _made(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[AffineValue]:
        """New blocks."""
        used = [o for o in operands if isinstance(o, AffineValue)]
        level = 1 + max((v.level for v in used), default=-1)
        given = [intervals.interval(o, self.blocks) for o in operands]
        risky = op in RISKS and not intervals.finite(op, given)
        risky = risky or (op not in GUARDS and any(map(self.risky, used)))
        low, high = intervals.bounds(op, operands, given)
        blocks = [self._block(n, s, op=op, level=level, risky=risky) for n, s in zip(names, shapes, strict=True)]
        for block in blocks:
            block.operands, block.attributes, block.siblings = operands, attributes, blocks
            block.low, block.high = (-inf, inf) if risky else (low, high)
        if op == "Where" and self._types[names[0]] == DOUBLE:
            blocks[0].wide = reading.wide(self, operands, shapes[0])
        return [self._of_block(b) for b in blocks]


def _key(operand: Operand) -> Any:
    if operand is None:
        return None
    if isinstance(operand, AffineValue):
        return operand.number
    return (operand.dtype.str, operand.shape, operand.tobytes())
