"""Windows of a long record, spread evenly, for what need not see every row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.records.record import Record

SEEN, WINDOW = 200_000, 20_000  # rows


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
