"""A graph as blocks (inputs, results of nonlinear operators) and the affine functions of them between these."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import prod
from typing import Any, TypeAlias

import numpy as np
import onnx
from onnx import helper, numpy_helper

from pipeline.export.fusion.affine import DENSE, Affine, Array, Attributes, Shape, applied
from pipeline.export.fusion.prices import price
from serving.graph_audit import graph_values
from serving.onnx_bytes import read_model

Operand: TypeAlias = "Value | Array | None"
DOUBLE = onnx.TensorProto.DOUBLE
# Where an operand may leave the finite numbers; what is made of it may too, but not behind GUARDS.
RISKS = frozenset({"Div", "Log", "Exp", "Pow", "Sqrt", "Reciprocal", "Tan"})
GUARDS = frozenset({"Where", "Clip", "Min", "Max", "Tanh", "Sigmoid", "Softmax", "Sign"})
BROADCASTING = frozenset({"Mul", "Div", "Min", "Max", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Equal"})
OWN = ""  # the name of a value that the graph does not have
GATHERED = 200  # elements of a Where that may be chosen by a Gather, at most


@dataclass(eq=False)
class Block:
    """An input, or an output of an operator that is computed as it stands.

    ``wide`` of a Where on a single condition: its two branches one behind the other, the second
    first, from which a Gather takes one.
    """

    number: int
    name: str
    shape: Shape
    op: str = ""
    operands: list[Operand] = field(default_factory=list)
    attributes: Attributes = field(default_factory=dict)
    level: int = 0
    risky: bool = False
    siblings: list[Block] = field(default_factory=list)  # all outputs of the operator
    wide: Value | None = None


@dataclass(eq=False)
class Value:
    """An affine function of blocks. ``affine`` is None where it is one block, too large for a matrix or no number.

    ``origin``: the operator that gives it first, and its operands.
    """

    number: int
    shape: Shape
    level: int
    affine: Affine | None
    block: Block | None = None
    origin: Origin | None = None


@dataclass(eq=False)
class Origin:
    """The operator that gives a value first: the output at ``place`` of outputs of these ``shapes``."""

    op: str
    operands: list[Operand]
    attributes: Attributes
    shapes: list[Shape]
    place: int = 0


class Reading:
    """The graph, read. ``price_before`` is what its operators cost [ns]."""

    def __init__(self, model: onnx.ModelProto, *, factors: bool = True) -> None:
        graph = model.graph
        found, _ = graph_values(read_model(model.SerializeToString())["graph"])
        self.shapes = {name: v.shape for name, v in found.items()}
        self.types = {name: v.dtype for name, v in found.items()}
        self.blocks: list[Block] = []
        self.values: list[Value] = []
        self._known: dict[Any, Value] = {}
        self._computed: dict[Any, list[Value]] = {}
        self.names: dict[str, Operand] = {"": None}
        self.price_before = 0.0
        self.factors = factors
        for tensor in graph.initializer:
            self.names[tensor.name] = numpy_helper.to_array(tensor)
        for given in graph.input:
            self.names[given.name] = self._of_block(self._block(given.name, self.shapes[given.name]))
        for node in graph.node:
            self._read(node)
        self.outputs = [(o.name, self._operand(o.name)) for o in graph.output]

    def _operand(self, name: str) -> Operand:
        return self.names[name]

    # ------------------------------------------------------------------ values
    def value(self, affine: Affine, origin: Origin | None = None) -> Value:
        """The value of an affine function, the same for equal functions."""
        key = affine.key()
        if key not in self._known:
            level = max((self.blocks[b].level for b in affine.parts), default=-1)
            value = Value(len(self.values), affine.shape, level, affine, None, origin)
            self.values.append(value)
            self._known[key] = value
        return self._known[key]

    def _block(self, name: str, shape: Shape, **more: Any) -> Block:
        block = Block(len(self.blocks), name, shape, **more)
        self.blocks.append(block)
        return block

    def _of_block(self, block: Block) -> Value:
        """The value that is a block."""
        if self.types.get(block.name, DOUBLE) == DOUBLE and 0 < prod(block.shape) ** 2 <= DENSE:
            return self.value(Affine.block(block.number, block.shape))
        value = Value(len(self.values), block.shape, block.level, None, block)
        self.values.append(value)
        return value

    # ------------------------------------------------------------------ operators
    def _read(self, node: onnx.NodeProto) -> None:
        op, names = node.op_type, [n for n in node.output if n]
        attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        operands = [self._operand(n) for n in node.input]
        shapes = [self.shapes[n] for n in names]
        self.price_before += price(op, [self.shapes[n] for n in node.input if n], shapes)
        results = self._affine(op, attributes, operands, names, shapes)
        if results is None:
            results = self._nonlinear(op, attributes, operands, names, shapes)
        for name, result in zip(names, results, strict=True):
            self.names[name] = result

    def _affine(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[Value] | None:
        """The outputs of an operator as affine functions; None where they are not, or have too large matrices."""
        if any(self.types[n] != DOUBLE for n in names):
            return None
        if op == "Where":
            return self._switched(operands, shapes[0])
        if any(isinstance(o, Value) and o.affine is None for o in operands):
            return None
        if not any(isinstance(o, Value) for o in operands):
            return None
        arguments = [o.affine if isinstance(o, Value) else o for o in operands]
        blocks = {b: len(m) for a in arguments if isinstance(a, Affine) for b, m in a.parts.items()}
        if sum(blocks.values()) * max(prod(s) for s in shapes) > DENSE:
            return None
        results = applied(op, attributes, arguments, shapes)
        if results is None:
            return None
        return [self.value(r, Origin(op, operands, attributes, shapes, i)) for i, r in enumerate(results)]

    def _switched(self, operands: list[Operand], shape: Shape) -> list[Value] | None:
        """Where between constants, or a value and zero, by the condition as a number, where that gives the same bits."""
        condition, one, other = operands
        if not isinstance(condition, Value) or prod(shape) ** 2 > DENSE:
            return None
        if isinstance(one, Value) and isinstance(other, np.ndarray) and not other.any():
            return self._kept(condition, one, shape)
        if isinstance(other, Value) and isinstance(one, np.ndarray) and not one.any():
            kept = self._kept(condition, other, shape)
            if kept is None or kept[0].affine is None or other.affine is None:
                return None
            return [self.value(other.affine.spread(shape).plus(kept[0].affine.times(np.array(-1.0))))]
        if not (isinstance(one, np.ndarray) and isinstance(other, np.ndarray)):
            return None
        with np.errstate(invalid="ignore"):
            change = one - other
        if not (other + change == one).all() or not np.isfinite(other).all():
            return None
        cast = self._cast(condition).affine
        assert cast is not None
        return [self.value(cast.spread(shape).times(change).plus(Affine(np.asarray(other), {})))]

    def _kept(self, condition: Value, value: Value, shape: Shape) -> list[Value] | None:
        """A value where the condition holds, else zero: their product, if the value is surely finite."""
        if value.affine is None or self.risky(value):
            return None
        return self._nonlinear("Mul", {}, [value, self._cast(condition)], [OWN], [shape])

    def _cast(self, condition: Value) -> Value:
        """A condition as the number 0 or 1."""
        key = ("Cast", (condition.number,), (("to", str(DOUBLE)),))
        if key not in self._computed:
            self._computed[key] = self._made("Cast", {"to": DOUBLE}, [condition], [OWN], [condition.shape])
        return self._computed[key][0]

    def _nonlinear(
        self, op: str, attributes: Attributes, operands: list[Operand], names: list[str], shapes: list[Shape]
    ) -> list[Value]:
        factor: Array | None = None
        if op in BROADCASTING:
            operands = list(operands)
            for place in range(len(operands)):
                operands[place] = self._narrow(place, operands, shapes[0])
        if self.factors and op in ("Mul", "Div"):
            operands, factor = self._without_factors(op, operands, shapes[0])
        if op in ("Min", "Max"):
            op, operands, attributes = _clip(op, operands, attributes, self.blocks, shapes[0])
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
    ) -> list[Value]:
        """New blocks."""
        used = [o for o in operands if isinstance(o, Value)]
        level = 1 + max((v.level for v in used), default=-1)
        risky = op in RISKS or (op not in GUARDS and any(self.risky(v) for v in used))
        blocks = [
            self._block(n, s, op=op, operands=operands, attributes=attributes, level=level, risky=risky)
            for n, s in zip(names, shapes, strict=True)
        ]
        for block in blocks:
            block.siblings = blocks
        if op == "Where":
            blocks[0].wide = self._wide(operands, shapes[0], names[0])
        return [self._of_block(b) for b in blocks]

    def risky(self, value: Value) -> bool:
        """Whether a value may be infinite or no number while the inputs are finite."""
        if value.affine is None:
            return value.block is not None and value.block.risky
        return any(self.blocks[b].risky for b in value.affine.parts)

    def _wide(self, operands: list[Operand], shape: Shape, name: str) -> Value | None:
        condition, *branches = operands
        if not isinstance(condition, Value) or prod(condition.shape) != 1 or self.types[name] != DOUBLE:
            return None
        n = prod(shape)
        if n > GATHERED:
            return None
        flat, parts = [], 0
        for branch in reversed(branches):
            affine = branch.affine if isinstance(branch, Value) else Affine(np.asarray(branch), {})
            if affine is None:
                return None
            parts += sum(len(m) for m in affine.parts.values())
            flat.append(affine.spread(shape).picked(np.arange(n)))
        if 2 * n * parts > DENSE:
            return None
        joined = applied("Concat", {"axis": 0}, flat, [(2 * n,)])
        assert joined is not None
        pieces: list[Operand] = [self.value(f) if f.parts else f.constant for f in flat]
        return self.value(joined[0], Origin("Concat", pieces, {"axis": 0}, [(2 * n,)]))

    def _narrow(self, place: int, operands: list[Operand], shape: Shape) -> Operand:
        """An operand without the axes of length one, and without the copies, that the operator makes itself."""
        operand = operands[place]
        if not isinstance(operand, Value) or operand.affine is None:
            return operand
        others = [o.shape for i, o in enumerate(operands) if i != place and o is not None]
        if not others:
            return operand
        affine, rest = operand.affine, np.broadcast_shapes(*others)
        if affine.shape == shape == rest and affine.constant.size > 1 and len(affine.parts) == 1:
            same = [a for a in (affine.constant, *affine.parts.values())]
            first = affine.picked(np.zeros((1,) * len(shape), dtype=int))
            if all((a == b).all() for a, b in zip(same, (first.constant, *first.parts.values()), strict=False)):
                affine = first
        origin = operand.origin
        if affine is operand.affine and origin is not None and origin.op in ("Unsqueeze", "Reshape"):
            bare = origin.operands[0]
            if isinstance(bare, Value) and len(rest) == len(shape):
                ones = len(operand.shape) - len(bare.shape)
                if ones > 0 and operand.shape == (1,) * ones + bare.shape:
                    return bare
        return operand if affine is operand.affine else self.value(affine)

    def _without_factors(self, op: str, operands: list[Operand], shape: Shape) -> tuple[list[Operand], Array | None]:
        """The operands of a product or a quotient without constant factors, and the factor of the result."""
        if prod(shape) ** 2 > DENSE:
            return operands, None
        found, factor, any_left = [], np.ones(shape), False
        for i, operand in enumerate(operands):
            stripped = _stripped(operand.affine) if isinstance(operand, Value) and operand.affine is not None else None
            if stripped is None:
                found.append(operand)
                continue
            bare, f = stripped
            any_left = True
            factor = factor / f if op == "Div" and i == 1 else factor * f
            found.append(self.value(bare))
        if not any_left or not np.isfinite(factor).all():
            return operands, None
        return found, factor


def _stripped(affine: Affine) -> tuple[Affine, Array] | None:
    """A multiple of a selection from one block as that selection and the multiples; None if it is nothing of the kind."""
    if len(affine.parts) != 1 or affine.constant.any():
        return None
    ((block, matrix),) = affine.parts.items()
    marks = matrix != 0
    factor = matrix.sum(axis=0)
    if not (marks.sum(axis=0) == 1).all() or (factor == 1).all():
        return None
    return Affine(affine.constant, {block: marks.astype(np.float64)}), factor


def _clip(
    op: str, operands: list[Operand], attributes: Attributes, blocks: list[Block], shape: Shape
) -> tuple[str, list[Operand], Attributes]:
    """Min(Max(x, low), high) with one finite number each as a Clip, which passes on what is not a number as well."""
    unchanged = op, operands, attributes
    outer = _bound(operands)
    if op == "Max" or outer is None:
        return unchanged
    value, high = outer
    if value.affine is None or len(value.affine.parts) != 1 or value.affine.constant.any():
        return unchanged
    ((number, matrix),) = value.affine.parts.items()
    block = blocks[number]
    inner = _bound(block.operands) if block.op == "Max" else None
    if inner is None or matrix.shape != (prod(shape), *shape) or not (matrix.reshape(len(matrix), -1) == np.eye(len(matrix))).all():
        return unchanged
    x, low = inner
    if x.shape != shape or low > high:
        return unchanged
    return "Clip", [x, np.array(low), np.array(high)], {}


def _bound(operands: list[Operand]) -> tuple[Value, float] | None:
    """The value and the number of a Max or Min of a value and one finite number."""
    values = [o for o in operands if isinstance(o, Value)]
    constants = [o for o in operands if isinstance(o, np.ndarray)]
    if len(values) != 1 or len(constants) != 1 or constants[0].size == 0:
        return None
    number = float(constants[0].flat[0])
    return (values[0], number) if np.isfinite(number) and (constants[0] == number).all() else None


def _key(operand: Operand) -> Any:
    if operand is None:
        return None
    if isinstance(operand, Value):
        return operand.number
    return (operand.dtype.str, operand.shape, operand.tobytes())
