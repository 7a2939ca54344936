"""The variables of a controller FMU, in the order in which ``sources/instance.c`` counts them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from loopwright.pipeline.errors import HostError
from loopwright.serving.manifest import Manifest, Signal

TIME, FAULT, USE_APPLIED, FIRST = range(4)  # value references; FIRST: of the first signal
READ_BACK = "the MV that the plant received over the last period"
NOT_IN_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True)
class Variable:
    """A scalar variable. ``group``: sp, pv, dv, mv_applied, mv_start, mv, info; time, fault or use_mv_applied.

    ``low``, ``high`` and ``start`` are None where there is none.
    """

    name: str
    reference: int
    group: str
    causality: str  # independent, input, output, parameter
    words: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    start: float | bool | None = None

    @property
    def boolean(self) -> bool:
        """Whether it is a Boolean; else it is real."""
        return self.reference in (FAULT, USE_APPLIED)


def variables_of(m: Manifest) -> list[Variable]:
    """All variables; HostError where two would have one name, or a name has characters that XML does not have."""
    rows = [
        Variable("time", TIME, "time", "independent", "simulation time", "s"),
        Variable("fault", FAULT, "fault", "output", "the last sample was refused: its MV is the one before"),
    ]
    if "mv_applied" in m.inputs:
        words = "whether mv_applied is read once it is set; otherwise its place takes the last mv"
        rows.append(Variable("use_mv_applied", USE_APPLIED, "use_mv_applied", "parameter", words, start=True))
    groups = [
        ("sp", "input", m.sp if "sp" in m.inputs else (), "set point"),
        ("pv", "input", m.pv if "pv" in m.inputs else (), "process variable"),
        ("dv", "input", m.dv if "dv" in m.inputs else (), "measured disturbance"),
        ("mv_applied", "input", m.mv if "mv_applied" in m.inputs else (), READ_BACK),
        ("mv_start", "parameter", m.mv, "manipulated variable before the first sample"),
        ("mv", "output", m.mv, "manipulated variable"),
    ]
    reference = FIRST
    for group, causality, signals, words in groups:
        for s in signals:
            rows.append(_variable(s, reference, group, causality, words))
            reference += 1
    for name in m.info:
        rows.append(Variable(in_xml(f"info.{name}"), reference, "info", "output", "of the law, for people and alarms"))
        reference += 1
    names = [row.name for row in rows]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise HostError(f"two variables of the FMU would be named {twice!r}; an FMU's names must be different")
    return rows


def _variable(s: Signal, reference: int, group: str, causality: str, words: str) -> Variable:
    if s.values is not None:
        words += f"; allowed: {', '.join(f'{value:g}' for value in s.values)}"
    start = None if causality == "output" else s.middle
    unit = "" if s.unit == "-" else in_xml(s.unit)
    return Variable(in_xml(f"{group}.{s.name}"), reference, group, causality, words, unit, s.low, s.high, start)


def in_xml(text: str) -> str:
    """A text in one line; HostError where XML cannot hold it."""
    if NOT_IN_XML.search(text):
        raise HostError(f"the name {text!r} has a character that an FMU's description, which is XML, cannot hold")
    return " ".join(text.split())
