"""Statements over arrays of doubles: the form between a graph and a printed program.

A program is a list of statements without branches. Each is a nest of loops of constant length around one operation,

    target[...] = op(a[...], b[...], ...)

and every array is read and written at places that are affine in the loops' counters. With ``summed`` the innermost
loops run through what is put together: a sum, a product of matrices, a largest entry. Sums begin at zero and go on in
the order of their loops, so that a program has the same bits wherever doubles are those of IEEE 754.

Truth is a double, too: 1 or 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import prod
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Places = NDArray[np.int64]

OUTPUT: Final = "out_"  # before the names of outputs, which may be those of inputs
# Operations of one result from as many arguments.
ELEMENTWISE: Final[Mapping[str, int]] = {
    "copy": 1, "neg": 1, "abs": 1, "sign": 1, "sqrt": 1, "exp": 1, "log": 1, "tanh": 1, "not": 1,
    "add": 2, "sub": 2, "mul": 2, "div": 2, "min": 2, "max": 2,
    "less": 2, "less_equal": 2, "greater": 2, "greater_equal": 2, "equal": 2, "and": 2, "or": 2,
    "where": 3, "clip": 3,
    "difference_rest": 2, "exp_rest": 2, "quotient": 4,  # of numbers in two parts, see ``elementary``
}  # fmt: skip
# Operations that put together what the summed loops run through. ``dot`` sums products; its third argument, if any, and
# the second of ``sum`` are added to the finished sum, and stand still in the summed loops.
TOGETHER: Final[Mapping[str, tuple[int, ...]]] = {
    "sum": (1, 2), "sum_squares": (1,), "dot": (2, 3), "largest": (1,), "least": (1,),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Place:
    """Entry ``offset + sum strides_d i_d`` of an array, or, with a ``table``, the entry that the table has there.

    In rounds (``rounds.RepeatedBlocks``) it lies ``further`` entries on with each round of those around it.
    """

    buffer: str
    offset: int
    strides: tuple[int, ...]  # one a loop
    table: str = ""
    further: tuple[int, ...] = ()  # one for each of the rounds around it, outer ones first

    def at(self, counters: Places) -> Places:
        """The entries (n,) for counters (n, loops); of the table where there is one."""
        found: Places = self.offset + counters @ np.array(self.strides, dtype=np.int64)
        return found


@dataclass(frozen=True, slots=True)
class Then:
    """An operation on a result at once: its argument ``at`` is the result, the others are ``args``."""

    op: str
    args: tuple[Place, ...]  # as many strides as the statement has loops; 0 in the summed ones
    at: int = 0

    def __post_init__(self) -> None:
        assert len(self.args) + 1 == ELEMENTWISE[self.op]
        assert 0 <= self.at <= len(self.args)


@dataclass(frozen=True, slots=True)
class PlainStatement:
    """One nest of loops: ``loops`` counts, outer ones first, of which the last ``summed`` are put together.

    The operations of ``then`` are done on the result, one after the other, before it is written.
    """

    op: str
    target: Place  # its strides in the summed loops are 0
    args: tuple[Place, ...]
    loops: tuple[int, ...]
    summed: int = 0
    then: tuple[Then, ...] = ()

    def __post_init__(self) -> None:
        counts = TOGETHER.get(self.op) or (ELEMENTWISE[self.op],)
        assert len(self.args) in counts, f"{self.op} of {len(self.args)}"
        assert (self.op in TOGETHER) == (self.summed > 0), f"{self.op} with {self.summed} summed loops"
        assert all(len(p.strides) == len(self.loops) for p in self.places)

    @property
    def outer(self) -> tuple[int, ...]:
        """The loops that are not put together: over the entries that it writes."""
        return self.loops[: len(self.loops) - self.summed]

    @property
    def read(self) -> tuple[Place, ...]:
        """All that it reads."""
        return (*self.args, *(p for t in self.then for p in t.args))

    @property
    def places(self) -> tuple[Place, ...]:
        """The place that it writes, then all that it reads."""
        return (self.target, *self.read)

    @property
    def operations(self) -> int:
        """How often an operation is done."""
        return prod(self.loops) + len(self.then) * prod(self.outer)

    def at_places(self, change: Callable[[Place], Place]) -> PlainStatement:
        """The same at other places, changed in the order of ``places``."""
        target, args = change(self.target), tuple(map(change, self.args))
        then = tuple(replace(t, args=tuple(map(change, t.args))) for t in self.then)
        return replace(self, target=target, args=args, then=then)

    def simplified(self) -> PlainStatement:
        """The same without loops of one round, and with loops in one that run through entries in the same order."""
        assert not self.then
        kept = [d for d, n in enumerate(self.loops) if n != 1]
        outer = len([d for d in kept if d < len(self.loops) - self.summed])
        loops = [self.loops[d] for d in kept]
        strides = [[p.strides[d] for d in kept] for p in (self.target, *self.args)]
        d = 0
        while d + 1 < len(loops):
            inside = all(s[d] == s[d + 1] * loops[d + 1] for s in strides)
            if not inside or d + 1 == outer:
                d += 1
                continue
            loops[d : d + 2] = [loops[d] * loops[d + 1]]
            for s in strides:
                del s[d]
            outer -= d + 1 < outer
        places = [replace(p, strides=tuple(s)) for p, s in zip((self.target, *self.args), strides, strict=True)]
        if self.summed and len(loops) == outer:  # of one entry: a loop of one round stays
            loops.append(1)
            places = [replace(p, strides=(*p.strides, 0)) for p in places]
        return replace(self, target=places[0], args=tuple(places[1:]), loops=tuple(loops), summed=len(loops) - outer)


@dataclass(frozen=True, slots=True)
class PlainProgram:
    """All of a step: from ``inputs`` to ``outputs`` by statements over constants and arrays of its own."""

    inputs: Mapping[str, int]  # entries
    outputs: Mapping[str, int]
    constants: Mapping[str, Floats]
    tables: Mapping[str, Places]
    arrays: Mapping[str, int]  # entries of what it writes beside the outputs
    statements: tuple[PlainStatement, ...]

    @property
    def operations(self) -> int:
        """Operations of a step: always the same."""
        return sum(s.operations for s in self.statements)
