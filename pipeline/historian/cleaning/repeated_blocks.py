"""Blocks of rows that stand in an export again with later times: every column repeats, its noise to the last digit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.cleaning.findings import Finding, counted
from loopwright.pipeline.historian.cleaning.tags import SIGNAL_ROLES, Tag
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.gathering import row_keys, with_the_same_stamps
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import noisy
from loopwright.pipeline.metrics import Array

FOLDS = (2, 2, 2, 3)  # factors of the rows that must repeat: keys of so many rows are made of keys of fewer
WINDOW = math.prod(FOLDS)  # rows that must repeat
DISTINCT_CHANGES = 16  # changes of the value among them
FACTOR = 0x9E3779B97F4A7C15  # of the hash of a block: 2^64 over the golden ratio, which spreads keys evenly


def flag_copies(own: Mapping[str, Series], tags: Sequence[Tag]) -> list[Finding]:
    """Readings of PVs that repeat a block of earlier ones get their reason; the first of each stays.

    A value with noise larger than its converter's step does not repeat by chance. For a coarser PV the whole row must
    repeat, every signal with the same stamps, and one of them must have such noise: a motion that was made again looks
    the same, and both are good.
    """
    found = []
    pvs = {t.tag for t in tags if t.role == "pv"}
    for group in with_the_same_stamps([own[t.tag] for t in tags if t.role in SIGNAL_ROLES]):
        loud = [s for s in group if noisy(s.value[s.good])]
        rows = row_keys(group) if loud else None
        for series in (s for s in group if s.tag in pvs):
            place = np.flatnonzero(series.good)
            where = np.zeros(len(series), dtype=bool)
            if series in loud:
                where[place] = copied(series.value[place], row_keys([series])[place])
            elif rows is not None:
                where[place] = copied(loud[0].value[place], rows[place])
            if n := series.flag(where, Reason.COPY):
                some = counted(n, "reading repeats", "readings repeat")
                words = f"{some} a block of earlier ones to the last digit; the first of each stays"
                found.append(Finding("copy", series.tag, words, True))
    return found


def copied(values: Array, rows: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Where (n,) rows repeat WINDOW earlier ones or more, in the same order; ``rows`` (n,) are their keys.

    A window counts where the value (n,) changes DISTINCT_CHANGES times or more: noise does not repeat by chance, a rest
    does.
    """
    n = len(values)
    where = np.zeros(n, dtype=bool)
    if n < 2 * WINDOW:
        return where
    changes = np.r_[np.int32(0), np.cumsum(np.diff(values) != 0, dtype=np.int32)]
    first = np.flatnonzero(changes[WINDOW - 1 :] - changes[: n - WINDOW + 1] >= DISTINCT_CHANGES)
    if not first.size:
        return where
    keys = _keys(rows)[first]
    ordered = np.sort(keys)  # much faster than argsort, and nearly always there is no copy
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    if not twice.size:
        return where
    several = np.isin(keys, twice)
    first, keys = first[several], keys[several]
    order = np.argsort(keys, kind="stable")  # of equal ones, the earliest comes first
    again = keys[order][1:] == keys[order][:-1]
    edge = np.zeros(n + 1, dtype=np.int64)
    start = first[order[1:][again]]
    np.add.at(edge, start, 1)
    np.add.at(edge, np.minimum(start + WINDOW, n), -1)
    return np.asarray(np.cumsum(edge[:-1]) > 0)


def _keys(rows: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """A number (n - WINDOW + 1,) for each window of the rows (n,); two equal by chance are next to impossible.

        key(k) = sum_i FACTOR^(WINDOW - 1 - i) x(k + i)   modulo 2^64

    with x the key of a row; keys of short windows make those of longer ones.
    """
    keys, length = rows, 1
    for fold in FOLDS:
        power = np.uint64(pow(FACTOR, length, 1 << 64))
        n = len(keys) - (fold - 1) * length
        longer = keys[:n].copy()
        for i in range(1, fold):
            longer *= power
            longer += keys[i * length : i * length + n]
        keys, length = longer, length * fold
    return keys
