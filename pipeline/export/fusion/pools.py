"""Products computed for several values at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import prod

from loopwright.pipeline.export.fusion.affine import AffineValue, Block, Shape
from loopwright.pipeline.export.fusion.plan import FIXED, INPUT, OUTPUT, Item, Member, Pool, product


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
