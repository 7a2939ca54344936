"""The operators that a graph may be made of, each once, and products computed for several values at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import prod
from typing import Any

import numpy as np

from loopwright.pipeline.export.fusion.affine import AffineValue, Attributes, Block, Operand, Shape, picked, whole
from loopwright.pipeline.export.fusion.plan import (
    FIXED,
    INPUT,
    OUTPUT,
    FormChoice,
    GraphInput,
    Input,
    Item,
    Member,
    OperatorStep,
    Output,
    Pool,
    Several,
    product,
)
from loopwright.pipeline.export.fusion.reading import GraphReading
from loopwright.serving.graph.work import INT64


class Items:
    """Makes items. ``choices`` can be computed in several ways; ``undecided`` are those that have no forms yet."""

    def __init__(self, reading: GraphReading) -> None:
        self.reading = reading
        self.choices: list[FormChoice] = []
        self.undecided: list[tuple[FormChoice, AffineValue]] = []
        self._values: dict[int, Item] = {}
        self._blocks: dict[int, Item] = {}
        self._steps: dict[Any, OperatorStep] = {}
        self._splits: dict[Any, Several] = {}
        self._selections: dict[int, SelectionPool] = {}
        self._groups: dict[tuple[int, Shape], Group] = {}

    def of(self, operand: Operand) -> Input:
        """An operator's operand: an item, or a constant."""
        if not isinstance(operand, AffineValue):
            return operand
        if operand.affine is None:
            assert operand.block is not None
            return self.block(operand.block)
        if not operand.affine.parts:
            return operand.affine.constant
        if operand.number not in self._values:
            self._values[operand.number] = self._of_value(operand)
        return self._values[operand.number]

    def _of_value(self, value: AffineValue) -> Item:
        found = picked(value)
        if found is not None and whole(value, self.reading.blocks[found[0]]):
            return self.reshaped(self.block(self.reading.blocks[found[0]]), value.shape)
        choice = FormChoice(value.shape, (value.level, value.number))
        self.choices.append(choice)
        self.undecided.append((choice, value))
        return choice

    # ------------------------------------------------------------------ blocks
    def block(self, block: Block) -> Item:
        """The item of a block."""
        if block.number not in self._blocks:
            self._blocks[block.number] = self._of_block(block)
        return self._blocks[block.number]

    def flat(self, number: int, lead: Shape = ()) -> Item:
        """A block as a vector, or with ``lead`` (1,) as a row."""
        block = self.reading.blocks[number]
        return self.reshaped(self.block(block), (*lead, prod(block.shape)))

    def _of_block(self, block: Block) -> Item:
        if not block.op:
            return GraphInput(block.name, block.shape)
        inputs = [self.of(o) for o in block.operands]
        if len(block.siblings) > 1:
            several = Several(block.op, inputs, [b.shape for b in block.siblings], block.attributes)
            for place, sibling in enumerate(block.siblings):
                self._blocks[sibling.number] = Output(several, place)
            return self._blocks[block.number]
        step = self.step(block.op, inputs, block.shape, block.attributes)
        if block.wide is None:
            return step
        choice = FormChoice(block.shape, (block.level, -1))
        choice.forms = {"recipe": step, "gather": self._switch(block, block.wide, inputs[0])}
        self.choices.append(choice)
        return choice

    def _switch(self, block: Block, wide: AffineValue, condition: Input) -> Item:
        """A Where on a single condition as a Gather from its two branches."""
        assert isinstance(condition, Item)
        index: Item = self.step("Cast", [condition], condition.shape, {"to": INT64})
        if block.shape == (1,) == condition.shape:
            return self.step("Gather", [self.of(wide), index], (1,), {"axis": 0})
        pair = self.step("Reshape", [self.of(wide), np.array((2, *block.shape))], (2, *block.shape))
        return self.step("Gather", [pair, self.reshaped(index, ())], block.shape, {"axis": 0})

    # ------------------------------------------------------------------ operators
    def step(
        self, op: str, inputs: Sequence[Input], shape: Shape, attributes: Attributes | None = None
    ) -> OperatorStep:
        """An operator with one output."""
        key = (op, tuple(map(_key, inputs)), shape, tuple(sorted((k, str(v)) for k, v in (attributes or {}).items())))
        if key not in self._steps:
            self._steps[key] = OperatorStep(op, inputs, shape, attributes or {})
        return self._steps[key]

    def reshaped(self, item: Item, shape: Shape) -> Item:
        """In another shape."""
        return item if item.shape == shape else self.step("Reshape", [item, np.array(shape, dtype=np.int64)], shape)

    def split(self, inputs: Sequence[Input], shapes: Sequence[Shape], attributes: Attributes, place: int) -> Item:
        """One output of a Split."""
        key = (tuple(map(_key, inputs)), tuple(shapes), attributes.get("axis", 0))
        if key not in self._splits:
            self._splits[key] = Several("Split", inputs, shapes, attributes)
        return Output(self._splits[key], place)

    def piece(self, source: Item, start: int, stop: int) -> Member:
        """Elements start .. stop - 1 of a vector."""
        if id(source) not in self._selections:
            self._selections[id(source)] = SelectionPool(source)
        return self._selections[id(source)].piece(start, stop)

    def member(self, value: AffineValue, *, lead: Shape = (), alone: bool = False, level: int | None = None) -> Item:
        """A value as a piece of the product of a level, its own if not given, or of one for itself alone.

        ``lead``: (1,) of rows.
        """
        level = value.level if level is None else level
        assert value.affine is not None
        for number in value.affine.parts:
            self.flat(number, lead)  # made now, while there is still time for its forms
        group = None if alone else self._groups.get((level, lead))
        if group is None:
            group = Group(level, lead, self.reading.blocks, partial(self.flat, lead=lead))
        if not alone:
            self._groups[level, lead] = group
        return self.reshaped(group.piece(value), value.shape)


def _key(item: Input) -> Any:
    if item is None or isinstance(item, Item):
        return id(item)
    return (item.dtype.str, item.shape, item.tobytes())


# ------------------------------------------------------------------------- products computed for several values at once
class SelectionPool(Pool):
    """Runs of elements (start, stop) of one flat block: by a Split where they are many, else by a Gather each."""

    __slots__ = ("_pieces", "runs", "source")

    def __init__(self, source: Item) -> None:
        super().__init__()
        self.source = source
        self.runs: dict[int, tuple[int, int]] = {}  # by the member's id
        self._pieces: dict[tuple[int, int], Member] = {}

    def piece(self, start: int, stop: int) -> Member:
        """Elements start .. stop - 1."""
        if (start, stop) not in self._pieces:
            member = self._pieces[start, stop] = Member((stop - start,), self)
            self.runs[id(member)] = (start, stop)
        return self._pieces[start, stop]

    def lengths(self) -> list[tuple[Member | None, int]] | None:
        """The pieces of a Split, in their order; None where Gathers are cheaper or the runs overlap."""
        found: list[tuple[Member | None, int]] = []
        at, gathers = 0, 0.0
        for member in sorted(self.members, key=lambda m: self.runs[id(m)]):
            start, stop = self.runs[id(member)]
            if start < at:
                return None
            if start > at:
                found.append((None, start - at))
            found.append((member, stop - start))
            at, gathers = stop, gathers + _picking(stop - start)
        if at < self.source.shape[0]:
            found.append((None, self.source.shape[0] - at))
        return found if FIXED["Split"] + OUTPUT * len(found) < gathers else None

    def settle(self) -> tuple[float, list[Item]]:
        """See Pool."""
        pieces = self.lengths()
        if pieces is not None:
            return FIXED["Split"] + OUTPUT * len(pieces), [self.source]
        return sum(_picking(m.shape[0]) for m in self.members), [self.source]


def _picking(n: int) -> float:
    return min(FIXED["Gather"] + 3 * n, FIXED["Slice"])


class Group(Pool):
    """Affine functions of blocks of one level and below as one product: [Concat ->] MatMul [-> Add] [-> Split].

    ``lead``: () for vectors, (1,) for single rows. ``flat`` gives a block's item in that form.
    """

    __slots__ = ("blocks", "flat", "lead", "level", "values")

    def __init__(self, level: int, lead: Shape, blocks: Sequence[Block], flat: Callable[[int], Item]) -> None:
        super().__init__()
        self.level, self.lead, self.blocks, self.flat = level, lead, blocks, flat
        self.values: dict[int, AffineValue] = {}  # by the member's id

    def piece(self, value: AffineValue) -> Member:
        """A value as a vector or a row."""
        member = Member((*self.lead, prod(value.shape)), self)
        self.values[id(member)] = value
        return member

    def used(self) -> list[int]:
        """Numbers of the blocks that the members depend on, ascending."""
        found: dict[int, None] = {}
        for member in self.members:
            affine = self.values[id(member)].affine
            assert affine is not None
            found.update(dict.fromkeys(affine.parts))
        return sorted(found)

    def biased(self) -> bool:
        """Whether any member has a constant."""
        return any(v.affine is not None and v.affine.constant.any() for v in map(self._value, self.members))

    def _value(self, member: Member) -> AffineValue:
        return self.values[id(member)]

    def settle(self) -> tuple[float, list[Item]]:
        """See Pool. Older blocks are taken for one input, as they mostly stand in a vector already."""
        if not self.members:
            return 0.0, []
        used = self.used()
        rows = sum(prod(self.blocks[b].shape) for b in used)
        columns = sum(prod(m.shape) for m in self.members)
        newest = sum(self.blocks[b].level == self.level for b in used)
        inputs = newest + min(1, len(used) - newest)
        total = 0.0
        if self.biased():
            rows, total = rows + (inputs > 1), total + 200.0 * (inputs == 1)
        if inputs > 1:
            total += FIXED["Concat"] + INPUT * (inputs + self.biased())
        if len(self.members) > 1:
            total += FIXED["Split"] + OUTPUT * len(self.members)
        return total + product((rows,), (rows, columns), (columns,)), [self.flat(b) for b in used]
