"""An experiment on a simulator that its first step test plans: random holds over the range that is safe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.excitation.first_test import FirstTest
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import noise_draws

SHORTEST, LONGEST_HOLD = 0.1, 1.5  # of the settling time
FEWEST_HOLDS = 60  # of each MV in the record; the holds are shorter where it would have fewer
DV_HOLD = (1.0, 4.0)  # of the settling time
TRIES = 12  # levels drawn until none leads a PV out of its range
RIM = 0.03  # of a PV's range: kept free at both ends
LOOK = 0.25  # of the settling time, beyond a hold, that a level is tried on


@dataclass(frozen=True, slots=True)
class Plan:
    """Holds of the MVs and of the measured disturbances [periods], fewest and most, and the MVs' range."""

    samples: int
    mv_hold: tuple[int, int]
    dv_hold: tuple[int, int]
    low: tuple[float, ...]
    high: tuple[float, ...]
    look: int  # periods beyond a hold


def planned(plant: Simulator, test: FirstTest, samples: int) -> Plan:
    """Holds of 0.1 to 1.5 of the settling time over the safe range; PlantError where an MV has no room to move."""
    for s, low, high in zip(plant.mv_signals, test.low, test.high, strict=True):
        if not high > low:
            raise PlantError(
                f"plant {plant.name!r}: {s.name} cannot move from its start without a PV leaving its range; start from "
                "a rest in the middle of the ranges, or widen them"
            )
    longest = min(LONGEST_HOLD * test.settling_periods, samples / FEWEST_HOLDS)
    shortest = min(max(2.0, SHORTEST * test.settling_periods), longest)
    mv_hold = max(1, round(shortest)), max(2, round(longest))
    dv_hold = tuple(max(2, round(min(share * test.settling_periods, samples / 20))) for share in DV_HOLD)
    look = max(1, round((LOOK if test.settles else 1.0) * test.settling_periods))
    return Plan(samples, mv_hold, (dv_hold[0], dv_hold[1]), test.low, test.high, look)


def excited(plant: Simulator, plan: Plan, seed: int = 0) -> Record:
    """The record of the plan, one run, measured with the plant's own noise.

    Each MV holds levels that are uniform over its range for times that are uniform in their logarithm; each measured
    disturbance does so over its own range. Before a level is set it is tried on the plant's state up to the next move
    and ``look`` periods more; one that leads a PV within RIM of an end of its range is drawn again. So a tank that
    integrates does not run over. Where TRIES levels all lead out, the one that stays inside longest is set, for half of
    that time.
    """
    rng = np.random.default_rng(seed)
    n, (x, mv0), p = plan.samples, plant.start, plant.parameters()
    low, high = np.array(plan.low), np.array(plan.high)
    dv = _holds(plant, plan, rng)
    mv, pv = np.empty((n, len(mv0))), np.empty((n, len(plant.pv_signals)))
    now, left = mv0.copy(), _draw_holds(plan, len(mv0), rng)
    for k in range(n):
        due = left <= 0
        if k and np.any(dv[k] != dv[k - 1]) and _kept(plant, x, now, dv[k], plan.look)[0] < plan.look:
            due = np.ones(len(mv0), dtype=bool)
        if due.any():
            left = np.where(due, _draw_holds(plan, len(mv0), rng), left)
            ahead = int(left.min()) + plan.look
            levels = [np.where(due, rng.uniform(low, high), now) for _ in range(TRIES)]
            # Where a disturbance is too large for the safe range, the ends of the MVs' own ranges may hold it.
            levels += [np.where(due, [getattr(s, end) for s in plant.mv_signals], now) for end in ("low", "high")]
            now, stays = _best(plant, x, levels, dv[k], ahead)
            if stays < ahead:
                left = np.where(due, max(1, stays // 2), left)
        mv[k], pv[k] = now, plant.measure(x)
        x = plant.step(x, now, dv[k], p)
        left -= 1
    if not np.isfinite(pv).all():
        raise PlantError(f"plant {plant.name!r}: the experiment ran away; narrow the ranges of the MVs in the file")
    noisy = pv + noise_draws(plant, n, plant.noise_std, rng)
    return Record.of(plant.signals, noisy, mv, dv=dv)


def _holds(plant: Simulator, plan: Plan, rng: np.random.Generator) -> Array:
    """Courses (n, n_dv) of the measured disturbances, from their nominal values on."""
    dv = np.tile(plant.dv_nominal, (plan.samples, 1))
    for j, s in enumerate(plant.dv_signals):
        k = 0
        while (k := k + int(_log_uniform(*plan.dv_hold, rng))) < plan.samples:
            dv[k:, j] = rng.uniform(s.low, s.high)
    return dv


def _draw_holds(plan: Plan, n: int, rng: np.random.Generator) -> Array:
    return np.array([_log_uniform(*plan.mv_hold, rng) for _ in range(n)])


def _log_uniform(fewest: int, most: int, rng: np.random.Generator) -> float:
    return float(np.round(np.exp(rng.uniform(np.log(fewest), np.log(most)))))


def _best(plant: Simulator, x: Array, levels: list[Array], dv: Array, periods: int) -> tuple[Array, int]:
    """The first of MVs (n_mv,) that keeps the PVs inside for all ``periods``, or the best of them; and how long."""
    best, reached = levels[0], (-1, -np.inf)
    for mv in levels:
        kept = _kept(plant, x, mv, dv, periods)
        if kept > reached:
            best, reached = mv, kept
        if kept[0] >= periods:
            break
    return best, reached[0]


def _kept(plant: Simulator, x: Array, mv: Array, dv: Array, periods: int) -> tuple[int, float]:
    """Periods for which all PVs keep RIM away from the ends of their ranges, and how far outside they end, negative."""
    p = plant.parameters()
    low = np.array([s.low + RIM * (s.high - s.low) for s in plant.pv_signals])
    high = np.array([s.high - RIM * (s.high - s.low) for s in plant.pv_signals])
    inside = outside = 0.0
    for k in range(periods):
        x = plant.step(x, mv, dv, p)
        y = plant.measure(x)
        outside = float(np.max(np.maximum(low - y, y - high) / (high - low)))
        if not outside <= 0 and inside == k and k:
            break  # it was inside and has left
        inside += outside <= 0
    return int(inside), -max(outside, 0.0)
