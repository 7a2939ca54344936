"""Operators that a graph needs under some choice of forms, and their price: kept up to date change by change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import TypeAlias

from loopwright.pipeline.export.fusion.affine import Array, Attributes, Shape


class Item:
    """Something that is computed once if anything needs it. ``uses``: what it is computed from."""

    __slots__ = ("count", "price", "shape", "uses")

    def __init__(self, shape: Shape, price: float = 0.0, uses: Sequence[Item] = ()) -> None:
        self.shape, self.price, self.uses = shape, price, list(uses)
        self.count = 0


Input: TypeAlias = "Item | Array | None"


class OperatorStep(Item):
    """One operator with one output."""

    __slots__ = ("attributes", "inputs", "op")

    def __init__(self, op: str, inputs: Sequence[Input], shape: Shape, attributes: Attributes) -> None:
        shapes = [tuple(i.shape) for i in inputs if i is not None]
        super().__init__(shape, price(op, shapes, [shape]), [i for i in inputs if isinstance(i, Item)])
        self.op, self.inputs, self.attributes = op, list(inputs), attributes


class GraphInput(Item):
    """An input of the graph."""

    __slots__ = ("name",)

    def __init__(self, name: str, shape: Shape) -> None:
        super().__init__(shape)
        self.name = name


class Several(Item):
    """One operator with several outputs; ``Output`` is one of them."""

    __slots__ = ("attributes", "inputs", "op", "shapes")

    def __init__(self, op: str, inputs: Sequence[Input], shapes: Sequence[Shape], attributes: Attributes) -> None:
        given = [tuple(i.shape) for i in inputs if i is not None]
        super().__init__((), price(op, given, shapes), [i for i in inputs if isinstance(i, Item)])
        self.op, self.inputs, self.shapes, self.attributes = op, list(inputs), list(shapes), attributes


class Output(Item):
    """One output of ``Several``."""

    __slots__ = ("place",)

    def __init__(self, several: Several, place: int) -> None:
        super().__init__(several.shapes[place], 0.0, [several])
        self.place = place


class FormChoice(Item):
    """A value or a block that can be computed in several ways, ``forms`` by their kind; one is chosen."""

    __slots__ = ("forms", "kind", "order")

    def __init__(self, shape: Shape, order: tuple[int, int]) -> None:
        super().__init__(shape)
        self.order, self.kind = order, ""
        self.forms: dict[str, Item] = {}


class Member(Item):
    """A piece of what a pool computes."""

    __slots__ = ("pool",)

    def __init__(self, shape: Shape, pool: Pool) -> None:
        super().__init__(shape, 0.0, [pool])
        self.pool = pool


class Pool(Item):
    """A value computed together for all its members that are needed: the price depends on them."""

    __slots__ = ("_known", "members")

    def __init__(self) -> None:
        super().__init__(())
        self.members: list[Member] = []  # that are needed
        self._known: dict[frozenset[int], tuple[float, list[Item]]] = {}

    def settled(self) -> tuple[float, list[Item]]:
        """The answer of ``settle``; the search comes back to the same members again and again."""
        members = frozenset(map(id, self.members))
        found = self._known.get(members)
        if found is None:
            found = self._known[members] = self.settle()
        return found

    def settle(self) -> tuple[float, list[Item]]:
        """Price and uses for the present members."""
        raise NotImplementedError


@dataclass(slots=True)
class Account:
    """The operators that are needed, and their price [ns]."""

    total: float = 0.0

    def need(self, item: Item) -> None:
        """Count one use more."""
        stack = [item]
        while stack:
            now = stack.pop()
            now.count += 1
            if now.count > 1:
                continue
            self.total += now.price
            stack.extend(now.uses)
            if isinstance(now, Member):
                now.pool.members.append(now)
                stack.extend(self._settled(now.pool)[0])

    def drop(self, item: Item) -> None:
        """Count one use less."""
        stack = [item]
        while stack:
            now = stack.pop()
            now.count -= 1
            if now.count:
                continue
            self.total -= now.price
            stack.extend(now.uses)
            if isinstance(now, Member):
                now.pool.members.remove(now)
                stack.extend(self._settled(now.pool)[1])

    def choose(self, choice: FormChoice, kind: str) -> None:
        """Another form of a value or a block."""
        old, choice.kind = list(choice.uses), kind
        choice.uses = [choice.forms[kind]]
        if choice.count:
            self.need(choice.forms[kind])
            for item in old:
                self.drop(item)

    def _settled(self, pool: Pool) -> tuple[list[Item], list[Item]]:
        """Price a pool anew; what it uses now and did not, and what it used and does not."""
        price, uses = pool.price, pool.uses
        pool.price, pool.uses = pool.settled()
        if not pool.count:
            return [], []
        self.total += pool.price - price
        if uses is pool.uses:
            return [], []
        before, after = set(map(id, uses)), set(map(id, pool.uses))
        return [u for u in pool.uses if id(u) not in before], [u for u in uses if id(u) not in after]


DEAR = frozenset({"Tanh", "Log", "Exp", "Sigmoid", "Softmax", "Pow"})
FIXED = {
    "Concat": 90.0, "Split": 95.0, "Gather": 205.0, "Slice": 375.0, "Reshape": 235.0, "Unsqueeze": 220.0,
    "Squeeze": 220.0, "Cast": 130.0, "Where": 665.0, "Clip": 200.0, "ReduceSum": 385.0, "ReduceSumSquare": 385.0,
    "Transpose": 240.0, "Tile": 300.0, "Expand": 300.0, "Identity": 100.0, "Neg": 160.0, "Relu": 170.0, "And": 145.0,
}  # fmt: skip
INPUT, OUTPUT = 90.0, 155.0  # of a Concat, of a Split
# Price of a product, of a multiply-add, of one in a large product; factor of many rows.
PRODUCT, MULTIPLY_ADD, LARGE_MULTIPLY_ADD, BATCHED = 415.0, 0.21, 0.35, 0.4
LARGE_FROM = 4_000  # multiply-adds


def price(op: str, inputs: Sequence[Shape], outputs: Sequence[Shape]) -> float:
    """Price of one operator. Shapes of its inputs that are no settings (axes, lengths) come first."""
    n = sum(prod(s) for s in outputs)
    if op in ("MatMul", "Gemm"):
        return product(inputs[0], inputs[1], outputs[0])
    fixed = FIXED.get(op, 200.0)
    if op == "Concat":
        fixed += INPUT * len(inputs)
    elif op == "Split":
        fixed += OUTPUT * len(outputs)
    elif op == "Gather":
        return fixed + 3 * n
    elif op in ("ReduceSum", "ReduceSumSquare"):
        n = prod(inputs[0])
    return fixed + (3.0 if op in DEAR else 0.5) * n


def product(left: Shape, right: Shape, out: Shape) -> float:
    """Price of a MatMul. A single column costs as much as eight."""
    columns = right[-1] if len(right) > 1 else 1
    inner = left[-1]
    rows = max(1, prod(out) // max(columns, 1))
    work = rows * inner * -(-columns // 8) * 8
    each = (LARGE_MULTIPLY_ADD if work > LARGE_FROM else MULTIPLY_ADD) * (BATCHED if rows > 1 else 1.0)
    return PRODUCT + each * work
