"""Experiments on a simulator: its first step test, and the random holds that this plans."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from loopwright.pipeline.dynamics.step_response import SETTLED_BAND, STILL_MOVES, settling_index
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import noise_draws

FIRST_STEP = 0.05  # of an MV's range
SHORT_RUN, LONGEST_RUN = 200, 6_400  # periods of a run: doubled until it settles
EXPLODES = 1e5  # ranges of a PV within LONGEST_RUN periods: no integrator that can be controlled gets there
START_RESTS = 0.02  # of a PV's range, in LONGEST_RUN periods without a step: the start is a rest
TRIED_WAYS = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05)  # shares of the way from the start to an end of the MV's range
CROSSED = 0.1  # of the PV's range: a plant that does not settle is measured by the time it takes to cross that


@dataclass(frozen=True, slots=True)
class FirstTest:
    """Findings of single steps from the start; lists in the order of the signals."""

    settling_periods: int  # of the slowest answer; of a plant that does not settle, to cross CROSSED of a PV's range
    settles: bool
    at_rest: bool  # without a step the PVs stay
    gain: tuple[tuple[float, ...], ...]  # PV x MV, by a step of FIRST_STEP; per period where a plant does not settle
    low: tuple[float, ...]  # of each MV: from there on a step alone leaves a PV's range
    high: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


def first_test(plant: Simulator) -> FirstTest:
    """Steps of each MV from the start, up and down, without noise and under the nominal disturbances.

    Raises PlantError where no MV moves any PV, and where the plant explodes without a controller.
    """
    _x0, mv0 = plant.start
    room = np.array([s.high - s.low for s in plant.pv_signals])
    base = _course(plant, mv0, LONGEST_RUN)
    _refuse_exploding(plant, base, "without a step")
    times, gains, settles = [], np.zeros((len(room), len(mv0))), True
    for j, signal in enumerate(plant.mv_signals):
        step = FIRST_STEP * (signal.high - signal.low)
        step = step if mv0[j] + step <= signal.high else -step
        moved = mv0.copy()
        moved[j] += step
        change, rests = _settled(plant, base, moved)
        _refuse_exploding(plant, change + base[: len(change)], f"after a step of {signal.name} to {moved[j]:.4g}")
        if not np.any(np.abs(change) > 1e-9 * room):
            continue
        settles &= rests
        if rests:
            gains[:, j] = change[-1] / step
            times.append(_settling(change, room))
        else:
            slope = (change[-1] - change[4 * len(change) // 5]) / (len(change) / 5)
            gains[:, j] = slope / step
            # A step as large as the MV's range allows, FIRST_STEP as it is, says how long a hold may be.
            times.append(int(CROSSED / np.max(np.abs(slope) / room)))
    if not times:
        raise PlantError(
            f"plant {plant.name!r}: no process variable answers to a step of {100 * FIRST_STEP:g} % of any MV within "
            f"{LONGEST_RUN} periods; check step() and measure()"
        )
    slowest = int(np.clip(max(times), 2, LONGEST_RUN))
    look = int(min(LONGEST_RUN, 3 * slowest)) if settles else slowest
    ends = [[_reach(plant, mv0, j, end, look) for j, end in enumerate(side)] for side in _sides(plant)]
    stays = bool(np.all(np.abs(base - base[0]) <= START_RESTS * room)) if len(base) else False
    return FirstTest(slowest, settles, stays, tuple(map(tuple, gains.tolist())), tuple(ends[0]), tuple(ends[1]))


def _refuse_exploding(plant: Simulator, course: Array, when: str) -> None:
    """PlantError where a PV of a course (n, n_pv) goes EXPLODES of its ranges away, or to no finite number."""
    for s, y in zip(plant.pv_signals, course.T, strict=True):
        if np.abs(y - y[0]).max() > EXPLODES * (s.high - s.low):
            raise PlantError(
                f"plant {plant.name!r}: {when} {s.name} goes to {y[-1]:.3g} {s.unit} within {len(y)} periods, far "
                f"from its range {s.low:g} to {s.high:g}: the plant is unstable, and its experiment holds the MVs "
                "without a controller; check the signs in step(), or put a controller that stabilises it into the "
                "simulator"
            )


def _sides(plant: Simulator) -> tuple[list[float], list[float]]:
    return [s.low for s in plant.mv_signals], [s.high for s in plant.mv_signals]


def _course(plant: Simulator, mv: Array, periods: int, *, within: bool = False) -> Array:
    """PVs (n, n_pv) of up to ``periods`` periods under a constant mv; cut where one leaves its range, if asked."""
    x, dv, p = plant.start[0], plant.dv_nominal, plant.parameters()
    low, high = (np.array([getattr(s, end) for s in plant.pv_signals]) for end in ("low", "high"))
    rows = []
    for _ in range(periods):
        y = plant.measure(x)
        if not np.isfinite(y).all() or (within and np.any((y < low) | (y > high))):
            break
        rows.append(y)
        x = plant.step(x, mv, dv, p)
    return np.array(rows).reshape(-1, len(low))


def _settled(plant: Simulator, base: Array, mv: Array) -> tuple[Array, bool]:
    """Changes (n, n_pv) by a step, over a run long enough to settle, and whether it does."""
    length, change = SHORT_RUN, np.zeros((0, base.shape[1]))
    while length <= LONGEST_RUN:
        course = _course(plant, mv, length)
        n = min(len(course), len(base))
        change = course[:n] - base[:n]
        late = np.ptp(change[4 * n // 5 :], axis=0) if n > 5 else np.full(base.shape[1], np.inf)
        most = np.max(np.abs(change), axis=0, initial=0.0)
        room = np.array([s.high - s.low for s in plant.pv_signals])
        if n == length and np.all((late <= STILL_MOVES * SETTLED_BAND * most) | (most <= 1e-9 * room)):
            return change, bool(np.any(most > 1e-9 * room)) or length == LONGEST_RUN
        length *= 2
    return change, bool(np.all(late <= STILL_MOVES * most))


def _settling(change: Array, room: Array) -> int:
    """Periods after which every PV that moves stays within SETTLED_BAND of its end."""
    y = change[:, np.max(np.abs(change), axis=0) > 1e-6 * room].T
    return int(settling_index(y, SETTLED_BAND * np.max(np.abs(y), axis=1)).max(initial=1))


def _reach(plant: Simulator, mv0: Array, j: int, end: float, periods: int) -> float:
    """The MV's value nearest to ``end``, of TRIED_WAYS, under which no PV leaves its range within ``periods``."""
    for share in TRIED_WAYS:
        mv = mv0.copy()
        mv[j] += share * (end - mv0[j])
        if len(_course(plant, mv, periods, within=True)) == periods:
            return float(mv[j])
    return float(mv0[j])


SHORTEST_HOLD, LONGEST_HOLD = 0.1, 1.5  # of the settling time
FEWEST_HOLDS = 60  # of each MV in the record; the holds are shorter where it would have fewer
DV_HOLD = (1.0, 4.0)  # of the settling time
LEVEL_TRIES = 12  # levels drawn until none leads a PV out of its range
RIM = 0.03  # of a PV's range: kept free at both ends
LEVEL_LOOK_AHEAD = 0.25  # of the settling time, beyond a hold, that a level is tried on


@dataclass(frozen=True, slots=True)
class ExperimentPlan:
    """Holds of the MVs and of the measured disturbances [periods], fewest and most, and the MVs' range."""

    samples: int
    mv_hold: tuple[int, int]
    dv_hold: tuple[int, int]
    low: tuple[float, ...]
    high: tuple[float, ...]
    look: int  # periods beyond a hold


def planned(plant: Simulator, test: FirstTest, samples: int) -> ExperimentPlan:
    """Holds of 0.1 to 1.5 of the settling time over the safe range; PlantError where an MV has no room to move."""
    for s, low, high in zip(plant.mv_signals, test.low, test.high, strict=True):
        if not high > low:
            raise PlantError(
                f"plant {plant.name!r}: {s.name} cannot move from its start without a PV leaving its range; start from "
                "a rest in the middle of the ranges, or widen them"
            )
    longest = min(LONGEST_HOLD * test.settling_periods, samples / FEWEST_HOLDS)
    shortest = min(max(2.0, SHORTEST_HOLD * test.settling_periods), longest)
    mv_hold = max(1, round(shortest)), max(2, round(longest))
    dv_hold = tuple(max(2, round(min(share * test.settling_periods, samples / 20))) for share in DV_HOLD)
    look = max(1, round((LEVEL_LOOK_AHEAD if test.settles else 1.0) * test.settling_periods))
    return ExperimentPlan(samples, mv_hold, (dv_hold[0], dv_hold[1]), test.low, test.high, look)


def excited(plant: Simulator, plan: ExperimentPlan, seed: int = 0) -> Record:
    """The record of the plan, one run, measured with the plant's own noise.

    Each MV holds levels that are uniform over its range for times that are uniform in their logarithm; each measured
    disturbance does so over its own range. Before a level is set it is tried on the plant's state up to the next move
    and ``look`` periods more; one that leads a PV within RIM of an end of its range is drawn again. So a tank that
    integrates does not run over. Where LEVEL_TRIES levels all lead out, the one that stays inside longest is set, for
    half of that time.
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
            levels = [np.where(due, rng.uniform(low, high), now) for _ in range(LEVEL_TRIES)]
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


def _holds(plant: Simulator, plan: ExperimentPlan, rng: np.random.Generator) -> Array:
    """Courses (n, n_dv) of the measured disturbances, from their nominal values on."""
    dv = np.tile(plant.dv_nominal, (plan.samples, 1))
    for j, s in enumerate(plant.dv_signals):
        k = 0
        while (k := k + int(_log_uniform(*plan.dv_hold, rng))) < plan.samples:
            dv[k:, j] = rng.uniform(s.low, s.high)
    return dv


def _draw_holds(plan: ExperimentPlan, n: int, rng: np.random.Generator) -> Array:
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
