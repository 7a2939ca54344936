"""Operations done on a result at once, where nothing else reads it: fewer loops, and no array for what lies between."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from math import prod

from loopwright.pipeline.export.plain_code.statements import ELEMENTWISE, Place, PlainProgram, PlainStatement, Then

# Functions of ``elementary`` in the text, in the order in which it has them. They keep loops of their own: behind sums,
# in place of one after the other, they took twice as long.
CALLED = ("exp", "log", "tanh", "difference_rest", "exp_rest", "quotient")


def fused(program: PlainProgram) -> PlainProgram:
    """The same numbers from fewer statements.

    A statement goes to the only one that reads its result, if that one does an operation on each entry of it in the
    same order; the operation becomes its ``then``. Every entry is computed as before, so its bits are the same. Arrays
    are written once a step, so what the first statement reads is still there when the second one is done.
    """
    statements: list[PlainStatement | None] = list(program.statements)
    readers, writers = defaultdict[str, list[tuple[int, Place]]](list), defaultdict[str, int](int)
    for k, s in enumerate(program.statements):
        writers[s.target.buffer] += 1
        for p in s.read:
            readers[p.buffer].append((k, p))
    arrays = dict(program.arrays)
    for k in range(len(statements)):
        first = statements[k]
        assert first is not None
        made = first.target.buffer
        if made not in arrays or writers[made] > 1 or len(readers[made]) != 1 or arrays[made] != prod(first.outer):
            continue
        reader = readers[made][0][0]
        second = statements[reader]
        assert second is not None
        both = _together(first, second)
        if both is not None:
            statements[k], statements[reader] = None, both
            del arrays[made]
    return replace(program, arrays=arrays, statements=tuple(s for s in statements if s is not None))


def _together(first: PlainStatement, second: PlainStatement) -> PlainStatement | None:
    """``first`` with the operation of ``second`` on its result; None where the two run through entries otherwise."""
    at = next((i for i, p in enumerate(second.args) if p.buffer == first.target.buffer), None)
    if second.op not in ELEMENTWISE or second.op in CALLED or at is None:
        return None
    if len(first.outer) == 1 < len(second.loops):
        first = _spread(first, second.loops)
    elif len(second.loops) == 1 < len(first.outer):
        second = _spread(second, first.outer)
    read = second.args[at]
    if (
        first.outer != second.loops
        or read.table
        or _stride(first) != read.strides
        or first.target.offset != read.offset
    ):
        return None

    def wider(p: Place) -> Place:
        return replace(p, strides=p.strides + (0,) * first.summed)

    others = tuple(map(wider, second.args[:at] + second.args[at + 1 :]))
    own = () if second.op == "copy" else (Then(second.op, others, at),)
    after = tuple(replace(t, args=tuple(map(wider, t.args))) for t in second.then)
    return replace(first, target=wider(second.target), then=(*first.then, *own, *after))


def _stride(s: PlainStatement) -> tuple[int, ...]:
    return s.target.strides[: len(s.outer)]


def _spread(s: PlainStatement, loops: tuple[int, ...]) -> PlainStatement:
    """The same with its one outer loop as several, if they have as many rounds."""
    if s.outer != (prod(loops),):
        return s
    steps = [prod(loops[d + 1 :]) for d in range(len(loops))]

    def wider(p: Place) -> Place:
        return replace(p, strides=(*(p.strides[0] * step for step in steps), *p.strides[1:]))

    then = tuple(replace(t, args=tuple(map(wider, t.args))) for t in s.then)
    inner = s.loops[1:]
    return PlainStatement(s.op, wider(s.target), tuple(map(wider, s.args)), (*loops, *inner), s.summed, then)
