"""Nonlinear operators in the form that leaves the least to compute."""

from __future__ import annotations

from math import prod
from typing import TYPE_CHECKING

import numpy as np
import onnx

from loopwright.pipeline.export.fusion.affine import DENSE, Affine, Array, Attributes, Shape, applied, numbers
from loopwright.pipeline.export.fusion.values import Block, Operand, Origin, Value, whole

if TYPE_CHECKING:
    from loopwright.pipeline.export.fusion.reading import Reading

DOUBLE = onnx.TensorProto.DOUBLE
BROADCASTING = frozenset({"Mul", "Div", "Min", "Max", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Equal"})
GATHERED = 200  # elements of a Where that may be chosen by a Gather, at most


# ---------------------------------------------------------------------- Where
def switched(reading: Reading, operands: list[Operand], shape: Shape) -> Value | None:
    """Where between constants, or a value and zero, by the condition as 0 or 1, if that gives the same numbers."""
    condition, one, other = operands
    if not isinstance(condition, Value) or prod(shape) ** 2 > DENSE:
        return None
    if isinstance(one, Value) and isinstance(other, np.ndarray) and not other.any():
        return _kept(reading, condition, one, shape)
    if isinstance(other, Value) and isinstance(one, np.ndarray) and not one.any():
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


def _kept(reading: Reading, condition: Value, value: Value, shape: Shape) -> Value | None:
    """A value where the condition holds, else zero: their product, if the value is surely finite."""
    if value.affine is None or reading.risky(value):
        return None
    return reading.computed("Mul", {}, [value, _number(reading, condition)], [""], [shape])[0]


def _number(reading: Reading, condition: Value) -> Value:
    """A condition as 0 or 1."""
    return reading.computed("Cast", {"to": DOUBLE}, [condition], [""], [condition.shape])[0]


def wide(reading: Reading, operands: list[Operand], shape: Shape) -> Value | None:
    """The branches of a Where on a single condition as one vector, the second first; None where it may not be one."""
    condition, *branches = operands
    n = prod(shape)
    if not isinstance(condition, Value) or prod(condition.shape) != 1 or n > GATHERED:
        return None
    flat: list[Affine] = []
    for branch in reversed(branches):
        affine = branch.affine if isinstance(branch, Value) else Affine(np.asarray(branch), {})
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
def narrowed(reading: Reading, op: str, operands: list[Operand], shape: Shape) -> list[Operand]:
    """The operands without the axes of length one, and without the copies, that the operator makes itself."""
    if op not in BROADCASTING:
        return operands
    found = list(operands)
    for place, operand in enumerate(found):
        others = [o.shape for i, o in enumerate(found) if i != place and o is not None]
        if isinstance(operand, Value) and operand.affine is not None and others:
            found[place] = _narrow(reading, operand, operand.affine, np.broadcast_shapes(*others), shape)
    return found


def _narrow(reading: Reading, operand: Value, affine: Affine, others: Shape, shape: Shape) -> Value:
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
        if isinstance(bare, Value):
            ones = len(operand.shape) - len(bare.shape)
            if ones > 0 and operand.shape == (1,) * ones + bare.shape:
                return bare
    return operand


def without_factors(
    reading: Reading, op: str, operands: list[Operand], shape: Shape
) -> tuple[list[Operand], Array | None]:
    """The operands of a Mul or a Div without constant factors, and the factor of the result, None without any."""
    if prod(shape) ** 2 > DENSE:
        return operands, None
    found, factor, changed = list(operands), np.ones(shape), False
    for place, operand in enumerate(operands):
        stripped = _stripped(operand.affine) if isinstance(operand, Value) and operand.affine is not None else None
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
def by_vector(reading: Reading, operands: list[Operand], shape: Shape) -> Value | None:
    """The product of a matrix and a vector that was made a row or a column for it, by the vector itself."""
    left, right = operands
    if not isinstance(left, Value) or not isinstance(right, Value) or len(left.shape) != 2 or len(right.shape) != 2:
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


def _vector(value: Value, shape: Shape) -> Value | None:
    """The vector that stands behind a row or a column of this shape."""
    origin = value.origin
    if value.shape != shape or origin is None or origin.op not in ("Unsqueeze", "Reshape"):
        return None
    bare = origin.operands[0]
    return bare if isinstance(bare, Value) and len(bare.shape) == 1 else None


# ---------------------------------------------------------------------- Min
def clipped(
    reading: Reading, operands: list[Operand], attributes: Attributes, shape: Shape
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


def _floor(block: Block) -> tuple[Value, float] | None:
    """The value and the number of a block that is max(value, number)."""
    if block.op == "Relu":
        return (block.operands[0], 0.0) if isinstance(block.operands[0], Value) else None
    return _bound(block.operands) if block.op == "Max" else None


def _bound(operands: list[Operand]) -> tuple[Value, float] | None:
    """The value and the number of a Max or Min of a value and one finite number."""
    values = [o for o in operands if isinstance(o, Value)]
    constants = [o for o in operands if isinstance(o, np.ndarray)]
    if len(values) != 1 or len(constants) != 1 or constants[0].size == 0:
        return None
    number = float(constants[0].flat[0])
    return (values[0], number) if np.isfinite(number) and (constants[0] == number).all() else None
