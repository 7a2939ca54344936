"""Affine functions of some blocks, and what ONNX's affine operators make of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
Shape: TypeAlias = tuple[int, ...]
Attributes: TypeAlias = Mapping[str, Any]

DENSE = 20_000
"""Numbers in the matrices of a value at most; one with more is computed as its operator says."""
FAINT = 1e-300
"""Stands in a matrix for a zero that the graph multiplies by: the value must still depend on the block, as 0 times what
is no number is none. ``numbers`` gives the zero back."""


def numbers(matrix: Array) -> Array:
    """A matrix as it is computed with."""
    return np.where(np.abs(matrix) < 1e-200, 0.0, matrix)


@dataclass(frozen=True, eq=False)
class Affine:
    """``constant + sum over blocks of block @ matrix``, of some shape.

    ``parts`` maps a block's number to its matrix (block size, *shape).
    """

    constant: Array
    parts: dict[int, Array]

    @classmethod
    def block(cls, number: int, shape: Shape) -> Affine:
        """A block itself."""
        n = prod(shape)
        return cls(np.zeros(shape), {number: np.eye(n).reshape(n, *shape)})

    @property
    def shape(self) -> Shape:
        """Shape of the value."""
        return tuple(self.constant.shape)

    def key(self) -> tuple[Any, ...]:
        """Equal for equal functions."""
        parts = tuple((b, (m + 0.0).tobytes()) for b, m in sorted(self.parts.items()))
        return (self.shape, (self.constant + 0.0).tobytes(), parts)

    def only(self, blocks: Sequence[int], *, constant: bool) -> Affine:
        """The terms of some blocks, with or without the constant."""
        kept = {b: m for b, m in self.parts.items() if b in blocks}
        return Affine(self.constant if constant else np.zeros(self.shape), kept)

    def picked(self, index: Array) -> Affine:
        """Elements of the flat value, by an array of their places; what they do not depend on is dropped."""
        parts = {b: np.asarray(m.reshape(len(m), -1)[:, index]) for b, m in self.parts.items()}
        constant = np.asarray(self.constant.reshape(-1)[index])
        if index.size < self.constant.size:
            parts = {b: m for b, m in parts.items() if m.any()}
        return Affine(constant, parts)

    def times(self, factor: Array) -> Affine:
        """Multiplied element by element; the factor may have more elements than the value."""
        wide = self.spread(np.broadcast_shapes(self.shape, factor.shape))
        faint = np.where(factor == 0, FAINT, factor)
        return Affine(np.asarray(wide.constant * factor), {b: np.asarray(m * faint) for b, m in wide.parts.items()})

    def spread(self, shape: Shape) -> Affine:
        """Broadcast to a shape."""
        if shape == self.shape:
            return self
        lead = (1,) * (len(shape) - len(self.shape))
        parts = {
            b: np.broadcast_to(m.reshape(len(m), *lead, *self.shape), (len(m), *shape)) for b, m in self.parts.items()
        }
        return Affine(np.broadcast_to(self.constant, shape), parts)

    def plus(self, other: Affine) -> Affine:
        """The sum; blocks that cancel exactly are dropped."""
        shape = np.broadcast_shapes(self.shape, other.shape)
        a, b = self.spread(shape), other.spread(shape)
        parts = dict(a.parts)
        for block, matrix in b.parts.items():
            if block not in parts:
                parts[block] = matrix
            elif (total := parts[block] + matrix).any():
                parts[block] = total
            else:
                del parts[block]
        return Affine(a.constant + b.constant, parts)


def applied(
    op: str, attributes: Attributes, operands: Sequence[Affine | Array | None], shapes: Sequence[Shape]
) -> list[Affine] | None:
    """The outputs of an operator, of which at least one operand is no constant; None where it is not affine.

    ``shapes`` are those of the outputs.
    """
    first, second = operands[0], operands[1] if len(operands) > 1 else None
    if op in ("Add", "Sub"):
        sign = np.array(-1.0 if op == "Sub" else 1.0)
        return [_affine(first).plus(_affine(second).times(sign) if op == "Sub" else _affine(second))]
    if op == "Neg":
        return [_affine(first).times(np.array(-1.0))]
    if op == "Mul" and (isinstance(first, np.ndarray) or isinstance(second, np.ndarray)):
        value, factor = (second, first) if isinstance(first, np.ndarray) else (first, second)
        return _scaled(_affine(value), np.asarray(factor))
    if op == "Div" and isinstance(second, np.ndarray) and second.all():
        return _scaled(_affine(first), 1 / second)
    if op == "Concat":
        return [_joined([_affine(o) for o in operands], attributes["axis"])]
    if op in ("MatMul", "Gemm"):
        return _product(op, attributes, operands)
    if op == "ReduceSum" and isinstance(first, Affine):
        axes = tuple(int(a) % len(first.shape) for a in second) if isinstance(second, np.ndarray) else None
        keep = bool(attributes.get("keepdims", 1))
        if not axes:
            return None
        parts = {b: m.sum(axis=tuple(a + 1 for a in axes), keepdims=keep) for b, m in first.parts.items()}
        return [Affine(np.asarray(first.constant.sum(axis=axes, keepdims=keep)), parts)]
    if isinstance(first, Affine) and all(isinstance(o, np.ndarray) or o is None for o in operands[1:]):
        places = places_of(op, attributes, np.arange(prod(first.shape)).reshape(first.shape), operands[1:], shapes)
        return None if places is None else [first.picked(p) for p in places]
    return None


def _affine(value: Affine | Array | None) -> Affine:
    assert value is not None
    return Affine(np.asarray(value, dtype=np.float64), {}) if isinstance(value, np.ndarray) else value


def _scaled(value: Affine, factor: Array) -> list[Affine] | None:
    return [value.times(factor)] if np.isfinite(factor).all() else None


def _joined(values: Sequence[Affine], axis: int) -> Affine:
    axis %= len(values[0].shape)
    parts: dict[int, Array] = {}
    for block, n in {b: len(m) for v in values for b, m in v.parts.items()}.items():
        pieces = [v.parts.get(block, np.zeros((n, *v.shape))) for v in values]
        parts[block] = np.concatenate(pieces, axis=axis + 1)
    return Affine(np.concatenate([v.constant for v in values], axis=axis), parts)


def _product(op: str, attributes: Attributes, operands: Sequence[Affine | Array | None]) -> list[Affine] | None:
    """A product with a constant matrix."""
    a, b = operands[0], operands[1]
    if not (isinstance(a, np.ndarray) or isinstance(b, np.ndarray)):
        return None
    if op == "MatMul":
        if isinstance(a, Affine) and isinstance(b, np.ndarray) and b.ndim <= 2:
            parts = {k: np.asarray(m @ b) for k, m in a.parts.items()}
            return [Affine(np.asarray(a.constant @ b), parts)]
        return None
    if attributes.get("transA", 0) or not isinstance(a, Affine) or not isinstance(b, np.ndarray):
        return None
    matrix = attributes.get("alpha", 1.0) * (b.T if attributes.get("transB", 0) else b)
    parts = {k: np.asarray(m @ matrix) for k, m in a.parts.items()}
    product = Affine(np.asarray(a.constant @ matrix), parts)
    if len(operands) < 3 or operands[2] is None:
        return [product]
    return [product.plus(_affine(operands[2]).times(np.array(attributes.get("beta", 1.0))))]


def places_of(
    op: str, attributes: Attributes, index: Array, more: Sequence[Any], shapes: Sequence[Shape]
) -> list[Array] | None:
    """Where the elements of an operator's outputs come from; None if it does more than move them."""
    if op in ("Reshape", "Squeeze", "Unsqueeze", "Flatten", "Identity"):
        return [index.reshape(shapes[0])]
    if op == "Expand":
        return [np.broadcast_to(index, shapes[0])]
    if op == "Tile":
        return [np.tile(index, more[0])]
    if op == "Transpose":
        return [index.transpose(attributes.get("perm"))]
    if op == "Gather":
        return [np.take(index, more[0], axis=attributes.get("axis", 0))]
    if op == "Slice":
        axes = more[2] if len(more) > 2 and more[2] is not None else range(len(more[0]))
        steps = more[3] if len(more) > 3 and more[3] is not None else [1] * len(more[0])
        cut = [slice(None)] * index.ndim
        for start, end, axis, step in zip(more[0], more[1], axes, steps, strict=True):
            if step < 0:
                return None
            cut[axis] = slice(int(start), int(end), int(step))
        return [index[tuple(cut)]]
    if op == "Split":
        axis = attributes.get("axis", 0)
        ends = np.cumsum([s[axis] for s in shapes])[:-1]
        return list(np.split(index, ends, axis=axis))
    return None


@dataclass(eq=False)
class Block:
    """An input, or an output of an operator that is computed as it stands.

    ``level``: one more than that of all that it depends on, 0 for an input. ``risky``: it may be
    infinite or no number while the inputs are finite. ``low`` and ``high``: bounds of its elements.
    ``siblings``: all outputs of its operator. ``wide`` of a Where on a single condition: its two
    branches as one vector, the second first, from which a Gather can take one.
    """

    number: int
    name: str
    shape: Shape
    op: str = ""
    operands: list[Operand] = field(default_factory=list)
    attributes: Attributes = field(default_factory=dict)
    level: int = 0
    risky: bool = False
    low: float = -inf
    high: float = inf
    siblings: list[Block] = field(default_factory=list)
    wide: AffineValue | None = None


@dataclass(eq=False)
class AffineValue:
    """An affine function of blocks, at the level of the latest.

    ``affine`` is None where the value is one block that is too large for a matrix, or holds no
    numbers; ``block`` is that block then. Numbers ascend: an operator's operands come before it.
    """

    number: int
    shape: Shape
    level: int
    affine: Affine | None
    block: Block | None = None
    origin: Origin | None = None


@dataclass(eq=False)
class Origin:
    """The operator that gives a value first: output ``place`` of outputs of these ``shapes``."""

    op: str
    operands: list[Operand]
    attributes: Attributes
    shapes: list[Shape]
    place: int = 0


Operand: TypeAlias = AffineValue | Array | None
"""Input of an operator: a value, a constant, or left out."""


def picked(value: AffineValue) -> tuple[int, Array] | None:
    """The one block of which a value is a selection, and the elements' places in it, of the value's shape."""
    affine = value.affine
    if affine is None or len(affine.parts) != 1 or affine.constant.any():
        return None
    ((number, matrix),) = affine.parts.items()
    if np.count_nonzero(matrix) != prod(affine.shape) or not (matrix.max(axis=0, initial=0) == 1).all():
        return None
    return number, np.asarray(matrix.argmax(axis=0))


def whole(value: AffineValue, block: Block) -> bool:
    """Whether a value is all of a block, perhaps in another shape."""
    found = picked(value)
    return (
        found is not None
        and found[0] == block.number
        and found[1].size == prod(block.shape)
        and bool((found[1].ravel() == np.arange(found[1].size)).all())
    )
