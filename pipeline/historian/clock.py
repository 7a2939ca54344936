"""A clock of readings: its exact step, and the row of each reading, however long the record is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.metrics import Array

GAP = 20.0  # steps, from which a window of stamps says nothing of the step
FIRST, WIDER = 16, 4  # stamps of the first windows, and by how much each next ones are longer
COHERENT = 0.4  # length of the mean of exp(2 pi i phase), from which stamps keep time
WANDERS = 0.8  # of that of shorter windows: less is a clock that wanders, and longer ones say no more
EXACT = 1e-3  # ratio of two steps that count as one: readings are rows, so that no error adds up
DRIFT = 0.02  # steps that a rounded step may be off at the end of the record
WINDOW = 100  # stamps of a phase
NEAR = 0.45  # steps between a stamp and its row
REGULAR = 0.98  # share of the stamps that are near their row, each alone in it


def exact_step(time_s: Array) -> float | None:
    """The step [s] of stamps (n,) in ascending order; None where they keep no time.

    Least squares over windows of stamps that grow, the number of each stamp from the step of shorter ones:

        h = sum (n - mean n) (t - mean t) / sum (n - mean n)^2,    n = round(t / h - phase)

    Lost readings and jitter of less than half a step do no harm; windows grow as long as they keep one phase. The
    result is the shortest decimal number that is off by less than DRIFT of a step, and its own uncertainty, at the end
    of the record.
    """
    step = np.diff(time_s)
    step = step[step > 0]
    if len(step) < 2:
        return float(step[0]) if len(step) else None
    h = float(np.median(step))
    short = step[step < GAP * h]
    counted = float(np.round(short / h).sum())
    h = float(short.sum()) / counted if counted else h
    stamps = time_s[np.r_[True, np.diff(time_s) > 0]]
    length, off, coherence = min(FIRST, len(stamps)), np.inf, 0.0
    while length <= len(stamps):
        whole = len(stamps) // length
        t = stamps[: whole * length].reshape(whole, length)
        t = t[np.max(np.diff(t, axis=1), axis=1, initial=0.0) < GAP * h]
        if not len(t):
            break
        t = t - t[:, :1]
        mean = np.exp(2j * np.pi * (t / h)).mean(axis=1)
        now = float(np.median(np.abs(mean)))
        if now < max(COHERENT, WANDERS * coherence):
            break
        number = np.round(t / h - np.angle(mean)[:, None] / (2 * np.pi))
        number -= number.mean(axis=1, keepdims=True)
        t -= t.mean(axis=1, keepdims=True)
        square = np.einsum("ij,ij->i", number, number)
        if not np.all(square > 0):
            break
        # Each window has a phase of its own; one that lost count would spoil the mean.
        h = float(np.median(np.einsum("ij,ij->i", number, t) / square))
        left = float(np.sqrt(np.mean((t - h * number) ** 2))) / h
        # Seven standard deviations of the slope, over the length of the window.
        off = (DRIFT + 7.0 * np.sqrt(12.0 / length) * left) / length
        coherence = now
        length = length * WIDER if length * WIDER <= len(stamps) or length == len(stamps) else len(stamps)
    return _shortest(h, off) if coherence else None


def _shortest(h: float, off: float) -> float:
    """The decimal number of the fewest digits within the share ``off`` of h."""
    return next((x for digits in range(1, 17) if abs((x := float(f"{h:.{digits}g}")) - h) <= off * h), h)


def row_numbers(time_s: Array, step_s: float) -> NDArray[np.int64] | None:
    """The row (n,) of each stamp (n,), ascending, of a clock with a reading every step_s; None where it keeps no time.

        row = round((t - t_0) / h - phase)

    with the phase from windows of stamps: a step that is a little off, or a clock that wanders, moves no row.
    """
    at = (time_s - time_s[0]) / step_s
    number = np.round(at)
    if np.abs(at - number).max() > 0.25:
        number = np.round(at - _phases(at))
        if np.mean(np.abs(at - _phases(at) - number) <= NEAR) < REGULAR:
            return None
    row = number.astype(np.int64)
    row -= row[0]
    apart = np.diff(row)
    if apart.size and np.mean(apart > 0) < REGULAR:
        return None
    return row


def _phases(at: Array) -> Array:
    """The phase (n,) of stamps (n,) in steps, drawn between the middles of windows."""
    starts = np.arange(0, len(at), WINDOW)
    count = np.diff(np.r_[starts, len(at)])
    turn = np.exp(2j * np.pi * at)
    phase = np.unwrap(np.angle(np.add.reduceat(turn, starts))) / (2 * np.pi)
    middle = np.add.reduceat(at, starts) / count
    return np.interp(at, middle, phase) if len(middle) > 1 else np.full(len(at), phase[0])


def keeps_time(time_s: Array) -> bool:
    """Whether most stamps (n,) follow each other by one step: sampled at a rate, whatever the jitter."""
    step = exact_step(time_s)
    row = row_numbers(time_s, step) if step else None
    return row is not None and float(np.mean(np.diff(row) == 1)) > 0.7


def whole_multiple(period_s: float, step_s: float) -> int:
    """How many steps the period is; 0 where it is no whole number of them."""
    n = round(period_s / step_s)
    return n if n >= 1 and abs(period_s / step_s - n) <= EXACT * n else 0
