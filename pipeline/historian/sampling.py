"""How a tag was sampled: its step, by exception or not, what lies between two readings, and the period to propose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.character import quantum, staircase
from loopwright.pipeline.historian.clock import exact_step, keeps_time
from loopwright.pipeline.historian.export import Series
from loopwright.pipeline.historian.reason import Reason
from loopwright.pipeline.metrics import Array

NICE_S = (
    *(0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.5, 1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30),
    *(60, 120, 300, 600, 900, 1800, 3600),
)
HOLD_PERIODS = 3.2
IRREGULAR = 2.5  # 90 % over 10 % quantile of the steps, above which a tag reports by exception
EDGE = 0.35  # smallest moves over the median one, of a tag with a dead band
RESTED, LONGEST, ON_TIME, FEWEST = 2.0, 0.999, 0.02, 15  # of the shortest step; of the longest; share of such; moves
FAR, TO_AND_FRO = 5.0, 0.6  # scans between two steps, and share of the moves that go back
ROWS_A_LINE, MOST_ROWS_A_LINE = 4, 16  # rows on the median line of a PV that is drawn, and on the mean one
FINEST = 1e-3  # of the median step: an archive's scan


@dataclass(frozen=True, slots=True)
class Sampling:
    """How one tag was sampled, and over what time a reading is held or a line drawn between two."""

    tag: str
    step_s: float  # [s] median
    irregular: bool  # stored by exception or compressed
    dead_band: bool  # stored when it had moved by a dead band: it holds in between, it does not go on a line
    hold_s: float  # [s]


def sampling(series: Series, period_s: float | None = None, hold_s: float | None = None) -> Sampling:
    """Median step of a tag, whether it reports by exception, and its hold [s] unless ``hold_s`` states it.

    Without a stated one, three steps of a tag sampled regularly; of one that reports by exception, twice the 99 %
    quantile of its steps.
    """
    stamps = _stamps(series)
    step = np.diff(stamps)
    step = step[step > 0]
    if not step.size:
        return Sampling(series.tag, 0.0, False, False, hold_s or HOLD_PERIODS * (period_s or 1.0))
    low, median, high = np.quantile(step[:: max(1, len(step) // 200_000)], [0.1, 0.5, 0.9])
    irregular = bool(high > IRREGULAR * low) and not keeps_time(stamps)
    own = 2.0 * float(np.quantile(step, 0.99)) if irregular else HOLD_PERIODS * float(median)
    stored = series.time_s[series.good], series.value[series.good]
    band = irregular and len(stored[0]) > 1 and _is_held(np.diff(stored[0]), stored[1])
    band = series.between == "step" or (band and not series.between)
    return Sampling(series.tag, float(median), irregular, band, hold_s or max(own, HOLD_PERIODS * (period_s or 0.0)))


def _is_held(step: Array, values: Array) -> bool:
    """Whether a tag holds its value between two stored ones; step (n-1,) [s] between the values (n,).

    A dead band stores no small move: after a rest of some scans the moves have a sharp lower edge. A swinging door
    stores the ends of lines, and some of them lie as high as the ones before, however much noise there is. Moves to
    and fro, stored long after one another with nothing in between, are steps: a line has no such corners.
    """
    move = np.diff(values)
    usual = step < LONGEST * step.max()
    # Where many steps are the longest one, the archive stored because of the time.
    rested = (move != 0) & (step >= RESTED * step.min()) & (usual | (usual.mean() > 1 - ON_TIME))
    if np.count_nonzero(rested) < FEWEST:
        rested = move != 0
    if not rested.any():
        return True
    low, middle = np.quantile(np.abs(move[rested]), [0.05, 0.5])
    if low > EDGE * middle:
        return True
    scan = quantum(step)
    back = move[1:] * move[:-1] < 0
    return bool(scan > 0 and np.quantile(step, 0.05) >= FAR * scan and back.mean() > TO_AND_FRO)


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
