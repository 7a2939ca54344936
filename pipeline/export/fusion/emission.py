"""The chosen operators as an ONNX graph."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any, TypeAlias

import numpy as np
import onnx
from onnx import helper, numpy_helper

from loopwright.pipeline.export.fusion.affine import Array, Attributes, Shape, numbers
from loopwright.pipeline.export.fusion.items import Group, Items, SelectionPool
from loopwright.pipeline.export.fusion.lone_factors import apart
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

Outputs: TypeAlias = Sequence[tuple[str, Input]]
"""The graph's outputs by their names."""
Vector: TypeAlias = tuple[str, list[int], bool]
"""A vector's or a row's name, the blocks in it, and whether a one stands behind them."""


def emitted(items: Items, outputs: Outputs, model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with the graph of the chosen forms, its inputs and outputs as they are."""
    return _Writer(items, outputs, model).model()


class _Writer:
    def __init__(self, items: Items, outputs: Outputs, model: onnx.ModelProto) -> None:
        self.items, self.outputs, self.source = items, outputs, model
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[Any, tuple[str, Array]] = {}
        self.names: dict[int, str] = {}
        self.shapes: dict[str, Shape] = {}  # of what an operator with one output gives
        self.vectors: dict[Shape, list[Vector]] = {(): [], (1,): []}
        self.taken = {i.name for i in model.graph.input} | {o.name for o in model.graph.output}
        self.count = 0

    def model(self) -> onnx.ModelProto:
        """The whole."""
        ends: dict[int, str] = {}
        for name, item in self.outputs:
            if isinstance(item, Item):
                ends.setdefault(id(_chosen(item)), name)
        self.ends = ends
        for item in self._ordered():
            self._write(item)
        for name, item in self.outputs:
            if self._name(item) != name:
                self.nodes.append(helper.make_node("Identity", [self._name(item)], [name]))
        nodes = apart(self.nodes, dict(self.constants.values()), self.shapes, self._constant)
        used = {name for node in nodes for name in node.input}
        made = onnx.ModelProto()
        made.CopyFrom(self.source)
        graph = made.graph
        del graph.node[:], graph.initializer[:], graph.value_info[:]
        for i, node in enumerate(nodes):
            node.name = f"n{i}"
        graph.node.extend(nodes)
        graph.initializer.extend(numpy_helper.from_array(v, n) for n, v in self.constants.values() if n in used)
        return made

    def _ordered(self) -> list[Item]:
        """All items that are needed, each behind those that it uses."""
        found: list[Item] = []
        seen: set[int] = set()
        stack = [(item, False) for _, item in reversed(self.outputs) if isinstance(item, Item)]
        while stack:
            item, left = stack.pop()
            if left:
                found.append(item)
            elif id(item) not in seen:
                seen.add(id(item))
                stack.append((item, True))
                stack.extend((used, False) for used in reversed(item.uses))
        return found

    # ------------------------------------------------------------------ items
    def _write(self, item: Item) -> None:
        if isinstance(item, GraphInput):
            self.names[id(item)] = item.name
        elif isinstance(item, FormChoice):
            self.names[id(item)] = self.names[id(item.uses[0])]
        elif isinstance(item, OperatorStep):
            self._node(item.op, item.inputs, item.attributes, [self._new(item)])
        elif isinstance(item, Several):
            names = [self._fresh() for _ in item.shapes]
            self._node(item.op, item.inputs, item.attributes, names)
            self.names[id(item)] = " ".join(names)
        elif isinstance(item, Output):
            self.names[id(item)] = self.names[id(item.uses[0])].split(" ")[item.place]
        elif isinstance(item, SelectionPool):
            self._select(item)
        elif isinstance(item, Group):
            self._product(item)
        else:
            assert isinstance(item, Member)  # written with its pool

    def _select(self, pool: SelectionPool) -> None:
        pieces = pool.lengths()
        if pieces is not None:
            names = [self._fresh() if member is None else self._new(member) for member, _ in pieces]
            self._node("Split", [pool.source, np.array([n for _, n in pieces])], {"axis": 0}, names)
            return
        for member in pool.members:
            start, stop = pool.runs[id(member)]
            if 3 * (stop - start) < 110:
                self._node("Gather", [pool.source, np.arange(start, stop)], {"axis": 0}, [self._new(member)])
            else:
                ends = [np.array([start]), np.array([stop]), np.array([0]), np.array([1])]
                self._node("Slice", [pool.source, *ends], {}, [self._new(member)])

    def _product(self, group: Group) -> None:
        members = sorted(group.members, key=lambda m: group.values[id(m)].number)
        affines = [group.values[id(m)].affine for m in members]
        columns = [prod(m.shape) for m in members]
        bias = np.concatenate([a.constant.ravel() for a in affines if a is not None])
        vector, blocks, one = self._vector(group, needs_one=bool(bias.any()))
        rows = []
        for b in blocks:
            size = prod(group.blocks[b].shape)
            parts = [a.parts.get(b) for a in affines if a is not None]
            rows.append(
                np.concatenate(
                    [
                        np.zeros((size, n)) if p is None else p.reshape(size, n)
                        for p, n in zip(parts, columns, strict=True)
                    ],
                    axis=1,
                )
            )
        if one:
            rows.append(bias[np.newaxis])
        separate = bool(bias.any()) and not one
        single = len(members) == 1
        product = self._new(members[0]) if single and not separate else self._fresh()
        self._raw("MatMul", [vector, self._constant(numbers(np.concatenate(rows)))], {}, [product])
        if separate:
            total = self._new(members[0]) if single else self._fresh()
            self._raw("Add", [product, self._constant(bias)], {}, [total])
            product = total
        if not single:
            names = [self._new(m) for m in members]
            self._raw("Split", [product, self._constant(np.array(columns))], {"axis": len(group.lead)}, names)

    def _vector(self, group: Group, *, needs_one: bool) -> Vector:
        """A vector that holds the group's blocks, its blocks in their order, and whether a one stands behind them."""
        used = group.used()
        if len(used) == 1:
            return self._name(group.flat(used[0])), used, False
        best, covered = None, 1
        for vector in self.vectors[group.lead]:
            _, blocks, _ = vector
            more = [b for b in blocks if b not in used]
            spare = sum(prod(group.blocks[b].shape) for b in more)
            common = len(blocks) - len(more)
            if common > covered and spare <= 40 and not any(group.blocks[b].risky for b in more):
                best, covered = vector, common
        rest = [b for b in used if best is None or b not in best[1]]
        if best is not None and not rest:
            return best
        one = needs_one or (best is not None and best[2])
        names = [best[0]] if best is not None else []
        order = [*(best[1] if best is not None else []), *rest]
        if best is not None and best[2]:  # the one stands in the middle: it is a block of its own then
            return self._with_one_inside(group, best, rest)
        names += [self._name(group.flat(b)) for b in rest]
        if needs_one:
            names.append(self._constant(np.ones((*group.lead, 1))))
        made = self._fresh()
        self._raw("Concat", names, {"axis": len(group.lead)}, [made])
        self.vectors[group.lead].append((made, order, one))
        return self.vectors[group.lead][-1]

    def _with_one_inside(self, group: Group, best: Vector, rest: list[int]) -> Vector:
        """The new blocks before an older vector, whose last element is a one."""
        made = self._fresh()
        self._raw("Concat", [*(self._name(group.flat(b)) for b in rest), best[0]], {"axis": len(group.lead)}, [made])
        self.vectors[group.lead].append((made, [*rest, *best[1]], True))
        return self.vectors[group.lead][-1]

    # ------------------------------------------------------------------ names
    def _fresh(self) -> str:
        self.count += 1
        return f"v{self.count}"

    def _new(self, item: Item) -> str:
        """A name for an item: an output's, where it is one."""
        self.names[id(item)] = self.ends.get(id(item)) or self._fresh()
        self.shapes[self.names[id(item)]] = item.shape
        return self.names[id(item)]

    def _name(self, item: Input) -> str:
        if item is None:
            return ""
        return self.names[id(item)] if isinstance(item, Item) else self._constant(item)

    def _constant(self, value: Array) -> str:
        key = (value.dtype.str, value.shape, value.tobytes())
        if key not in self.constants:
            self.constants[key] = (f"c{len(self.constants)}", np.array(value, order="C"))
        return self.constants[key][0]

    def _node(self, op: str, inputs: Sequence[Input], attributes: Attributes, outputs: list[str]) -> None:
        self._raw(op, [self._name(i) for i in inputs], attributes, outputs)

    def _raw(self, op: str, inputs: list[str], attributes: Attributes, outputs: list[str]) -> None:
        self.nodes.append(helper.make_node(op, inputs, outputs, **attributes))


def _chosen(item: Item) -> Item:
    while isinstance(item, FormChoice):
        item = item.uses[0]
    return item
