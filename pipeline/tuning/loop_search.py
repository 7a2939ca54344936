"""Tuning by closed loops over development set points, side by side, and a search for numbers of PID loops in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import copysign, isfinite
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from loopwright.pipeline.dynamics.step_response import NOT_AT_REST
from loopwright.pipeline.engine.progress import steps
from loopwright.pipeline.errors import LawError, PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.noise import coloured
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.tuning.responses import FirstOrder
from loopwright.pipeline.tuning.rules import PidSettings

LawStep = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""A control law or its ``forward``: (sp, pv, dv, mv_applied, state) -> (mv, state_next, info)."""

REACH_MARGIN = 0.02  # share of the reachable range of the controlled variable that is left out at either end
MOVE_COST = 0.05  # share of the range of the controlled variable that a move over the MV's range costs
MV_END_MARGIN = 0.1  # share of an MV's range that is left out at either end when set points are looked for
MV_LOAD = 0.08  # of an MV's range: the steps of a load that acts with it
DEVELOPMENT_REST = 1000  # samples to come to rest
DRAWN = 8  # rests that are looked for, for each set point


class BatchLoops:
    """Closed loops of a law over a nominal plant, all at once, without noise; ``lanes`` is the loops' shape."""

    def __init__(
        self, plant: Simulator, law: LawStep, n_state: int, lanes: tuple[int, ...], x: Array, mv: Array
    ) -> None:
        self.plant, self.law, self.lanes = plant, law, lanes
        self.x, self.mv = x, torch.from_numpy(mv)  # (loops, n_x), (*lanes, n_mv)
        self.state = torch.zeros(*lanes, n_state, dtype=torch.float64)
        self.dv = torch.from_numpy(np.tile(plant.dv_nominal, (*lanes, 1)))
        self.advance = plant.many(len(x))

    def measured(self) -> Array:
        """The PVs (*lanes, n_pv)."""
        return self.plant.measured(self.x).reshape(*self.lanes, -1)

    @torch.inference_mode()
    def step(self, sp: Tensor, pv: Array, load: Array | None = None) -> None:
        """One period on, with set points (*lanes, n_sp) and PVs; ``load`` (*lanes, n_mv) [mv] acts with the MVs."""
        self.mv, self.state, _ = self.law(sp, torch.from_numpy(pv), self.dv, self.mv, self.state)
        acting = self.mv.numpy() if load is None else self.mv.numpy() + load
        self.x = self.advance(self.x, acting.reshape(len(self.x), -1))

    def keep(self, stay: NDArray[np.bool_]) -> None:
        """Go on with some of the loops alone, (n,); ``lanes`` is (n,)."""
        self.x, self.mv, self.state, self.dv = self.x[stay], self.mv[stay], self.state[stay], self.dv[stay]
        self.lanes = (len(self.x),)
        if len(self.x):
            self.advance = self.plant.many(len(self.x))


@dataclass(frozen=True, slots=True, eq=False)
class LoopCosts:
    """The cost of candidates for a law's numbers over s sequences, and what it is made of."""

    cost: Array  # (candidates,) in the unit of the first CV, infinite where a loop is not finite
    error: Array  # (candidates, s) mean absolute error, in the unit of the first CV
    travel: Array  # (candidates, s) of the MVs [% of their range a sample]


@dataclass(frozen=True, slots=True, eq=False)
class DevelopmentLoops:
    """Sequences of set points, and of loads, over a nominal plant.

    They serve the choice of numbers and are never scored: the scored tests are those of the case.
    """

    plant: Simulator
    hold: int  # samples of each set point
    sp: Array  # (n, s, n_sp) set points of every sequence at every sample
    x0: Array  # (s, n_x)
    mv0: Array  # (s, n_mv)
    load: Array | None = None  # (n, s, n_mv) [mv] acts with the MVs; None: no load

    @classmethod
    def draw(cls, plant: EquationPlant, seeds: tuple[int, ...], set_points: int, hold: int) -> Self:
        """One sequence a seed: ``set_points`` uniform over what the plant can hold, ``hold`` samples each.

        Each begins at the steady state of its first set point. Raises PlantError where nothing was asked for, or the
        plant has no steady state in its MV's range.
        """
        _check(seeds, set_points, hold)
        cvs, _, mvs = plant.steady_curve
        mv = plant.mv_signals[0]
        held = cvs[(mvs >= mv.low) & (mvs <= mv.high)]
        if not held.size:
            raise PlantError(f"plant {plant.name!r} has no steady state with {mv.name} in [{mv.low}, {mv.high}]")
        inset = REACH_MARGIN * (held.max() - held.min())
        low, high = held.min() + inset, held.max() - inset
        levels = np.array([np.random.default_rng(s).uniform(low, high, set_points) for s in seeds])
        starts = [plant.steady_state_at(float(first)) for first in levels[:, 0]]
        sp = np.repeat(levels, hold, axis=1).T[..., None]
        return cls(plant, hold, sp, np.array([x for x, _ in starts]), np.array([u for _, u in starts]))

    @classmethod
    def by_simulation(cls, plant: Simulator, seeds: tuple[int, ...], set_points: int, hold: int) -> Self:
        """Two sequences a seed: one of set points that the plant can hold, one of loads at the first CVs.

        For plants that are known by simulation alone: the set points are where it comes to rest under MVs within
        their ranges, evenly over the set points' ranges; a CV that does not come to rest (an integrator) has set
        points uniform over its range. All sequences begin where the plant starts. Raises PlantError as ``draw``.
        """
        _check(seeds, set_points, hold)
        x0, mv0 = plant.start
        n, n_cv = set_points * hold, len(plant.sp_signals)
        first = plant.measured(x0)[:n_cv]
        sp, load = np.empty((n, 2 * len(seeds), n_cv)), np.zeros((n, 2 * len(seeds), len(mv0)))
        size = MV_LOAD * np.array([s.high - s.low for s in plant.mv_signals])
        for i, seed in enumerate(seeds):
            rng = np.random.default_rng(seed)
            sp[:, 2 * i] = np.repeat(_reachable(plant, set_points, rng), hold, axis=0)
            sp[:, 2 * i + 1] = first
            steps = size * rng.choice([-1.0, 0.0, 1.0], (set_points, len(mv0)))
            load[:, 2 * i + 1] = np.repeat(steps, hold, axis=0)
        rows = 2 * len(seeds)
        return cls(plant, hold, sp, np.tile(x0, (rows, 1)), np.tile(mv0, (rows, 1)), load)

    def run(self, step: LawStep, n_state: int, candidates: int = 1, *, time_weighted: bool = False) -> LoopCosts:
        """Errors, travel and cost of each candidate over all sequences.

        ``time_weighted`` multiplies each error by the periods since its set point moved, which makes
        of the mean an ITAE: a slow or swinging end then counts for more than the unavoidable beginning.
        ``step`` takes shapes (candidates, s, .): a law whose numbers have a leading dimension
        of candidates. The error of a sample counts before that sample's move acts. A candidate
        whose loop is not finite has an infinite cost. Several CVs count in shares of their ranges, as their sum.
        Where the plant has measurement noise, the law is given it, and the cost has the price ``MOVE_COST`` of the MVs'
        travel beside the error, both in shares of their ranges.
        """
        n, s, n_cv = self.sp.shape
        plant, sd = self.plant, self.plant.noise_std
        noise = sd * coloured(np.random.default_rng(0).standard_normal((n, s, len(sd))), plant.noise_colour)
        spans = np.array([s.high - s.low for s in plant.sp_signals])
        reach = np.array([s.high - s.low for s in plant.mv_signals])
        weights = spans[0] / spans
        lanes = (candidates, s)
        x0, mv0 = np.tile(self.x0, (candidates, 1)), np.tile(self.mv0, (candidates, 1, 1))
        loops, error, moved = BatchLoops(plant, step, n_state, lanes, x0, mv0), np.zeros(lanes), np.zeros(lanes)
        for k in range(n):
            pv = loops.measured()
            late = k % self.hold if time_weighted else 1
            error += late * np.abs(self.sp[k] - pv[..., :n_cv]) @ weights
            before = loops.mv
            loops.step(torch.from_numpy(self.sp[k]).expand(*lanes, n_cv), pv + noise[k], self._load(k))
            moved += (loops.mv - before).abs().numpy() @ (1 / reach)
        price = MOVE_COST * spans[0] * bool(sd.any())
        cost = (error + price * moved).mean(axis=1) / n
        return LoopCosts(np.where(np.isfinite(cost), cost, np.inf), error / n, 100 * moved / (n * len(reach)))

    def _load(self, k: int) -> Array | None:
        return None if self.load is None else self.load[k]


def _check(seeds: tuple[int, ...], set_points: int, hold: int) -> None:
    if not seeds or set_points < 1 or hold < 1:
        raise PlantError(f"development loops need seeds, set points and a hold; got {seeds}, {set_points} and {hold}")


def _reachable(plant: Simulator, set_points: int, rng: np.random.Generator) -> Array:
    """Set points (set_points, n_cv) at which the plant rests under MVs within their ranges."""
    mv_low, mv_high = (np.array([getattr(s, end) for s in plant.mv_signals]) for end in ("low", "high"))
    low, high = plant.asked
    inset, count, resting = MV_END_MARGIN * (mv_high - mv_low), DRAWN * set_points, plant.foreseen or DEVELOPMENT_REST
    mv = rng.uniform(mv_low + inset, mv_high - inset, (count, len(mv_low)))
    x, advance, late = np.tile(plant.start[0], (count, 1)), plant.many(count), np.empty(0)
    with np.errstate(all="ignore"):  # an integrator may run away
        for k in range(resting):
            x = advance(x, mv)
            if k == resting - resting // 5:
                late = plant.measured(x)[:, : len(low)]
    ends = plant.measured(x)[:, : len(low)]
    restless = np.median(np.abs(ends - late), axis=0) > NOT_AT_REST * (high - low)
    ends = np.where(restless | ~np.isfinite(ends), rng.uniform(low, high, ends.shape), ends)
    # Uniform over the set points' ranges, not over the MVs': each the nearest rest of a point that is drawn there.
    ends = np.clip(ends, low, high)
    wanted = rng.uniform(ends.min(axis=0), ends.max(axis=0), (set_points, len(low)))
    apart = np.abs((wanted[:, None] - ends) / (high - low)).sum(axis=2)
    return np.asarray(ends[apart.argmin(axis=1)])


Loops = tuple[PidSettings, ...]
"""Settings of each loop."""

Cost = Callable[[Sequence[Loops]], Array]
"""Costs of candidates, infinite where a loop breaks, all at once."""

SPEEDS = tuple(np.geomspace(0.5, 32.0, 10))  # closed-loop time constants, in dead times and periods
WEIGHTS = (1.0, 0.7, 0.4)  # set-point weights that are tried first, common to all loops
FIRST_GAINS, FIRST_INTEGRALS = (0.5, 0.7, 1.0, 1.4, 2.0), (0.4, 0.63, 1.0, 1.6, 2.5)  # factors, in the first round
DERIVATIVES, FILTERS = (0.0, 0.07, 0.15, 0.3), (0.125, 0.5)  # Td of Ti, Tf of Td
# factors of gains and integral times about the best ones, in the second round
SECOND_FACTORS = (0.8, 0.9, 1.0, 1.11, 1.25)
FINE_WEIGHTS = (
    0.2,
    0.3,
    0.5,
    0.6,
    0.8,
    0.9,
    1.0,
)  # set-point weights tried for each loop by itself, last in a round

# of a PI of last resort; half the gain is a gain margin twice the tuned loop's, and twice the plant's gain has a test
CALM_GAIN = 0.5
CALM_LAGS = 1.0  # time constants: as slow as the plant by itself, which no error of the model makes swing
CALM_DEAD_TIMES = 4.0  # dead times and periods: four times what a tight loop has


def simc(process: FirstOrder, period_s: float, tau_c_s: float) -> PidSettings:
    """The PI for a lag or an integrator with dead time, the sampling counted as half a period of dead time.

        Kc = 1/(rate (tau_c + theta)),   Ti = min(tau, 4 (tau_c + theta))

    Source: Skogestad, Simple analytic rules for model reduction and PID controller tuning, 2003.
    """
    closed = tau_c_s + process.dead_time_s + period_s / 2
    return PidSettings(1 / (process.rate * closed), min(process.tau_s, 4 * closed))


def calm(processes: Sequence[FirstOrder], period_s: float, tuned: Loops) -> Loops:
    """A PI for each loop, of half the tuned gain at most, and no faster than the plant itself: the last resort.

    A lag is controlled with a closed-loop time constant of ``CALM_LAGS`` of its own, and each process of at least
    ``CALM_DEAD_TIMES`` dead times and periods. Integral times are no shorter than the tuned ones. The tuned set-point
    weights and tracking times stay.
    """
    found = []
    for process, now in zip(processes, tuned, strict=True):
        slow = CALM_DEAD_TIMES * (process.dead_time_s + period_s)
        pi = simc(process, period_s, max(slow, CALM_LAGS * process.tau_s) if isfinite(process.tau_s) else slow)
        gain = min(abs(pi.kc), CALM_GAIN * abs(now.kc))
        calmer = replace(now, kc=copysign(gain, now.kc), ti_s=max(pi.ti_s, now.ti_s), td_s=0.0, filter_s=0.0)
        found.append(calmer)
    return tuple(found)


def searched(
    processes: Sequence[FirstOrder], period_s: float, cost: Cost, base: PidSettings, weight: float | None
) -> tuple[float, Loops]:
    """(cost, settings): all loops at the same speed at first, then each loop's numbers in turn, twice.

    ``processes`` are those of the pairs. ``weight`` is the set-point weight, None: chosen too. ``base`` gives the
    tracking time. Raises LawError where every candidate's cost is infinite.
    """
    show, rounds = steps("tuning in closed loops", 1 + 2 * len(processes)), 1
    weights = WEIGHTS if weight is None else (weight,)

    def common(speed: float, b: float) -> Loops:
        each = (simc(p, period_s, speed * (p.dead_time_s + period_s)) for p in processes)
        return tuple(replace(s, set_point_weight=b, tracking_s=base.tracking_s) for s in each)

    best = _cheapest(cost, [common(s, b) for s in SPEEDS for b in weights], (np.inf, ()))
    if not np.isfinite(best[0]):
        raise LawError("no PID gave a finite closed loop; check the MV's range or tune by hand (`manual`)")
    show(rounds)
    for gains, integrals in ((FIRST_GAINS, FIRST_INTEGRALS), (SECOND_FACTORS, SECOND_FACTORS)):
        for i in range(len(processes)):
            now = best[1][i]
            rows = [replace(now, kc=now.kc * g, ti_s=now.ti_s * t) for g in gains for t in integrals]
            best = _cheapest(cost, _others(best[1], i, rows), best)
            now = best[1][i]
            rows = [replace(now, td_s=d * now.ti_s, filter_s=f * d * now.ti_s) for d in DERIVATIVES for f in FILTERS]
            best = _cheapest(cost, _others(best[1], i, rows), best)
            if weight is None:
                rows = [replace(best[1][i], set_point_weight=b) for b in FINE_WEIGHTS]
                best = _cheapest(cost, _others(best[1], i, rows), best)
            rounds += 1
            show(rounds)
    return best


def _others(loops: Loops, i: int, rows: Iterable[PidSettings]) -> list[Loops]:
    return [(*loops[:i], row, *loops[i + 1 :]) for row in rows]


def _cheapest(cost: Cost, rows: list[Loops], best: tuple[float, Loops]) -> tuple[float, Loops]:
    costs = cost(rows)
    at = int(costs.argmin())
    return (float(costs[at]), rows[at]) if costs[at] < best[0] else best
