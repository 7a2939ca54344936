"""Windows of a long record or export, spread evenly, for what need not see every row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopwright.pipeline.historian.export import Series
from loopwright.pipeline.records.record import Record

SEEN, WINDOW = 200_000, 20_000  # rows
STRETCHES = 4  # of the readings of a long export


def evenly(record: Record) -> Record:
    """The record, or of one with more than SEEN rows windows of WINDOW rows, each with runs of its own."""
    n = len(record)
    if n <= SEEN:
        return record
    starts = np.linspace(0, n - WINDOW, SEEN // WINDOW).astype(np.int64)
    rows = (starts[:, None] + np.arange(WINDOW)).ravel()
    fresh = np.r_[True, (np.diff(rows) != 1) | (np.diff(record.run[rows]) != 0)]
    taken = {name: getattr(record, name)[rows] for name in ("time_s", "pv", "mv", "dv")}
    return replace(record, run=np.cumsum(fresh, dtype=np.int64) - 1, **taken)


def readings_of(clock: Sequence[Series], series: Sequence[Series], step_s: float) -> dict[str, Series]:
    """The series, of a long export STRETCHES parts of their time, each of SEEN / STRETCHES steps."""
    length = SEEN / STRETCHES * step_s
    first, last = (f(float(s.time_s[i]) for s in clock) for f, i in ((min, 0), (max, -1)))
    if last - first <= 1.5 * STRETCHES * length:
        return {s.tag: s for s in series}
    starts = np.linspace(first, last - length, STRETCHES)

    def cut(s: Series) -> Series:
        ends = [np.searchsorted(s.time_s, (a, a + length)) for a in starts]
        time_s, value, code = (np.concatenate([c[a:b] for a, b in ends]) for c in (s.time_s, s.value, s.code))
        return replace(s, time_s=time_s, value=value, code=code)

    return {s.tag: cut(s) for s in series}
