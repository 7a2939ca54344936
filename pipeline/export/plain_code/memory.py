"""Where a program's own arrays lie in one working memory: arrays whose lives do not meet share it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

from loopwright.pipeline.export.plain_code.statements import Place, PlainProgram

WORK: Final = "w"  # the one array of a program in one memory


@dataclass(frozen=True, slots=True)
class WorkMemory:
    """First entry of each array, and the entries of all."""

    starts: Mapping[str, int]
    size: int


def without_copies(program: PlainProgram) -> PlainProgram:
    """The same with results made where they are copied to: parts of what is put together, and the outputs."""
    statements = list(program.statements)
    moved: dict[str, tuple[str, int]] = {}  # an array, none that a table reads, to a place in another

    def found(place: Place) -> Place:
        buffer, offset = place.buffer, place.offset
        while buffer in moved:
            buffer, by = moved[buffer]
            offset += by
        return replace(place, buffer=buffer, offset=offset)

    for s in statements:
        read = s.args[0]
        if s.op != "copy" or read.table or read.buffer not in program.arrays or read.buffer in moved:
            continue
        along = read.strides == s.target.strides and read.strides in ((), (1,))
        count = s.loops[0] if s.loops else 1
        if along and read.offset == 0 and count == program.arrays[read.buffer] and not _by_table(program, read.buffer):
            moved[read.buffer] = (s.target.buffer, s.target.offset)
    kept = []
    for s in statements:
        changed = s.at_places(found)
        if changed.op != "copy" or changed.target != changed.args[0]:
            kept.append(changed)
    arrays = {name: n for name, n in program.arrays.items() if name not in moved}
    return replace(program, arrays=arrays, statements=tuple(kept))


def _by_table(program: PlainProgram, buffer: str) -> bool:
    return any(p.table and p.buffer == buffer for s in program.statements for p in s.read)


def lives(program: PlainProgram) -> dict[str, tuple[int, int]]:
    """The statements from the first that writes an array to the last that reads it."""
    found: dict[str, tuple[int, int]] = {}
    for k, s in enumerate(program.statements):
        for place in s.places:
            if place.buffer in program.arrays:
                found[place.buffer] = (found.get(place.buffer, (k, k))[0], k)
    return found


def laid_out(program: PlainProgram) -> WorkMemory:
    """A place for each array, the largest first, as low as those allow that live at the same time."""
    alive = lives(program)
    starts: dict[str, int] = {}
    for name in sorted(alive, key=lambda n: (-program.arrays[n], alive[n])):
        first, last = alive[name]
        taken = sorted(
            (starts[o], starts[o] + program.arrays[o]) for o in starts if alive[o][0] <= last and first <= alive[o][1]
        )
        start, size = 0, program.arrays[name]
        for begin, end in taken:
            if start + size <= begin:
                break
            start = max(start, end)
        starts[name] = start
    size = max((start + program.arrays[name] for name, start in starts.items()), default=0)
    return WorkMemory(starts, size)


def in_one_memory(program: PlainProgram, memory: WorkMemory) -> PlainProgram:
    """The same with one array of its own, in which the others lie."""
    tables = dict(program.tables)

    def found(place: Place) -> Place:
        start = memory.starts.get(place.buffer)
        if start is None:
            return place
        if not place.table:
            return replace(place, buffer=WORK, offset=start + place.offset)
        tables[place.table] = program.tables[place.table] + start
        return replace(place, buffer=WORK)

    statements = tuple(s.at_places(found) for s in program.statements)
    arrays = {WORK: memory.size} if memory.size else {}
    return replace(program, arrays=arrays, statements=statements, tables=tables)


def overlaps(program: PlainProgram, memory: WorkMemory) -> list[tuple[str, str]]:
    """Arrays that share an entry while both live: none, or the memory is wrong."""
    alive = lives(program)
    found = []
    for a, b in combinations(sorted(memory.starts, key=lambda n: memory.starts[n]), 2):
        together = alive[a][0] <= alive[b][1] and alive[b][0] <= alive[a][1]
        if together and memory.starts[b] < memory.starts[a] + program.arrays[a]:
            found.append((a, b))
    return found
