"""Reading of a graph: blocks, and affine functions of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, prod
from typing import TypeAlias

import numpy as np

from loopwright.pipeline.export.fusion.affine import Affine, Array, Attributes, Shape


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
    wide: Value | None = None


@dataclass(eq=False)
class Value:
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


Operand: TypeAlias = Value | Array | None
"""Input of an operator: a value, a constant, or left out."""


def picked(value: Value) -> tuple[int, Array] | None:
    """The one block of which a value is a selection, and the elements' places in it, of the value's shape."""
    affine = value.affine
    if affine is None or len(affine.parts) != 1 or affine.constant.any():
        return None
    ((number, matrix),) = affine.parts.items()
    if np.count_nonzero(matrix) != prod(affine.shape) or not (matrix.max(axis=0, initial=0) == 1).all():
        return None
    return number, np.asarray(matrix.argmax(axis=0))


def whole(value: Value, block: Block) -> bool:
    """Whether a value is all of a block, perhaps in another shape."""
    found = picked(value)
    return (
        found is not None
        and found[0] == block.number
        and found[1].size == prod(block.shape)
        and bool((found[1].ravel() == np.arange(found[1].size)).all())
    )
