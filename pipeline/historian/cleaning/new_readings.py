"""New readings of an analyser among the values that stand in between, and the rows that have one.

An archive stores an analyser's last number until it has another one, or nothing at all. Neither is a reading. A number
that is left out for a fault, as a spike is, is no reading either, and no row of the other signals goes with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.findings import Finding, counted
from loopwright.pipeline.historian.cleaning.row_grid import Grid
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.metrics import Array

LEAST_NEW = 30  # of an analyser: a model of its own needs some for each number
NOT_SELDOM = 0.5  # share of the rows from which new readings are no seldom ones: then the tag is a pv like others
STORED = 0.5  # share of the cells that hold a value from which an archive repeats the last one
STEPS_WITHOUT = 1.5  # steps of the clock between two values: more is a time without any
LACKS_FROM = (
    1.5  # usual times between two new readings: from there on the nearest whole number of them tells how many lack
)


def new_readings(series: Series, step_s: float) -> Series:
    """The readings of a series that are new, of an export with a cell every ``step_s``.

    Where most cells hold a value, one that differs from the one before is new. Where the archive stores nothing in
    between, so is each one that follows on nothing, the same number or not. All bad readings stay, for the account.
    """
    good = series.good
    at = np.flatnonzero(good)
    if len(at) < 2:
        return series
    step = np.diff(series.time_s[at])
    new = np.r_[True, np.diff(series.value[at]) != 0]
    if len(at) * step_s < STORED * (series.time_s[at[-1]] - series.time_s[at[0]] + step_s):
        new[1:] |= (np.diff(at) > 1) | (step > STEPS_WITHOUT * step_s)
    kept = ~good
    kept[at[new]] = True
    return replace(series, time_s=series.time_s[kept], value=series.value[kept], code=series.code[kept])


def on_rows(series: Series, time_s: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Values (n,) at the rows ``time_s`` (n,), on lines between good readings, and which rows have a new one.

    A reading belongs to the first row that is not before it; of two of one row the later one counts.
    """
    slack = 1e-6 * float(np.median(np.diff(time_s)))
    read_s, value = series.time_s[series.good], series.value[series.good]
    row = np.searchsorted(time_s, read_s - slack)
    inside = row < len(time_s)
    row, value = row[inside], value[inside]
    last = np.r_[row[1:] != row[:-1], np.ones(min(len(row), 1), dtype=np.bool_)].astype(np.bool_)
    row, value = row[last], value[last]
    fresh = np.zeros(len(time_s), dtype=np.bool_)
    fresh[row] = True
    return (np.interp(time_s, time_s[row], value) if len(row) else np.full(len(time_s), np.nan)), fresh


def rows_between(fresh: NDArray[np.bool_]) -> int:
    """The usual number of rows from one new reading to the next, of rows (n,)."""
    gaps = np.diff(np.flatnonzero(fresh))
    return max(1, round(float(np.median(gaps)))) if gaps.size else 1


def missing_readings(fresh: NDArray[np.bool_]) -> int:
    """The new readings that lack between others, of rows (n,) with one every ``rows_between`` rows as a rule.

    An archive that repeats the last number does not show one that is equal to it: it lacks, too.
    """
    times = np.diff(np.flatnonzero(fresh)) / rows_between(fresh)
    return int(np.sum(np.rint(times[times >= LACKS_FROM]) - 1))


def put_analysers(grid: Grid, analysers: Sequence[Tag], own: Mapping[str, Series]) -> list[Finding]:
    """Put the analysers' new readings ``own`` into the grid, and the rows that have one; what was seen of them.

    RecordError for one with fewer than ``LEAST_NEW`` of them, or with one in most rows.
    """
    found = []
    for tag in analysers:
        value, fresh = on_rows(own[tag.tag], grid.time_s)
        n = int(np.count_nonzero(fresh))
        if n < LEAST_NEW:
            raise RecordError(
                f"{tag.tag} has {counted(n, 'new reading')} in {len(grid)} rows; an analyser needs {LEAST_NEW} at "
                "least: give a longer export, or leave it out"
            )
        if n > NOT_SELDOM * len(grid):
            raise RecordError(
                f"{tag.tag} has a new reading in {n} of {len(grid)} rows; it is no analyser: give it the role pv or "
                f"constraint, or a shorter --period than {grid.period_s:g} s"
            )
        grid.put(tag.tag, value, fresh)
        usual, longest = rows_between(fresh), int(np.diff(np.flatnonzero(fresh)).max())
        times = [f"{counted(of, 'row')} ({of * grid.period_s:g} s)" for of in (usual, longest)]
        words = f"{counted(n, 'new reading')}, one every {times[0]} as a rule; no row between them counts"
        if lacking := missing_readings(fresh):
            words += f"; {lacking} lack or equal the one before; the longest time without one is {times[1]}"
        found.append(Finding("analyser", tag.tag, words))
    return found
