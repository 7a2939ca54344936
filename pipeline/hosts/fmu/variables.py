"""The variables of a controller FMU: what stands for each signal of the manifest, and under which reference."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from loopwright.pipeline.errors import HostError
from loopwright.serving.manifest import Manifest, Signal, What

TIME, FAULT, USE_APPLIED, FIRST = range(4)  # value references; FIRST: of the first signal
BOOLEANS = frozenset({"fault", "use_mv_applied", "use_fresh"})
READ_BACK = "the MV that the plant received over the last period"
NOT_IN_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True, slots=True)
class ScalarVariable:
    """A scalar variable.

    ``group``: sp, pv, dv, mv_applied, mv_start, mv, info, operate, fresh, ahead; time, fault, use_mv_applied or
    use_fresh.
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
        return self.group in BOOLEANS


def variables_of(m: Manifest) -> list[ScalarVariable]:
    """All variables; HostError where two would have one name, or a name has characters that XML does not have."""
    rows = [
        ScalarVariable("time", TIME, "time", "independent", "simulation time", "s"),
        ScalarVariable("fault", FAULT, "fault", "output", "the last sample was refused: its MV is the one before"),
    ]
    if "mv_applied" in m.inputs:
        words = "whether mv_applied is read once it is set; otherwise its place takes the last mv"
        rows.append(ScalarVariable("use_mv_applied", USE_APPLIED, "use_mv_applied", "parameter", words, start=True))
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
        rows.append(
            ScalarVariable(in_xml(f"info.{name}"), reference, "info", "output", "of the law, for people and alarms")
        )
        reference += 1
    for row in _steering(m):
        rows.append(replace(row, reference=reference))
        reference += 1
    names = [row.name for row in rows]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise HostError(f"two variables of the FMU would be named {twice!r}; an FMU's names must be different")
    return rows


OPERATED_WORDS: Mapping[What, str] = {
    "use": "1: the law takes it into account, 0: it is out",
    "track": "1: the set point is wanted, 0: the range alone",
    "low": "low end of the range in which it may be",
    "high": "high end of the range in which it may be",
    "weight": "times that of its set point; the smaller one gives way",
    "rank": "1: its range is kept before those of 2",
    "max_move": "largest move a period",
    "rest": "where it goes that nothing asks for",
    "rest_use": "1: it goes to its rest, 0: it has none",
    "cost": "per unit and period, beside the other costs",
    "speed": "multiplies the law's",
    "caution": "multiplies the law's",
}


def _steering(m: Manifest) -> Iterator[ScalarVariable]:
    """``operate``, ``fresh`` and ``ahead`` of a law that reads them.

    They stand last: no other variable has another reference.
    """
    for e in m.operate if "operate" in m.inputs else ():
        name, unit = in_xml(f"operate.{e.name}"), "" if e.unit == "-" else in_xml(e.unit)
        words = OPERATED_WORDS[e.what]
        yield ScalarVariable(name, 0, "operate", "parameter", words, unit, e.low, e.high, e.default)
    if "fresh" in m.inputs:
        words = "1: its reading is new and good, 0: it is neither; read where use_fresh is true"
        for s in m.pv:
            yield ScalarVariable(in_xml(f"fresh.{s.name}"), 0, "fresh", "input", words, "", 0.0, 1.0, 1.0)
        words = "whether fresh is read; otherwise all readings are"
        yield ScalarVariable("use_fresh", 0, "use_fresh", "parameter", words, start=False)
    if m.ahead is None or "ahead" not in m.inputs:
        return
    for i in range(1, m.ahead.horizon + 1):
        for a in m.ahead.signals:
            kind, span = "set point" if a.group == "sp" else "disturbance", a.high - a.low
            words = f"this {kind} after {i} periods, minus what it is now"
            name, unit = in_xml(f"ahead.{a.group}.{a.signal}.{i}"), "" if a.unit == "-" else in_xml(a.unit)
            yield ScalarVariable(name, 0, "ahead", "input", words, unit, -span, span, 0.0)


def _variable(s: Signal, reference: int, group: str, causality: str, words: str) -> ScalarVariable:
    if s.values is not None:
        words += f"; allowed: {', '.join(f'{value:g}' for value in s.values)}"
    start = None if causality == "output" else s.middle
    unit = "" if s.unit == "-" else in_xml(s.unit)
    return ScalarVariable(in_xml(f"{group}.{s.name}"), reference, group, causality, words, unit, s.low, s.high, start)


def in_xml(text: str) -> str:
    """A text in one line; HostError where XML cannot hold it."""
    if NOT_IN_XML.search(text):
        raise HostError(f"the name {text!r} has a character that an FMU's description, which is XML, cannot hold")
    return " ".join(text.split())
