"""Blocks of rows that stand in an export again with later times: their noise repeats to the last digit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.metrics import Array

WINDOW = 24  # rows that must repeat
DIFFERENT = 16  # changes of the value among them
FACTOR = np.uint64(0x9E3779B97F4A7C15)


def copied(values: Array) -> NDArray[np.bool_]:
    """Where (n,) readings repeat WINDOW earlier ones or more, in the same order.

    A window counts where its value changes DIFFERENT times or more: noise does not repeat by chance, a rest does.
    """
    n = len(values)
    where = np.zeros(n, dtype=bool)
    if n < 2 * WINDOW:
        return where
    changes = np.r_[0, np.cumsum(np.diff(values) != 0)]
    first = np.flatnonzero(changes[WINDOW - 1 :] - changes[: n - WINDOW + 1] >= DIFFERENT)
    if not first.size:
        return where
    bits = np.ascontiguousarray(values, dtype=np.float64).view(np.uint64)
    mixed = np.zeros(len(first), dtype=np.uint64)
    for i in range(WINDOW):  # a polynomial of the values; two that are equal by chance are next to impossible
        part = bits[first + i]
        mixed = mixed * FACTOR + (part ^ (part >> np.uint64(29)))
    order = np.argsort(mixed, kind="stable")  # of equal ones, the earliest comes first
    again = mixed[order][1:] == mixed[order][:-1]
    edge = np.zeros(n + 1, dtype=np.int64)
    start = first[order[1:][again]]
    np.add.at(edge, start, 1)
    np.add.at(edge, np.minimum(start + WINDOW, n), -1)
    return np.asarray(np.cumsum(edge[:-1]) > 0)
