"""The look of a signal's values: steps of a converter, compression, stuck and clipped stretches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.metrics import Array

CHARACTER_READINGS = 50_000  # readings that a column's character is taken from
STUCK_CHANCE = 1e-4  # of a stretch as long by chance anywhere in the record
SHORTEST_STUCK, LONGEST_STUCK = 8, 400  # rows
NOISY = 0.2  # share of equal neighbours, up to which a value that repeats is a fault whatever the others do
ALTERNATING = 0.6  # share of the second differences that change their sign, from which they are noise
SEEN_MOVE, SEEN_STEPS = 0.05, 3  # of its span that another signal moves, and steps of the converter that this must be
CLIPPED_ROWS = 5  # rows in a row at an end of the readings, from which on it is a range's end
HELD_ROWS = 0.6  # share of rows without a move, from which a signal is moved in steps
LINEAR_ROWS = 5  # of a stretch that a compressed signal's interpolation makes straight

Where = NDArray[np.bool_]


def quantum(values: Array) -> float:
    """Step of which all differences are multiples; 0 where there is none (a plain float).

    The smallest difference q of two values, if at least 99 % of the distances between neighbouring values are whole
    multiples of it, to 5 %.
    """
    sample = values[np.isfinite(values)][:CHARACTER_READINGS]
    levels = np.unique(sample)
    if len(levels) < 2:
        return 0.0
    apart = np.diff(levels)
    apart = apart[apart > 1e-9 * max(float(levels[-1] - levels[0]), 1e-300)]
    if not apart.size:
        return 0.0
    q = float(apart.min())
    whole = np.abs(apart / q - np.round(apart / q)) < 0.05
    # Few levels of a signal that was hardly moved prove nothing; as many as readings are plain floats.
    q = float(f"{q:.6g}")
    return q if whole.mean() >= 0.99 and len(levels) < 0.9 * len(sample) else 0.0


def smallest_difference(values: Array) -> float:
    """The smallest difference of two of the values (n,); 0 where all are one."""
    levels = np.unique(values[np.isfinite(values)][:CHARACTER_READINGS])
    apart = np.diff(levels)
    apart = apart[apart > 1e-9 * float(np.abs(levels).max(initial=1e-300))]
    return float(f"{apart.min():.6g}") if apart.size else 0.0


def noisy(values: Array) -> bool:
    """Whether noise larger than the converter's step moves the values (n,): second differences change their sign.

    In white noise 73 % of them do; a smooth curve's keep it, and those of a coarse converter are its steps.
    """
    v = values[np.isfinite(values)][:CHARACTER_READINGS]
    second = np.diff(v, 2)
    if not second.size:
        return False
    sd = 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6.0)
    return sd > quantum(v) and float(np.mean(second[1:] * second[:-1] < 0)) > ALTERNATING


def runs_of(mask: Where) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First row and first row after each stretch of True, both (m,)."""
    edge = np.diff(np.r_[False, mask, False].astype(np.int8))
    return np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)


def stuck(values: Array, others: Sequence[tuple[Array, float]], same_piece: Where) -> Where:
    """Where (n,) a sensor repeats one value for longer than chance allows, while others move.

    values (n,); others: all other signals, (n,) each, with their usual spans; same_piece (n-1,): no gap between rows.
    With p the share of equal neighbours outside the longest stretches, a stretch of L rows comes by chance
    n p^L times; L is where this is STUCK_CHANCE. Where p is below NOISY and the value has noise, noise alone would
    move it. Else, as of a plant at rest, another signal must move within the first half of the stretch, so that an
    answer had as long to come: it leaves its mean over the first quarter by more than SEEN_MOVE of its span. A move
    that the converter's steps would hide is none.
    """
    scale = max(float(np.nanmax(np.abs(values), initial=0.0)), 1e-300)
    same = (np.abs(np.diff(values)) <= 1e-12 * scale) & same_piece
    where = np.zeros(len(values), dtype=bool)
    start, end = runs_of(same)
    if not start.size:
        return where
    length = end - start
    usual = length <= max(SHORTEST_STUCK, np.quantile(length, 0.9))
    rest = len(values) - int(length[~usual].sum())
    p = min(max(int(length[usual].sum()) / max(rest, 1), 1e-3), 0.999)
    least = np.clip(np.log(STUCK_CHANCE / len(values)) / np.log(p), SHORTEST_STUCK, LONGEST_STUCK)
    moves = p < NOISY and noisy(values)
    span = float(np.nanmax(values) - np.nanmin(values))
    least_move = max(SEEN_MOVE, SEEN_STEPS * quantum(values) / span) if span > 0 else SEEN_MOVE
    for a, b in zip(start[length >= least], end[length >= least], strict=True):
        quarter = max((b - a) // 4, 1)
        half = slice(a, a + max((b - a + 1) // 2, 1))
        if moves or any(_moved(other[half], quarter) > least_move * span for other, span in others if span > 0):
            where[a + 1 : b + 1] = True
    return where


def _moved(values: Array, first: int) -> float:
    """How far values leave the mean of their first ones."""
    return float(np.nanmax(np.abs(values - np.mean(values[:first])), initial=0.0))


def clipped(values: Array, low: float | None, high: float | None) -> tuple[Where, tuple[tuple[float, int], ...]]:
    """Where (n,) values stand at an end, and of each end its value and rows.

    An end is the range that was given, or the largest (smallest) value, where that is repeated at least CLIPPED_ROWS
    rows on end and three times as often as all values within the next 2 % of the span. Where values move in steps, each
    held, only the range that was given is an end: the largest step is none.
    """
    where, ends = np.zeros(len(values), dtype=bool), list[tuple[float, int]]()
    finite = values[np.isfinite(values)]
    if finite.size < 10 * CLIPPED_ROWS or np.ptp(finite) == 0:
        return where, ()
    span = float(np.ptp(finite))
    held = held_share(values) >= HELD_ROWS
    for end, given, sign in ((float(finite.max()), high, 1), (float(finite.min()), low, -1)):
        at = np.abs(values - end) <= 1e-9 * span
        start, stop = runs_of(at)
        longest = int((stop - start).max())
        near = int(np.count_nonzero((sign * (end - finite) > 1e-9 * span) & (sign * (end - finite) <= 0.02 * span)))
        at_given = given is not None and abs(end - given) <= 1e-6 * span
        if longest >= CLIPPED_ROWS and (at_given or (at.sum() > 3 * near and not held)):
            where |= at
            ends.append((end, int(at.sum())))
    return where, tuple(ends)


def held_share(values: Array) -> float:
    """Share of the steps from row to row that change nothing, outside the lowest and the highest value."""
    same = np.diff(values) == 0
    inner = (values[1:] < np.nanmax(values)) & (values[1:] > np.nanmin(values))
    return float(np.mean(same[inner])) if inner.any() else 0.0


def straight_share(values: Array) -> float:
    """Share of the rows inside straight lines of LINEAR_ROWS rows or more.

    Interpolation of a compressed signal (swinging door) leaves them; noise and smooth curves have next to none.
    """
    v = values[np.isfinite(values)][:CHARACTER_READINGS]
    if len(v) < 50:
        return 0.0
    digits = _digits(v)
    first = np.diff(v)
    moving = np.abs(first) > max(1e-9 * float(np.ptp(v)), 0.0)
    tolerance = max(1e-6 * float(np.quantile(np.abs(first), 0.9)), 1e-12 * float(np.abs(v).max()))
    if digits > 0.2 * float(np.quantile(np.abs(first[moving]), 0.5) if moving.any() else 1.0):
        return 0.0  # the converter's steps hide it
    # Each of three rounded values strays by half a digit: their second difference by two.
    straight = (np.abs(np.diff(v, 2)) <= max(tolerance, 2.01 * digits)) & moving[1:]
    start, end = runs_of(straight)
    long = (end - start) >= LINEAR_ROWS - 2
    return float((end - start)[long].sum() / len(v))


def _digits(values: Array) -> float:
    """The unit of the last decimal that is written, of at most six; 0 where there are more."""
    for places in range(-3, 7):
        if np.all(np.abs(values - np.round(values, places)) <= 1e-9 * np.maximum(np.abs(values), 1.0)):
            return float(10.0**-places)
    return 0.0


def staircase(values: Array) -> int:
    """Rows for which every value is repeated: of means or held values written more often than they are made; 1 if none.

    At least 95 % of the distances between two changes are multiples of it.
    """
    v = values[np.isfinite(values)][:CHARACTER_READINGS]
    change = np.flatnonzero(np.diff(v) != 0) + 1
    if len(change) < 30:
        return 1
    apart = np.diff(change)
    length = int(np.median(apart))
    return length if length > 1 and np.mean(apart % length == 0) >= 0.95 else 1
