"""Statements that repeat others some entries further on, as rounds: steps of a prediction, sweeps of a solver.

A graph has no loops, so what a law does at each step of its horizon stands there as often as there are steps. The text
of a program is shorter and compiled sooner where such statements are found again and stand once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from loopwright.pipeline.export.plain_code.statements import Place, PlainStatement

LONGEST = 16  # statements of a round that are looked for: the steps of today's laws have one to four
DEEPEST = 3  # rounds within each other: the texts have as many counters for them, and laws need two


@dataclass(frozen=True, slots=True)
class RepeatedBlocks:
    """``blocks`` done ``times`` times, each place ``further`` entries on in every round."""

    times: int
    blocks: tuple[Block, ...]


Block = PlainStatement | RepeatedBlocks


def in_rounds(statements: Sequence[PlainStatement]) -> tuple[Block, ...]:
    """The same statements in the same order, repeated ones as rounds, and rounds of rounds; short rounds first."""
    found: Sequence[Block] = statements
    length = 1
    while length <= LONGEST:
        shorter = _of_length(found, length)
        length = length + 1 if len(shorter) == len(found) else 1
        found = shorter
    return tuple(found)


def one_by_one(blocks: Sequence[Block]) -> Iterator[PlainStatement]:
    """The statements of all rounds, in the order in which they are done."""
    for block in blocks:
        if isinstance(block, PlainStatement):
            yield block
            continue
        for k in range(block.times):
            yield from one_by_one([_moved(b, k) for b in block.blocks])


def depth(block: Block) -> int:
    """How many rounds stand within each other."""
    return 1 + max(map(depth, block.blocks)) if isinstance(block, RepeatedBlocks) else 0


def _moved(block: Block, k: int) -> Block:
    """A block of round ``k`` of the outermost rounds around it."""
    if isinstance(block, RepeatedBlocks):
        return replace(block, blocks=tuple(_moved(b, k) for b in block.blocks))
    return block.at_places(lambda p: replace(p, offset=p.offset + k * p.further[0], further=p.further[1:]))


def _of_length(blocks: Sequence[Block], length: int) -> list[Block]:
    """Rounds of ``length`` blocks where these are there three times or more, always as far apart."""
    kinds, offsets = [_kind(b) for b in blocks], [_offsets(b) for b in blocks]
    apart = [
        [b - a for a, b in zip(offsets[i], offsets[i + length], strict=True)] if kinds[i] == kinds[i + length] else None
        for i in range(len(blocks) - length)
    ]
    found: list[Block] = []
    i = 0
    while i < len(blocks):
        alike = 0  # blocks from here on that are as far from the next round as that is from the one after it
        while (
            i + alike + length < len(apart)
            and apart[i + alike] is not None
            and apart[i + alike] == apart[i + alike + length]
        ):
            alike += 1
        if alike >= length and max(map(depth, blocks[i : i + length])) < DEEPEST:
            times = 2 + alike // length
            found.append(
                RepeatedBlocks(times, tuple(_further(blocks[k], apart[k] or []) for k in range(i, i + length)))
            )
            i += length * times
        else:
            found.append(blocks[i])
            i += 1
    return found


def _places(block: Block) -> list[Place]:
    return list(block.places) if isinstance(block, PlainStatement) else [p for b in block.blocks for p in _places(b)]


def _offsets(block: Block) -> list[int]:
    return [p.offset for p in _places(block)]


def _kind(block: Block) -> tuple[Any, ...]:
    """All of a block but its offsets."""
    if isinstance(block, RepeatedBlocks):
        return (block.times, *(_kind(b) for b in block.blocks))
    return (block.at_places(lambda p: replace(p, offset=0)),)


def _further(block: Block, steps: list[int]) -> Block:
    """The block in rounds that take its places, in their order, so many entries further."""
    left = iter(steps)

    def of(b: Block) -> Block:
        if isinstance(b, RepeatedBlocks):
            return replace(b, blocks=tuple(of(inner) for inner in b.blocks))
        return b.at_places(lambda p: replace(p, further=(next(left), *p.further)))

    return of(block)
