"""How a tag was sampled: its step, by exception or not, what lies between two readings, and the period to propose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import RecordError
from pipeline.historian.clock import exact_step, keeps_time
from pipeline.historian.export import Series
from pipeline.historian.reason import Reason
from pipeline.metrics import Array

NICE_S = (
    *(0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.5, 1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30),
    *(60, 120, 300, 600, 900, 1800, 3600),
)
HOLD_PERIODS = 3.2
IRREGULAR = 2.5  # 90 % over 10 % quantile of the steps, above which a tag reports by exception
SMALLEST_MOVE = 0.05  # over the median move, of a tag with a dead band


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
    step = np.diff(_stamps(series))
    step = step[step > 0]
    if not step.size:
        return Sampling(series.tag, 0.0, False, False, hold_s or HOLD_PERIODS * (period_s or 1.0))
    low, median, high = np.quantile(step[:: max(1, len(step) // 200_000)], [0.1, 0.5, 0.9])
    irregular = bool(high > IRREGULAR * low) and not keeps_time(_stamps(series))
    own = 2.0 * float(np.quantile(step, 0.99)) if irregular else HOLD_PERIODS * float(median)
    band = irregular and _has_dead_band(series.value[series.good])
    return Sampling(series.tag, float(median), irregular, band, hold_s or max(own, HOLD_PERIODS * (period_s or 0.0)))


def _has_dead_band(values: Array) -> bool:
    """Whether no move between two stored values is small: of a compressed signal some are."""
    moves = np.abs(np.diff(values))
    moves = moves[moves > 0]
    return bool(moves.size) and float(np.quantile(moves, 0.02)) > SMALLEST_MOVE * float(np.median(moves))


def proposed_period(series: Sequence[Series]) -> float:
    """The period [s] that the PVs' own steps propose: the slowest PV's, exactly where its clock keeps time.

    The median step of a PV that keeps none.
    """
    steps = [s for s in (_step(one) for one in series) if s > 0]
    if not steps:
        raise RecordError("no process variable has two readings of different times; export a longer time")
    return max(steps)


def _step(series: Series) -> float:
    rate = sampling(series)
    exact = None if rate.irregular or not rate.step_s else exact_step(_stamps(series))
    return float(f"{rate.step_s:.6g}") if exact is None else exact


def _stamps(series: Series) -> Array:
    return series.time_s[series.code != Reason.DUPLICATE]
