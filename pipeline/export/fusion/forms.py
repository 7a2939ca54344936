"""The ways in which a value can be computed.

No two of them can depend on each other, whatever is chosen: each depends on blocks of the value's level or below, on
values of a lower level, or on values of its level that come before it in the graph or have no operator of their own.
"""

from __future__ import annotations

from itertools import pairwise
from math import prod

import numpy as np

from loopwright.pipeline.export.fusion.affine import (
    DENSE,
    Affine,
    AffineValue,
    Array,
    Operand,
    Origin,
    Shape,
    numbers,
    picked,
    places_of,
)
from loopwright.pipeline.export.fusion.items import Items
from loopwright.pipeline.export.fusion.plan import Input, Item

ELEMENTWISE_BLOCKS = 3  # blocks of an elementwise form at most
RUNS = 8  # pieces of a value put together from runs at most
MOVING = frozenset({"Slice", "Split", "Gather"})


def forms_of(items: Items, value: AffineValue) -> dict[str, Item]:
    """The items that give a value, by the kind of form; at least one."""
    affine = value.affine
    assert affine is not None
    found = {
        "selection": _selection(items, value),
        "elementwise": _sum(items, affine, None),
        "increment": _increment(items, value, affine),
        "segments": _segments(items, value, affine),
        "squares": _squares(items, value),
        "recipe": _recipe(items, value),
        "group": _group(items, value, affine),
        "row": _group(items, value, affine, (1,)) if value.shape[:-1] == (1,) else None,
    }
    kept = {kind: item for kind, item in found.items() if item is not None}
    return kept or {"product": items.member(value, alone=True)}


def _selection(items: Items, value: AffineValue) -> Item | None:
    """Elements of one block."""
    found = picked(value)
    if found is None:
        return None
    number, index = found
    places, source = index.ravel(), items.flat(number)
    if len(places) and (np.diff(places) == 1).all():
        return items.reshaped(items.piece(source, int(places[0]), int(places[-1]) + 1), value.shape)
    return items.step("Gather", [source, index.astype(np.int64)], value.shape, {"axis": 0})


def _sum(items: Items, affine: Affine, start: Item | None) -> Item | None:
    """``start`` plus factors times blocks plus a constant, element by element; None where elements mix."""
    if len(affine.parts) > ELEMENTWISE_BLOCKS:
        return None
    plain, scaled, negative = [], [], []
    for number, matrix in affine.parts.items():
        block = items.reading.blocks[number]
        shape = affine.shape if prod(block.shape) == prod(affine.shape) else block.shape
        factor = _factor(matrix, shape, affine.shape)
        if factor is None or (block.risky and not factor.all()):
            return None  # 0 x inf
        item = items.reshaped(items.block(block), shape)
        same = shape == affine.shape
        if same and (factor == 1).all():
            plain.append(item)
        elif same and (factor == -1).all() and (start is not None or len(affine.parts) > 1):
            negative.append(item)
        else:
            scaled.append(items.step("Mul", [item, factor], affine.shape))
    total: Input = start
    constant = [affine.constant] if affine.constant.any() else []
    terms: list[Input] = [*plain, *scaled, *constant]
    for term in terms:
        total = term if total is None else items.step("Add", [total, term], affine.shape)
    for item in negative:
        if total is None:
            total = items.step("Neg", [item], affine.shape)
        else:
            total = items.step("Sub", [total, item], affine.shape)
    return total if isinstance(total, Item) else None


def _increment(items: Items, value: AffineValue, affine: Affine) -> Item | None:
    """An older value and what the newest blocks add to it."""
    newest = [b for b in affine.parts if items.reading.blocks[b].level == value.level]
    older = [b for b in affine.parts if b not in newest]
    if not older:
        return None
    start = items.of(items.reading.value(affine.only(older, constant=True)))
    assert isinstance(start, Item)
    change = affine.only(newest, constant=False)
    direct = _sum(items, change, start)
    if direct is not None:
        return direct
    added = items.reading.value(change)
    if added.origin is not None and added.number > value.number:
        return None
    return items.step("Add", [start, items.of(added)], value.shape)


def _segments(items: Items, value: AffineValue, affine: Affine) -> Item | None:
    """Runs of elements of one level or one block, put together."""
    if len(value.shape) != 1:
        return None
    level, single, many = np.full(value.shape, -1), np.zeros(value.shape, int), np.zeros(value.shape, int)
    for number, matrix in affine.parts.items():
        uses = matrix.any(axis=0)
        level[uses] = np.maximum(level[uses], items.reading.blocks[number].level)
        many[uses] += 1
        single[uses & (np.count_nonzero(matrix, axis=0) == 1) & (matrix.max(axis=0) == 1)] = number + 1
    single[(many != 1) | (affine.constant != 0)] = 0
    ends = [0, *(np.flatnonzero(np.diff(level) | np.diff(single)) + 1).tolist(), value.shape[0]]
    if len(ends) == 2 or (len(ends) > RUNS + 1 and not items.reading.risky(value)):
        return None
    pieces = []
    for start, stop in pairwise(ends):
        piece = items.reading.value(affine.picked(np.arange(start, stop)))
        if piece.level == value.level and piece.origin is not None and piece.number > value.number:
            return None
        pieces.append(items.of(piece))
    return items.step("Concat", pieces, value.shape, {"axis": 0})


def _squares(items: Items, value: AffineValue) -> Item | None:
    """The sum of the squares of a value."""
    if value.origin is None or value.origin.op != "ReduceSum":
        return None
    squared, *axes = value.origin.operands
    found = picked(squared) if isinstance(squared, AffineValue) else None
    if found is None or not isinstance(squared, AffineValue):
        return None
    block = items.reading.blocks[found[0]]
    if block.op != "Mul" or block.operands[0] is not block.operands[1] or block.shape != squared.shape:
        return None
    if not np.array_equal(found[1].ravel(), np.arange(prod(block.shape))):
        return None
    inputs = [items.of(block.operands[0]), *map(items.of, axes)]
    return items.step("ReduceSumSquare", inputs, value.shape, value.origin.attributes)


def _recipe(items: Items, value: AffineValue) -> Item | None:
    """The operator that stands in the graph."""
    origin = value.origin
    if origin is None:
        return None
    if not all(_before(o, value) for o in origin.operands):
        return None
    inputs = [items.of(o) for o in origin.operands]
    if origin.op in MOVING and isinstance(inputs[0], Item):
        run = _run(origin, inputs[0].shape)
        if run is not None:
            return items.piece(inputs[0], *run)
        if origin.op == "Split":
            return items.split(inputs, origin.shapes, origin.attributes, origin.place)
    return items.step(origin.op, inputs, value.shape, origin.attributes)


def _before(operand: Operand, value: AffineValue) -> bool:
    """Whether a value may be computed from an operand: by cancellation it may be part of what it is made of."""
    return not isinstance(operand, AffineValue) or (operand.level <= value.level and operand.number < value.number)


def _group(items: Items, value: AffineValue, affine: Affine, lead: Shape = ()) -> Item | None:
    """A piece of the product of its level. Not where a block may be no number, which would spread to all pieces."""
    if sum(map(len, affine.parts.values())) * prod(value.shape) > DENSE or items.reading.risky(value):
        return None
    return items.member(value, lead=lead) if np.isfinite(affine.constant).all() else None


def _run(origin: Origin, shape: Shape) -> tuple[int, int] | None:
    """The elements of a vector that a Slice, Split or Gather takes, where they stand side by side."""
    if len(shape) != 1 or len(origin.shapes[origin.place]) != 1:
        return None
    every = places_of(origin.op, origin.attributes, np.arange(shape[0]), origin.operands[1:], origin.shapes)
    places = None if every is None else every[origin.place]
    if places is None or not len(places) or (np.diff(places) != 1).any():
        return None
    return int(places[0]), int(places[-1]) + 1


def _factor(matrix: Array, block: Shape, shape: Shape) -> Array | None:
    """The factor of a part that is a factor times the block, element by element or spread; None where it is not."""
    n = prod(block)
    if len(block) > len(shape) or any(a not in (1, b) for a, b in zip(block[::-1], shape[::-1], strict=False)):
        return None
    source = np.broadcast_to(np.arange(n).reshape(block), shape)
    flat = matrix.reshape(n, -1)
    factor = flat[source.ravel(), np.arange(flat.shape[1])]
    if np.count_nonzero(flat) != np.count_nonzero(factor):
        return None
    return numbers(factor.reshape(shape))
