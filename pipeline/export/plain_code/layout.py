"""A program as every printer takes it: without copies, its memory laid out, equal constants once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from loopwright.pipeline.export.plain_code.memory import WorkMemory, laid_out, without_copies
from loopwright.pipeline.export.plain_code.statements import OUTPUT, Floats, PlainProgram

WIDTH = 100  # characters of a line of numbers
EXTREMES: Mapping[str, str] = {"largest": "max", "least": "min"}
OWN: Mapping[str, str] = {"exp": "plain_exp", "log": "plain_log", "tanh": "plain_tanh"}
INFIX: Mapping[str, str] = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


@dataclass(frozen=True, slots=True)
class PrintedLayout:
    """Shared by both texts: the program, where its arrays lie, and the names of its constants."""

    program: PlainProgram
    memory: WorkMemory
    names: Mapping[str, str]  # of constants, the first of equal ones

    @classmethod
    def of(cls, program: PlainProgram) -> PrintedLayout:
        """The layout of ``program``, results made where they are copied to."""
        program = without_copies(program)
        seen: dict[bytes, str] = {}
        names = {name: seen.setdefault(values.tobytes(), name) for name, values in program.constants.items()}
        return cls(program, laid_out(program), names)

    @property
    def operations(self) -> frozenset[str]:
        """Kinds of operation that are printed."""
        return frozenset(EXTREMES.get(s.op, s.op) for s in self.program.statements)

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
