"""A record split in time, so that what validates comes after what trains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.errors import ParamsError, RecordError
from pipeline.records.record import Record

NEAR = 0.1  # of the record's rows: how far the cut may move to come between two runs


def split_in_time(record: Record, fraction: float) -> tuple[Record, Record]:
    """(training, validation): the first ``fraction`` of the rows, and the rest.

    Where runs are short (batches, restarts) the cut moves to the nearest boundary between two of
    them, so that each run is whole on one side; a long run is cut inside, its times go on. No window
    of one part reaches into the other.

    Raises ParamsError for a fraction outside (0, 1), RecordError where one side would stay empty.
    """
    if not 0.0 < fraction < 1.0:
        raise ParamsError(f"the training fraction is {fraction}; it must lie between 0 and 1")
    n = len(record)
    cut = round(fraction * n)
    starts = np.flatnonzero(record.run[1:] != record.run[:-1]) + 1
    if starts.size:
        nearest = int(starts[np.argmin(np.abs(starts - cut))])
        if abs(nearest - cut) <= NEAR * n:
            cut = nearest
    if not 0 < cut < n:
        raise RecordError(
            f"record: {n} rows split at {fraction:g} leave {cut} for training and {n - cut} for validation; "
            "both need some: record more samples"
        )
    return rows_of(record, slice(0, cut)), rows_of(record, slice(cut, n))


def rows_of(record: Record, rows: slice) -> Record:
    """Some neighbouring rows of a record, with the runs and times that they had."""
    return replace(record, **{name: getattr(record, name)[rows] for name in ("run", "time_s", "pv", "mv", "dv")})


def longest_run(record: Record, most: int) -> Record:
    """The longest run, or its first ``most`` rows."""
    _, start, length = np.unique(record.run, return_index=True, return_counts=True)
    i = int(np.argmax(length))
    return rows_of(record, slice(int(start[i]), int(start[i] + min(length[i], most))))
