"""How a tag was sampled: its clock and exact step, by exception or not, and the period to propose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import quantum, staircase
from loopwright.pipeline.metrics import Array

# ------------------------------------------------ a clock of readings, and the row of each, however long the record is
STAMP_GAP = 20.0  # steps, from which a window of stamps says nothing of the step
FIRST_STAMPS, WIDER_STAMPS = 16, 4  # stamps of the first windows, and by how much each next ones are longer
CLOCK_COHERENCE = 0.4  # length of the mean of exp(2 pi i phase), from which stamps keep time
CLOCK_WANDERS = 0.8  # of that of shorter windows: less is a clock that wanders, and longer ones say no more
EXACT = 1e-3  # ratio of two steps that count as one: readings are rows, so that no error adds up
ROUNDED_STEP_DRIFT = 0.02  # steps that a rounded step may be off at the end of the record
PHASE_STAMPS = 100  # stamps of a phase
NEAR_ROW = 0.45  # steps between a stamp and its row
REGULAR_STAMPS = 0.98  # share of the stamps that are near their row, each alone in it


def exact_step(time_s: Array) -> float | None:
    """The step [s] of stamps (n,) in ascending order; None where they keep no time.

    Least squares over windows of stamps that grow, the number of each stamp from the step of shorter ones:

        h = sum (n - mean n) (t - mean t) / sum (n - mean n)^2,    n = round(t / h - phase)

    Lost readings and jitter of less than half a step do no harm; windows grow as long as they keep one phase. The
    result is the shortest decimal number that is off by less than ROUNDED_STEP_DRIFT of a step, and its own
    uncertainty, at the end of the record.
    """
    step = np.diff(time_s)
    step = step[step > 0]
    if len(step) < 2:
        return float(step[0]) if len(step) else None
    h = float(np.median(step))
    short = step[step < STAMP_GAP * h]
    counted = float(np.round(short / h).sum())
    h = float(short.sum()) / counted if counted else h
    stamps = time_s[np.r_[True, np.diff(time_s) > 0]]
    length, off, coherence = min(FIRST_STAMPS, len(stamps)), np.inf, 0.0
    while length <= len(stamps):
        whole = len(stamps) // length
        t = stamps[: whole * length].reshape(whole, length)
        t = t[np.max(np.diff(t, axis=1), axis=1, initial=0.0) < STAMP_GAP * h]
        if not len(t):
            break
        t = t - t[:, :1]
        mean = np.exp(2j * np.pi * (t / h)).mean(axis=1)
        now = float(np.median(np.abs(mean)))
        if now < max(CLOCK_COHERENCE, CLOCK_WANDERS * coherence):
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
        off = (ROUNDED_STEP_DRIFT + 7.0 * np.sqrt(12.0 / length) * left) / length
        coherence = now
        length = length * WIDER_STAMPS if length * WIDER_STAMPS <= len(stamps) or length == len(stamps) else len(stamps)
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
        if np.mean(np.abs(at - _phases(at) - number) <= NEAR_ROW) < REGULAR_STAMPS:
            return None
    row = number.astype(np.int64)
    row -= row[0]
    apart = np.diff(row)
    if apart.size and np.mean(apart > 0) < REGULAR_STAMPS:
        return None
    return row


def _phases(at: Array) -> Array:
    """The phase (n,) of stamps (n,) in steps, drawn between the middles of windows."""
    starts = np.arange(0, len(at), PHASE_STAMPS)
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


# --------------------------------------------------------------------------------------------------- the step of a tag
NICE_S = (
    *(0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.5, 1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30),
    *(60, 120, 300, 600, 900, 1800, 3600),
)
HOLD_PERIODS = 3.2  # periods for which a reading holds: three, and a little for jitter
IRREGULAR = 2.5  # 90 % over 10 % quantile of the steps, above which a tag reports by exception
DEAD_BAND_EDGE = 0.35  # smallest moves over the median one, of a tag with a dead band
# of the shortest step; of the longest; share of such; moves
RESTED_STEPS, FULL_STEP, ON_TIME_SHARE, FEWEST_RESTED_MOVES = 2.0, 0.999, 0.02, 15
FAR_APART_SCANS, TO_AND_FRO = 5.0, 0.6  # scans between two steps, and share of the moves that go back
ROWS_A_LINE, MOST_ROWS_A_LINE = 4, 16  # rows on the median line of a PV that is drawn, and on the mean one
FINEST = 1e-3  # of the median step: an archive's scan


@dataclass(frozen=True, slots=True)
class TagSampling:
    """How one tag was sampled, and over what time a reading is held or a line drawn between two."""

    tag: str
    step_s: float  # [s] median
    irregular: bool  # stored by exception or compressed
    dead_band: bool  # stored when it had moved by a dead band: it holds in between, it does not go on a line
    hold_s: float  # [s]


def sampling(series: Series, period_s: float | None = None, hold_s: float | None = None) -> TagSampling:
    """Median step of a tag, whether it reports by exception, and its hold [s] unless ``hold_s`` states it.

    Without a stated one, three steps of a tag sampled regularly; of one that reports by exception, twice the 99 %
    quantile of its steps.
    """
    stamps = _stamps(series)
    step = np.diff(stamps)
    step = step[step > 0]
    if not step.size:
        return TagSampling(series.tag, 0.0, False, False, hold_s or HOLD_PERIODS * (period_s or 1.0))
    low, median, high = np.quantile(step[:: max(1, len(step) // 200_000)], [0.1, 0.5, 0.9])
    irregular = bool(high > IRREGULAR * low) and not keeps_time(stamps)
    own = 2.0 * float(np.quantile(step, 0.99)) if irregular else HOLD_PERIODS * float(median)
    stored = series.time_s[series.good], series.value[series.good]
    band = irregular and len(stored[0]) > 1 and _is_held(np.diff(stored[0]), stored[1])
    band = series.between == "step" or (band and not series.between)
    return TagSampling(series.tag, float(median), irregular, band, hold_s or max(own, HOLD_PERIODS * (period_s or 0.0)))


def _is_held(step: Array, values: Array) -> bool:
    """Whether a tag holds its value between two stored ones; step (n-1,) [s] between the values (n,).

    A dead band stores no small move: after a rest of some scans the moves have a sharp lower edge. A swinging door
    stores the ends of lines, and some of them lie as high as the ones before, however much noise there is. Moves to
    and fro, stored long after one another with nothing in between, are steps: a line has no such corners.
    """
    move = np.diff(values)
    usual = step < FULL_STEP * step.max()
    # Where many steps are the longest one, the archive stored because of the time.
    rested = (move != 0) & (step >= RESTED_STEPS * step.min()) & (usual | (usual.mean() > 1 - ON_TIME_SHARE))
    if np.count_nonzero(rested) < FEWEST_RESTED_MOVES:
        rested = move != 0
    if not rested.any():
        return True
    low, middle = np.quantile(np.abs(move[rested]), [0.05, 0.5])
    if low > DEAD_BAND_EDGE * middle:
        return True
    scan = quantum(step)
    back = move[1:] * move[:-1] < 0
    return bool(scan > 0 and np.quantile(step, 0.05) >= FAR_APART_SCANS * scan and back.mean() > TO_AND_FRO)


def proposed_period(series: Sequence[Series], others: Sequence[Series] = ()) -> float:
    """The period [s] that the PVs' own steps propose: the slowest PV's, exactly where its clock keeps time.

    The median step of a PV that keeps none; of one that is drawn on lines, a part of it, a multiple of the scan: that
    of its stamps, or the step of ``others`` that keep time. A swinging door stores nothing for long where the PV goes
    straight, and says all the same where it was. Where every value of each PV stands for some readings, as that of an
    analyser does, a period is as long: the readings between say nothing new, and a model of them would hold still.
    """
    regular = [r.step_s for r in map(sampling, others) if r.step_s and not r.irregular]
    stamps = [_stamps(s) for s in series]
    exact: dict[int, float | None] = {}  # of stamps that several PVs share, looked at once
    steps = [_step(s, t, min(regular, default=0.0), exact) for s, t in zip(series, stamps, strict=True)]
    steps = [s for s in steps if s > 0]
    if not steps:
        raise RecordError("no process variable has two readings of different times; export a longer time")
    return float(f"{max(steps) * min(staircase(s.value[s.good]) for s in series):.12g}")


def _step(series: Series, stamps: Array, scan_s: float, exact: dict[int, float | None]) -> float:
    rate = sampling(series)
    if rate.irregular and not rate.dead_band:
        return _part_of_a_line(stamps, scan_s)
    if not rate.irregular and rate.step_s:
        if id(stamps) not in exact:
            exact[id(stamps)] = exact_step(stamps)
        if (step := exact[id(stamps)]) is not None:
            return step
    return float(f"{rate.step_s:.6g}")


def _part_of_a_line(stamps: Array, scan_s: float) -> float:
    """Rows [s] with which some lie on the lines between stamps (n,), a whole number of scans; a line where none is."""
    step = np.diff(stamps)
    step = step[step > 0]
    median = float(np.median(step))
    own = quantum(step)
    scan = own if own > FINEST * median else scan_s  # finer ones are jitter, or the digits of the stamps
    if not 0 < scan < median:
        return float(f"{median:.6g}")
    part = max(median / ROWS_A_LINE, float(np.mean(step)) / MOST_ROWS_A_LINE)
    return float(f"{max(round(part / scan), 1) * scan:.6g}")


def _stamps(series: Series) -> Array:
    """Times (m,) [s] at which the tag was stored: a cell that stays empty until the value changes is no reading."""
    stored = (series.code != Reason.DUPLICATE) & (series.code != Reason.EMPTY)
    return series.time_s if stored.all() else series.time_s[stored]
