"""Manipulated variables of two or three values: an on-off valve, or a test that shows no curve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from loopwright.pipeline.historian.findings import Verdict
from loopwright.pipeline.historian.missing_codes import PERCENT
from loopwright.pipeline.historian.tags import Tag
from loopwright.pipeline.records.levels import levels_of, only_between
from loopwright.pipeline.records.record import Record

END = 0.01  # of the range: so near is an end
SWITCHED = ((0.0, 1.0), (0.0, 100.0))  # what an on-off valve is often written as, whatever its range


def on_off(record: Record, tags: Sequence[Tag]) -> tuple[str, ...]:
    """For each MV that looks like an on-off valve: the finding, and the remedy; ``tags`` have the stated ranges."""
    return tuple(
        f"{s.name} is {levels[0]:.4g} or {levels[1]:.4g} {s.unit}".rstrip(" -")
        + " in all rows and looks like an on-off valve; predictive control and the PID move an MV continuously: give "
        "the share of time that it is open as the MV, or the output of the controller that switches it"
        for s, values in zip(record.mv_signals, record.mv.T, strict=True)
        if _ends(levels := levels_of(values), next((t for t in tags if s.name in {t.name, t.tag}), None))
    )


def with_levels(verdict: Verdict, record: Record, tags: Sequence[Tag]) -> Verdict:
    """The verdict, "no" where an MV looks like an on-off valve, and with what an MV of few values leaves unseen."""
    found = zip(record.mv_signals, map(levels_of, record.mv.T), strict=True)
    if switched := on_off(record, tags):
        return replace(verdict, carries="no", reasons=(*switched, *verdict.reasons))
    unseen = tuple(only_between(s.name, levels, s.unit) for s, levels in found if levels)
    return replace(verdict, reasons=(*verdict.reasons, *unseen))


def _ends(levels: Sequence[float], tag: Tag | None) -> bool:
    if len(levels) != 2:
        return False
    low, high = (None, None) if tag is None else (tag.low, tag.high)
    if tag is not None and tag.unit == "%":
        low, high = (PERCENT[0] if low is None else low), (PERCENT[1] if high is None else high)
    at_ends = low is not None and high is not None and _near(levels, (low, high))
    return at_ends or any(_near(levels, ends) for ends in SWITCHED)


def _near(levels: Sequence[float], ends: Sequence[float]) -> bool:
    slack = END * (ends[1] - ends[0])
    return all(abs(level - end) <= slack for level, end in zip(levels, ends, strict=True))
