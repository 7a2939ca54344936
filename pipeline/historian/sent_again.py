"""Rows that stand in a file again: the same stamp and the same values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.export import SENT_AGAIN, Series
from loopwright.pipeline.historian.reason import Reason
from loopwright.pipeline.metrics import Array

FACTOR = np.uint64(0x9E3779B97F4A7C15)


def drop_repeated_rows(series: Mapping[str, Series]) -> None:
    """Rows of one file that stand there again, stamp and all values, become DUPLICATE; the first of each stays.

    Tags with the same stamps share rows. Only where nearly all rows that share a stamp are equal, in every tag:
    where stamps are rounded the rows differ, but a resting tag repeats its value by right.
    """
    found = []
    for group in with_the_same_stamps(list(series.values())):
        t = group[0].time_s
        if not len(t) or np.all(np.diff(t) > 0):
            continue
        shared = len(t) - len(np.unique(t))
        if not shared:
            continue
        again = _repeated(t, row_keys(group))
        if np.count_nonzero(again) <= SENT_AGAIN * shared:
            return
        found.append((group, again))
    for group, again in found:
        for one in group:
            one.code[again] = Reason.DUPLICATE


def with_the_same_stamps(series: Sequence[Series]) -> list[list[Series]]:
    """Tags in groups that share their stamps: the columns of one file."""
    groups: list[list[Series]] = []
    for one in series:
        t = one.time_s
        own = next((g for g in groups if g[0].time_s is t or np.array_equal(g[0].time_s, t)), None)
        if own is None:
            groups.append([one])
        else:
            own.append(one)
    return groups


def row_keys(group: Sequence[Series]) -> NDArray[np.uint64]:
    """A number (n,) for the values of each row; two that are equal by chance are next to impossible."""
    keys = np.zeros(len(group[0]), dtype=np.uint64)
    for one in group:
        bits = (np.where(np.isnan(one.value), np.inf, one.value) + 0.0).view(np.uint64)
        keys = keys * FACTOR + (bits ^ (bits >> np.uint64(29))) + one.code
    return keys


def _repeated(t: Array, keys: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Where (n,) a row has the stamp and the key of an earlier one."""
    order = np.lexsort((keys, t))  # stable: of equal rows the first of the file stays the first
    again = np.zeros(len(t), dtype=bool)
    again[order[1:]] = (np.diff(t[order]) == 0) & (keys[order][1:] == keys[order][:-1])
    return again
