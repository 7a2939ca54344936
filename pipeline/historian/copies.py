"""Blocks of rows that stand in an export again with later times: their noise repeats to the last digit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.metrics import Array

FOLDS = (2, 2, 2, 3)
WINDOW = math.prod(FOLDS)  # rows that must repeat
DIFFERENT = 16  # changes of the value among them
FACTOR = 0x9E3779B97F4A7C15


def copied(values: Array) -> NDArray[np.bool_]:
    """Where (n,) readings repeat WINDOW earlier ones or more, in the same order.

    A window counts where its value changes DIFFERENT times or more: noise does not repeat by chance, a rest does.
    """
    n = len(values)
    where = np.zeros(n, dtype=bool)
    if n < 2 * WINDOW:
        return where
    changes = np.r_[np.int32(0), np.cumsum(np.diff(values) != 0, dtype=np.int32)]
    first = np.flatnonzero(changes[WINDOW - 1 :] - changes[: n - WINDOW + 1] >= DIFFERENT)
    if not first.size:
        return where
    keys = _keys(values)[first]
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


def _keys(values: Array) -> NDArray[np.uint64]:
    """A number (n - WINDOW + 1,) for each window of the values (n,); two equal by chance are next to impossible.

        key(k) = sum_i FACTOR^(WINDOW - 1 - i) x(k + i)   modulo 2^64

    with x the mixed bits of a value; keys of short windows make those of longer ones.
    """
    bits = np.ascontiguousarray(values, dtype=np.float64).view(np.uint64)
    keys, length = bits ^ (bits >> np.uint64(29)), 1
    for fold in FOLDS:
        power = np.uint64(pow(FACTOR, length, 1 << 64))
        n = len(keys) - (fold - 1) * length
        longer = keys[:n].copy()
        for i in range(1, fold):
            longer *= power
            longer += keys[i * length : i * length + n]
        keys, length = longer, length * fold
    return keys
