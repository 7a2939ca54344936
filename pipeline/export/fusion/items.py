"""The operators that a graph may be made of, each once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import prod
from typing import Any

import numpy as np

from loopwright.pipeline.export.fusion.affine import AffineValue, Attributes, Block, Operand, Shape, picked, whole
from loopwright.pipeline.export.fusion.plan import (
    FormChoice,
    GraphInput,
    Input,
    Item,
    Member,
    OperatorStep,
    Output,
    Several,
)
from loopwright.pipeline.export.fusion.pools import Group, SelectionPool  # fmt: skip
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
