"""The reach of a control that knows the plant of a test exactly, within a hold: no law can be asked to beat it.

A set point of a spoilt plant may be out of reach within its hold, wherever the MVs go. So simple courses of the MVs are
tried, each to its end: constant ones, and an end of the MVs' ranges that gives way to the MVs that rest at the set
point, which for a plant without overshoot is as quick as can be.

Source: L. S. Pontryagin et al., The Mathematical Theory of Optimal Processes, 1962, chapter 1 (ends and switches).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from loopwright.pipeline.evaluation.closed_loop import UNREACHED_ERROR, holds
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.rests import BALANCED, balanced, inside
from loopwright.pipeline.simulation.scenario import Scenario

ONE_MV_VALUES, SEVERAL_MV_VALUES = 9, 3  # constant values of one MV, and of each of several
COMBINED_MVS = 3  # most MVs of which all combinations are tried
SWITCHES = (0.03, 0.06, 0.12, 0.25, 0.4, 0.6)  # of the hold; another switch is where a CV reaches its set point


@dataclass(frozen=True, slots=True, eq=False)
class Reached:
    """The best of the courses: whether each CV is near its set point at some time in the second half."""

    near: bool
    x: Array  # (n_x,) at the end of the hold
    mv: Array  # (n_mv,) the last ones


def reached(plant: IdentifiedPlant, test: Scenario, part: slice, x: Array, mv: Array, span: Array) -> Reached:
    """The best course over a hold ``part`` of a test, from state x (n_x,) after MVs mv (n_mv,).

    Near is ``UNREACHED_ERROR`` of ``span`` (n_cv,), by which set points move each CV, as of a lock-up; parameters,
    loads and measured disturbances are the test's.
    """
    sp, p, dv = test.sp[part], test.parameters(plant)[part], test.disturbances(plant)[part]
    n, n_cv = sp.shape
    low, high = (np.array([getattr(s, end) for s in plant.mv_signals]) for end in ("low", "high"))
    most = np.array([np.inf if s.max_move is None else s.max_move for s in plant.mv_signals])
    _, rest, away = balanced(plant, x, mv, sp[-1], range(n_cv), p[-1])
    rests = bool(away < BALANCED and inside(rest[None], low - 1e-9, high + 1e-9)[0])
    first, then, switch = _courses(low, high, rest if rests else None, mv, n)
    states, moves = np.tile(x, (len(first), 1)), np.tile(mv, (len(first), 1))
    error, side = np.empty((n, len(first), n_cv)), np.zeros((len(first), n_cv))
    switched = np.zeros(len(first), dtype=np.bool_)
    for k in range(n):
        error[k] = sp[k] - plant.measured(states)[:, :n_cv]
        now = np.sign(error[k])
        crossed = np.any(now * side < 0, axis=1)
        side = now
        switched |= np.where(switch < 0, crossed, k >= switch)
        wanted = np.where(switched[:, None], then, first)
        moves = moves + np.clip(wanted - moves, -most, most)
        with np.errstate(over="ignore", invalid="ignore"):
            states = plant.step(states, moves, dv[k], p[k])
    size = np.nan_to_num(np.abs(error) / span, nan=np.inf)
    closest = size[n // 2 :].min(axis=0).max(axis=1)  # of each course, of the CV that comes least near
    late = size[-max(n // 4, 1) :].mean(axis=(0, 2))
    near = closest <= UNREACHED_ERROR
    best = int(np.where(near, late, np.inf).argmin()) if near.any() else int(closest.argmin())
    return Reached(bool(near.any()), states[best], moves[best])


def gets_there(plant: IdentifiedPlant, test: Scenario, span: Array) -> bool:
    """Whether the best courses, hold after hold from the start of a test, come near all its set points.

    ``span`` (n_cv,) is that of ``reached``.
    """
    x, mv = test.x0, test.mv0
    for part in holds(test.samples, test.hold):
        found = reached(plant, test, part, x, mv, span)
        if not found.near:
            return False
        x, mv = found.x, found.mv
    return True


def _courses(low: Array, high: Array, rest: Array | None, mv: Array, n: int) -> tuple[Array, Array, Array]:
    """(first MVs, later MVs (b, n_mv), sample of the switch (b,), -1: as a CV reaches its set point).

    ``rest`` are MVs that rest at the set point, None where there are none within the ranges.
    """
    n_mv = len(low)
    if n_mv <= COMBINED_MVS:
        constant = np.array(list(product(*np.linspace(low, high, ONE_MV_VALUES if n_mv == 1 else SEVERAL_MV_VALUES).T)))
        ends = np.array(list(product(*zip(low, high, strict=True))))
    else:
        middle = mv if rest is None else rest
        levels = np.linspace(low, high, SEVERAL_MV_VALUES)
        constant = np.array([np.where(np.arange(n_mv) == j, level, middle) for j in range(n_mv) for level in levels])
        ends = np.array([np.where(np.arange(n_mv) == j, end, middle) for j in range(n_mv) for end in (low, high)])
    constant = np.vstack([constant, mv])
    if rest is None:
        return constant, constant, np.full(len(constant), n)
    constant = np.vstack([constant, rest])
    switches = np.array([-1, *(round(share * n) for share in SWITCHES)])
    first = np.vstack([constant, np.repeat(ends, len(switches), axis=0)])
    then = np.vstack([constant, np.tile(rest, (len(ends) * len(switches), 1))])
    return first, then, np.concatenate([np.full(len(constant), n), np.tile(switches, len(ends))])
