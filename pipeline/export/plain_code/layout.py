"""A program as every printer takes it: without copies, its memory laid out, equal constants once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from loopwright.pipeline.export.plain_code.fusing import CALLED, fused
from loopwright.pipeline.export.plain_code.memory import WORK, in_one_memory, laid_out, without_copies
from loopwright.pipeline.export.plain_code.rounds import Block, in_rounds
from loopwright.pipeline.export.plain_code.statements import OUTPUT, Floats, Place, PlainProgram

WIDTH = 100  # characters of a line of numbers
COUNTERS, ROUND_COUNTERS = "ijklmn", "rqp"  # of loops and of rounds, outer ones first
EXTREMES: Mapping[str, str] = {"largest": "max", "least": "min"}
# Operations that are functions of ``elementary``.
OWN: Mapping[str, str] = {op: f"plain_{op}" for op in CALLED}
INFIX: Mapping[str, str] = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


@dataclass(frozen=True, slots=True)
class PrintedLayout:
    """Shared by both texts: the program in one working memory, its blocks, and the names of its constants."""

    program: PlainProgram  # its own arrays are one, WORK
    blocks: tuple[Block, ...]  # its statements, repeated ones once
    names: Mapping[str, str]  # of constants, the first of equal ones

    @classmethod
    def of(cls, program: PlainProgram) -> PrintedLayout:
        """The layout of ``program``, results made where they are copied to and used at once where they can be."""
        program = fused(without_copies(program))
        seen: dict[bytes, str] = {}
        names = {name: seen.setdefault(values.tobytes(), name) for name, values in program.constants.items()}
        program = in_one_memory(program, laid_out(program))
        named = [s.at_places(lambda p: replace(p, buffer=names.get(p.buffer, p.buffer))) for s in program.statements]
        return cls(program, in_rounds(named), names)

    @property
    def work_entries(self) -> int:
        """Entries of the working memory."""
        return self.program.arrays.get(WORK, 0)

    @property
    def operations(self) -> frozenset[str]:
        """Kinds of operation that are printed."""
        used = [op for s in self.program.statements for op in (s.op, *(t.op for t in s.then))]
        return frozenset(EXTREMES.get(op, op) for op in used)

    def own_functions(self) -> list[str]:
        """Names in ``elementary`` of the functions that are used."""
        used = self.operations
        return [function for op, function in OWN.items() if op in used]

    def name(self, buffer: str) -> str:
        """The name of an input, an output or a constant in the text."""
        return self.names.get(buffer, buffer.removeprefix(OUTPUT))

    def kept(self) -> Iterator[tuple[str, Floats]]:
        """Constants that are tables: of more than one entry, the first of equal ones."""
        for name, values in self.program.constants.items():
            if len(values) > 1 and self.names[name] == name:
                yield name, values


def terms_of(place: Place, loops: int | None = None, prefix: str = "") -> list[str]:
    """Terms that the counters of rounds and of the first ``loops`` loops, or of all, add to a place's offset."""
    steps = [*zip(place.further, ROUND_COUNTERS, strict=False), *zip(place.strides[:loops], COUNTERS, strict=False)]
    return [f"{n} * {prefix}{name}" if n != 1 else f"{prefix}{name}" for n, name in steps if n]
