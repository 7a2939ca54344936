"""Codes that a historian writes in place of a missing value: -9999 and its like, and the zero of a dead sensor."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.cells import core
from loopwright.pipeline.historian.character import runs_of
from loopwright.pipeline.historian.tags import Tag
from loopwright.pipeline.metrics import Array

Where = NDArray[np.bool_]

CODES = (-9999.0, 9999.0, -999.0, -999.25, -99999.0, 99999.0, -999999.0, 32767.0, -32768.0, 65535.0, 2147483647.0)
AWAY = 0.25  # spans of the usual values between them and zero, from which zero is a dead sensor
FAR = 2.0  # spans of the usual values between them and a code
REPEATED, REPEATED_SHARE = 3, 2e-4  # readings of one value far outside, from which it is a code
MAINLY = 0.3  # of all values that far
ABRUPT = 1.5  # of the largest other changes from reading to reading: a change to zero that no plant makes
LARGEST_CHANGES = 0.999  # quantile: an outlier is no change that the plant makes
PERCENT = (0.0, 100.0)  # where a manipulated variable in % can stand, if no range is stated


def sentinels(values: Array, tag: Tag) -> tuple[Where, Counter[str]]:
    """Where (n,) codes for a missing value stand, and how often each.

    A code is one of CODES, zero, or a value that comes again exactly, farther from the usual ones than FAR of their
    spans. A value that an actuator can take is none: a manipulated variable may be zero, and often at an end of its
    range.
    """
    low, high = core(values[values != 0.0])  # zeros of a dead sensor must not widen it
    span = max(high - low, 1e-6 * max(abs(low), abs(high), 1e-9))
    out = (values < low - FAR * span) | (values > high + FAR * span)
    found: Counter[str] = Counter()
    zero = values == 0.0
    where = zero & (tag.role == "pv" and apart_zeros(values) > 0 and _dead(values, tag))
    if where.any():
        found["0"] = int(np.count_nonzero(where))
    lowest, highest = _possible(tag)
    far = values[out & ~zero]
    for value, times in zip(*np.unique(far, return_counts=True), strict=True):
        many = times >= max(REPEATED, REPEATED_SHARE * len(values), MAINLY * len(far))
        known = value in CODES or abs(value) > 1e15
        if known or (many and not lowest <= value <= highest):
            where |= values == value
            found[f"{value:g}"] = int(times)
    return where, found


def apart_zeros(values: Array) -> int:
    """How many of values (n,) are zero, where hardly one other lies between them and the usual ones; else 0."""
    zero = values == 0.0
    low, high = core(values[~zero])
    away = max(low, -high)  # from zero
    if away <= AWAY * max(high - low, 1e-6 * max(abs(low), abs(high), 1e-9)):
        return 0
    n = int(np.count_nonzero(zero))
    between = np.count_nonzero((np.abs(values) < 0.5 * away) & ~zero & np.isfinite(values))
    return n if between <= 0.2 * n else 0


def _dead(values: Array, tag: Tag) -> bool:
    """Whether zeros are a dead sensor's: the stated range is without them, or the variable never moves as abruptly."""
    low, high = (-np.inf if tag.low is None else tag.low), (np.inf if tag.high is None else tag.high)
    if (tag.low is None and tag.high is None) or not low <= 0.0 <= high:
        return True
    known = values[np.isfinite(values)]
    start, end = runs_of(known == 0.0)
    inner = (start > 0) & (end < len(known))
    entered = np.r_[known[start[start > 0] - 1], known[end[inner]]]
    others = known[known != 0.0]
    if not entered.size or len(others) < 2:
        return False
    usual = float(np.quantile(np.abs(np.diff(others)), LARGEST_CHANGES))
    return float(np.median(np.abs(entered))) > ABRUPT * usual


def _possible(tag: Tag) -> tuple[float, float]:
    """Where a value that comes again is no code: the range of a manipulated variable; (inf, -inf) for other tags.

    A set point is given and held, so that it comes again wherever it stands.
    """
    if tag.role == "sp":
        return (-np.inf if tag.low is None else tag.low), (np.inf if tag.high is None else tag.high)
    if tag.role != "mv":
        return np.inf, -np.inf
    low, high = PERCENT if tag.unit == "%" else (np.inf, -np.inf)
    return (low if tag.low is None else tag.low), (high if tag.high is None else tag.high)
