"""Limit cycles at the end of closed loops on models, where no valve sticks: what swings, how far, and how fast."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.closed_loop import STEP_BAND, last_half, swings
from loopwright.pipeline.evaluation.law_evidence import Cycle
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.serving.manifest import Signal

MV_SWING: Final = 0.05  # of an MV's range: a valve that swings farther to the end wears, whatever the CV does
NOISES: Final = 5.0  # standard deviations of the noise: a smaller swing of a CV is lost in them


def cycle_of(case: Case, test: Scenario, loop: Trajectory) -> Cycle | None:
    """The limit cycle of a loop without noise, by the signal that goes farthest beyond its limit; None without one.

    Over the last half of what comes after the last move of a set point or a disturbance a CV goes from one side of its
    set point to the other, or an MV of its mean, as ``swings`` counts. The limit of a CV is ``STEP_BAND`` of the span
    of the case's set points, within which a step counts as settled, and no less than ``NOISES`` of its noise; that of
    an MV is ``MV_SWING`` of its range. An MV of a few allowed values has to swing and does not count.
    """
    n, measured = test.sp.shape[1], [] if test.dv is None else [test.dv]
    half = last_half(test.sp, *test.changes.values(), *measured)
    limits = np.maximum(STEP_BAND * case.asked, NOISES * case.noise_std[:n])
    found = _beyond(case.plant.sp_signals, (loop.pv[:, :n] - loop.sp)[half], limits, case.plant.period_s)
    mvs = [i for i, s in enumerate(case.plant.mv_signals) if s.values is None]
    moved = loop.mv[half][:, mvs]
    signals = [case.plant.mv_signals[i] for i in mvs]
    ranges = np.array([s.high - s.low for s in signals])
    found += _beyond(signals, moved - moved.mean(axis=0), MV_SWING * ranges, case.plant.period_s)
    return max(found, key=lambda one: one.times, default=None)


def _beyond(signals: Sequence[Signal], about: Array, limits: Array, period_s: float) -> list[Cycle]:
    """The cycles of signals (n, signals) about 0 beyond their limits (signals,)."""
    found = []
    which = swings(np.zeros_like(about), about, limits, 1.0, whole=True)
    for s, course, limit, on in zip(signals, about.T, limits, which, strict=True):
        if on:
            amplitude = float(np.ptp(course)) / 2
            found.append(Cycle(s.name, s.unit, amplitude, _period(course, limit) * period_s, amplitude / float(limit)))
    return found


def _period(course: Array, limit: float) -> float:
    """Samples of a whole swing: twice those between the changes of side of a course (n,) beyond a limit, on average."""
    beyond = np.flatnonzero(np.abs(course) > limit)
    changed = beyond[1:][np.diff(np.sign(course[beyond])) != 0]
    return 2.0 * float(changed[-1] - changed[0]) / (len(changed) - 1)
