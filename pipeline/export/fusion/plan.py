"""Which operators a graph needs under some choice of forms, and what they cost: kept up to date change by change."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, TypeAlias

from pipeline.export.fusion.affine import Array, Attributes, Shape
from pipeline.export.fusion.prices import FIXED, INPUT, OUTPUT, price, product

if TYPE_CHECKING:
    from pipeline.export.fusion.values import Block, Value


class Item:
    """Something that is computed once if anything needs it. ``uses``: what it is computed from."""

    __slots__ = ("count", "price", "shape", "uses")

    def __init__(self, shape: Shape, price: float = 0.0, uses: Sequence[Item] = ()) -> None:
        self.shape, self.price, self.uses = shape, price, list(uses)
        self.count = 0


Input: TypeAlias = "Item | Array | None"


class Step(Item):
    """One operator with one output."""

    __slots__ = ("attributes", "inputs", "op")

    def __init__(self, op: str, inputs: Sequence[Input], shape: Shape, attributes: Attributes) -> None:
        shapes = [tuple(i.shape) for i in inputs if i is not None]
        super().__init__(shape, price(op, shapes, [shape]), [i for i in inputs if isinstance(i, Item)])
        self.op, self.inputs, self.attributes = op, list(inputs), attributes


class Given(Item):
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


class Choice(Item):
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
    """What is computed together for all its members that are needed: the price depends on them."""

    __slots__ = ("members",)

    def __init__(self) -> None:
        super().__init__(())
        self.members: list[Member] = []  # that are needed

    def settle(self) -> tuple[float, list[Item]]:
        """Price and uses for the present members."""
        raise NotImplementedError


class Selection(Pool):
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
        self.values: dict[int, Value] = {}  # by the member's id

    def piece(self, value: Value) -> Member:
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

    def _value(self, member: Member) -> Value:
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


@dataclass(slots=True)
class Account:
    """What is needed, and its price [ns]."""

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

    def choose(self, choice: Choice, kind: str) -> None:
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
        pool.price, pool.uses = pool.settle()
        if not pool.count:
            return [], []
        self.total += pool.price - price
        before, after = set(map(id, uses)), set(map(id, pool.uses))
        return [u for u in pool.uses if id(u) not in before], [u for u in uses if id(u) not in after]
