"""The ways in which each value of a graph can be computed."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np

from pipeline.export.fusion.affine import DENSE, Affine, Array, Attributes, Shape, places_of
from pipeline.export.fusion.plan import Choice, Given, Group, Input, Item, Member, Output, Selection, Several, Step
from pipeline.export.fusion.reading import Block, Operand, Origin, Reading, Value

TERMS = 3  # blocks of an elementwise form at most
RUNS = 8  # pieces of a value put together from runs at most
MOVING = frozenset({"Slice", "Split", "Gather"})  # as operators they could depend on what is made of them
INT64 = 7


class Forms:
    """The items of a graph, each made once. ``choices`` are those that can be computed in several ways."""

    def __init__(self, reading: Reading) -> None:
        self.reading = reading
        self.choices: list[Choice] = []
        self._values: dict[int, Item] = {}
        self._blocks: dict[int, Item] = {}
        self._steps: dict[Any, Step] = {}
        self._selections: dict[int, Selection] = {}
        self._groups: dict[int, Group] = {}
        self._splits: dict[Any, Several] = {}
        self._open: list[tuple[Choice, Value]] = []
        self.outputs = [(name, self.of(operand)) for name, operand in reading.outputs]
        while self._open:
            choice, value = self._open.pop()
            choice.forms = self._forms(value)

    # ------------------------------------------------------------------ items
    def of(self, operand: Operand) -> Input:
        """An operator's operand: an item, or a constant."""
        if not isinstance(operand, Value):
            return operand
        if operand.affine is None:
            assert operand.block is not None
            return self.block(operand.block)
        if not operand.affine.parts:
            return operand.affine.constant
        if operand.number not in self._values:
            alias = self._alias(operand)
            if alias is None:
                choice = Choice(operand.shape, (operand.level, operand.number))
                self._open.append((choice, operand))
                self.choices.append(choice)
                alias = choice
            self._values[operand.number] = alias
        return self._values[operand.number]

    def block(self, block: Block) -> Item:
        """The item of a block."""
        if block.number not in self._blocks:
            self._blocks[block.number] = self._of_block(block)
        return self._blocks[block.number]

    def _of_block(self, block: Block) -> Item:
        if not block.op:
            return Given(block.name, block.shape)
        inputs = [self.of(o) for o in block.operands]
        if len(block.siblings) > 1:
            several = Several(block.op, inputs, [b.shape for b in block.siblings], block.attributes)
            for place, sibling in enumerate(block.siblings):
                self._blocks[sibling.number] = Output(several, place)
            return self._blocks[block.number]
        step = self.step(block.op, inputs, block.shape, block.attributes)
        if block.wide is None:
            return step
        choice = Choice(block.shape, (block.level, -1))
        choice.forms = {"recipe": step, "gather": self._switch(block, inputs[0])}
        self.choices.append(choice)
        return choice

    def _switch(self, block: Block, condition: Input) -> Item:
        """A Where on a single condition as a Gather from its two branches."""
        assert isinstance(condition, Item)
        index: Item = self.step("Cast", [condition], condition.shape, {"to": INT64})
        wide = self.of(block.wide)
        if block.shape == (1,) == condition.shape:
            return self.step("Gather", [wide, index], (1,), {"axis": 0})
        if condition.shape != ():
            index = self.reshaped(index, ())
        pair = self.reshaped(wide, (2, *block.shape))
        return self.step("Gather", [pair, index], block.shape, {"axis": 0})

    def step(self, op: str, inputs: Sequence[Input], shape: Shape, attributes: Attributes | None = None) -> Step:
        """An operator, the same for equal ones."""
        attributes = attributes or {}
        key = (op, tuple(map(_key, inputs)), shape, tuple(sorted((k, str(v)) for k, v in attributes.items())))
        if key not in self._steps:
            self._steps[key] = Step(op, inputs, shape, attributes)
        return self._steps[key]

    def reshaped(self, item: Input, shape: Shape) -> Any:
        """In another shape."""
        if not isinstance(item, Item):
            return np.reshape(item, shape)  # type: ignore[arg-type]
        return item if item.shape == shape else self.step("Reshape", [item, np.array(shape, dtype=np.int64)], shape)

    def flat(self, number: int) -> Item:
        """A block as a vector."""
        block = self.reading.blocks[number]
        item: Item = self.reshaped(self.block(block), (prod(block.shape),))
        return item

    # ------------------------------------------------------------------ forms
    def _forms(self, value: Value) -> dict[str, Item]:
        found = {
            "selection": self._selection(value),
            "elementwise": self._elementwise(value),
            "increment": self._increment(value),
            "segments": self._segments(value),
            "squares": self._squares(value),
            "recipe": self._recipe(value),
            "group": self._group(value),
        }
        forms = {kind: item for kind, item in found.items() if item is not None}
        return forms or {"product": self._product(value)}

    def _alias(self, value: Value) -> Item | None:
        """One whole block, perhaps in another shape."""
        picked = _picked(value)
        if picked is None:
            return None
        number, index = picked
        n = prod(self.reading.blocks[number].shape)
        if index.size != n or not (index.ravel() == np.arange(n)).all():
            return None
        item: Item = self.reshaped(self.block(self.reading.blocks[number]), value.shape)
        return item

    def _selection(self, value: Value) -> Item | None:
        """Elements of one block."""
        picked = _picked(value)
        if picked is None:
            return None
        number, index = picked
        places = index.ravel()
        source = self.flat(number)
        if len(places) > 0 and (np.diff(places) == 1).all():
            item: Item = self.reshaped(self._piece(source, (int(places[0]), int(places[-1]) + 1)), value.shape)
            return item
        return self.step("Gather", [source, index.astype(np.int64)], value.shape, {"axis": 0})

    def _piece(self, source: Item, run: tuple[int, int]) -> Member:
        """Elements start .. stop - 1 of a vector."""
        if id(source) not in self._selections:
            self._selections[id(source)] = Selection(source)
        selection = self._selections[id(source)]
        for member in selection.all:
            if selection.runs[id(member)] == run:
                return member
        member = Member((run[1] - run[0],), selection)
        selection.runs[id(member)] = run
        selection.all.append(member)
        return member

    def _elementwise(self, value: Value) -> Item | None:
        """Factors times blocks, plus a constant."""
        assert value.affine is not None
        return self._sum(value.affine, None)

    def _sum(self, affine: Affine, start: Item | None) -> Item | None:
        """``start`` plus the terms of at most three blocks, each of its own shape; None where they mix elements."""
        if len(affine.parts) > TERMS:
            return None
        plain, scaled, negative = [], [], []
        for number, matrix in affine.parts.items():
            shape = self.reading.blocks[number].shape
            if prod(shape) == prod(affine.shape):
                shape = affine.shape
            factor = _factor(matrix, shape, affine.shape)
            if factor is None:
                return None
            item = self.reshaped(self.block(self.reading.blocks[number]), shape)
            whole = shape == affine.shape
            if whole and (factor == 1).all():
                plain.append(item)
            elif whole and (factor == -1).all() and (start is not None or len(affine.parts) > 1):
                negative.append(item)
            else:
                scaled.append(self.step("Mul", [item, factor], affine.shape))
        total: Input = start
        constant = affine.constant if affine.constant.any() else None
        for term in plain + scaled:
            total = term if total is None else self.step("Add", [total, term], affine.shape)
        if constant is not None:
            total = constant if total is None else self.step("Add", [total, constant], affine.shape)
        for term in negative:
            if total is None:
                total = self.step("Neg", [term], affine.shape)
            else:
                total = self.step("Sub", [total, term], affine.shape)
        return total if isinstance(total, Item) else None

    def _increment(self, value: Value) -> Item | None:
        """An older value and what the newest blocks add to it."""
        affine = value.affine
        assert affine is not None
        newest = [b for b in affine.parts if self.reading.blocks[b].level == value.level]
        older = [b for b in affine.parts if b not in newest]
        if not older:
            return None
        start = self.of(self.reading.value(affine.only(older, constant=True)))
        change = affine.only(newest, constant=False)
        assert isinstance(start, Item)
        direct = self._sum(change, start)
        if direct is not None:
            return direct
        added = self.reading.value(change)
        if added.origin is not None and added.number > value.number:
            return None
        return self.step("Add", [start, self.of(added)], value.shape)

    def _segments(self, value: Value) -> Item | None:
        """Runs of elements of one level or one block, put together."""
        affine = value.affine
        assert affine is not None
        if len(value.shape) != 1 or value.shape[0] < 2:
            return None
        level = np.full(value.shape, -1)
        single = np.zeros(value.shape, dtype=int)
        many = np.zeros(value.shape, dtype=int)
        for number, matrix in affine.parts.items():
            uses = matrix.any(axis=0)
            level[uses] = np.maximum(level[uses], self.reading.blocks[number].level)
            many[uses] += 1
            single[uses & (np.count_nonzero(matrix, axis=0) == 1) & (matrix.max(axis=0) == 1)] = number + 1
        single[(many != 1) | (affine.constant != 0)] = 0
        change = (np.diff(level) != 0) | (np.diff(single) != 0)
        ends = [0, *(np.flatnonzero(change) + 1).tolist(), value.shape[0]]
        if not 2 < len(ends) <= RUNS + 1:
            return None
        pieces = []
        for start, stop in zip(ends[:-1], ends[1:], strict=True):
            piece = self.reading.value(affine.picked(np.arange(start, stop)))
            if piece.level == value.level and piece.origin is not None and piece.number > value.number:
                return None
            pieces.append(self.of(piece))
        return self.step("Concat", pieces, value.shape, {"axis": 0})

    def _squares(self, value: Value) -> Item | None:
        """The sum of the squares of a value."""
        if value.origin is None or value.origin.op != "ReduceSum":
            return None
        squared, *axes = value.origin.operands
        picked = _picked(squared) if isinstance(squared, Value) else None
        if picked is None or not isinstance(squared, Value):
            return None
        block = self.reading.blocks[picked[0]]
        if block.op != "Mul" or block.operands[0] is not block.operands[1] or block.shape != squared.shape:
            return None
        if (picked[1].ravel() != np.arange(prod(block.shape))).any():
            return None
        return self.step("ReduceSumSquare", [self.of(block.operands[0]), *map(self.of, axes)], value.shape, value.origin.attributes)

    def _recipe(self, value: Value) -> Item | None:
        """The operator that stands in the graph."""
        origin = value.origin
        if origin is None:
            return None
        if any(isinstance(o, Value) and (o.level > value.level or o.number >= value.number) for o in origin.operands):
            return None
        inputs = [self.of(o) for o in origin.operands]
        if origin.op in MOVING and isinstance(inputs[0], Item):
            run = _run(origin, inputs[0].shape)
            if run is not None:
                return self._piece(inputs[0], run)
            if origin.op == "Split":
                key = (id(inputs[0]), tuple(origin.shapes), origin.attributes.get("axis", 0))
                if key not in self._splits:
                    self._splits[key] = Several(origin.op, inputs, origin.shapes, origin.attributes)
                return Output(self._splits[key], origin.place)
        return self.step(origin.op, inputs, value.shape, origin.attributes)

    def _group(self, value: Value) -> Item | None:
        """A piece of the product of its level."""
        affine = value.affine
        assert affine is not None
        rows = sum(map(len, affine.parts.values()))
        if rows * prod(value.shape) > DENSE or self.reading.risky(value) or not np.isfinite(affine.constant).all():
            return None
        if value.level not in self._groups:
            self._groups[value.level] = Group(value.level, self.reading.blocks, self.flat)
        return self._member(self._groups[value.level], value)

    def _product(self, value: Value) -> Item:
        """A product of its own, which no other value shares: what is not a number spreads no further."""
        return self._member(Group(value.level, self.reading.blocks, self.flat), value)

    def _member(self, group: Group, value: Value) -> Item:
        assert value.affine is not None
        for number in value.affine.parts:
            self.flat(number)  # its items are made now, while their forms can be
        member = Member((prod(value.shape),), group)
        group.values[id(member)] = value
        item: Item = self.reshaped(member, value.shape)
        return item


def _picked(value: Value) -> tuple[int, Array] | None:
    """The one block of which a value is a selection, and the elements' places in it, of the value's shape."""
    affine = value.affine
    if affine is None or len(affine.parts) != 1 or affine.constant.any():
        return None
    ((number, matrix),) = affine.parts.items()
    if np.count_nonzero(matrix) != prod(affine.shape) or not (matrix.max(axis=0, initial=0) == 1).all():
        return None
    return number, np.asarray(matrix.argmax(axis=0))


def _run(origin: Origin, shape: Shape) -> tuple[int, int] | None:
    """The elements of a vector that a Slice, Split or Gather takes, where they stand side by side."""
    if len(shape) != 1 or len(origin.shapes[origin.place]) != 1:
        return None
    places = places_of(origin.op, origin.attributes, np.arange(shape[0]), origin.operands[1:], origin.shapes)
    if places is None or not len(places[origin.place]) or (np.diff(places[origin.place]) != 1).any():
        return None
    return int(places[origin.place][0]), int(places[origin.place][-1]) + 1


def _factor(matrix: Array, block: Shape, shape: Shape) -> Array | None:
    """f where the part is f times the block, element by element or spread; None where it is not."""
    n = prod(block)
    if len(block) > len(shape) or any(a not in (1, b) for a, b in zip(block[::-1], shape[::-1], strict=False)):
        return None
    source = np.broadcast_to(np.arange(n).reshape(block), shape)
    flat = matrix.reshape(n, -1)
    factor = flat[source.ravel(), np.arange(flat.shape[1])]
    if np.count_nonzero(flat) != np.count_nonzero(factor):
        return None
    return np.asarray(factor.reshape(shape))


def _key(item: Input) -> Any:
    if item is None or isinstance(item, Item):
        return id(item)
    return (item.dtype.str, item.shape, item.tobytes())
