"""The closed loops of one exported file over a test, and what a trial of all tests finds."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import numpy as np

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.closed_loop import left_limits, lock_ups, swings
from loopwright.pipeline.evaluation.knowing_control import reached
from loopwright.pipeline.evaluation.law_evidence import Cycle
from loopwright.pipeline.evaluation.limit_cycle import cycle_of
from loopwright.pipeline.evaluation.metric import mean_of_draws
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import DV_DRAW, Trajectory, disturbance_noise, simulate_closed
from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopwrightError

Metrics = dict[str, float]
ROUNDS = 8  # of timing a step
TIMED = 1_000  # samples of a round
DRAW = 1_000  # added to the noise's seed for every further draw of it
DEVELOPED: Final = "development"  # stands for all development sequences among the names of tests
DEVELOPMENT = 100_000  # added to the noise's seed over the development sequences


@dataclass(frozen=True)
class Trial:
    """One file's closed loops: figures by scenario (noisy ones under their own names), curves, faults."""

    form: str
    seed: int
    info: tuple[str, ...]
    metrics: dict[str, Metrics]
    sequences: dict[str, dict[str, Metrics]]  # of the tests with several sequences, by their seeds
    development: float  # the case's metric over the development sequences, see ``Case.developed``
    locked_up: dict[str, int]  # test -> closed loops that locked up, of those where any did; DEVELOPED: development
    swings: dict[str, int]  # the same of closed loops that swing to the end
    beyond_reach: dict[str, int]  # test -> holds that count as no lock-up, because no control gets to the set point
    curves: dict[str, Trajectory]
    reached: dict[str, tuple[float, float]]  # without noise, models gone wrong apart, PVs and MVs; of a case on models
    cycles: dict[str, Cycle]  # test -> its worst limit cycle, without noise; of a case on models alone
    cycling: Trajectory | None  # the loop with the worst of them

    @property
    def lock_ups(self) -> int:
        """Closed loops that locked up, those of the development included."""
        return sum(self.locked_up.values())

    @property
    def development_lock_ups(self) -> int:
        """The ones of these over the development sequences."""
        return self.locked_up.get(DEVELOPED, 0)


@dataclass(frozen=True)
class Repeated:
    """One test, repeated with different noise where it is noisy: mean figures, the first loop.

    And of all the lock-ups, those that swing to the end, and the holds whose set point is beyond reach; without noise,
    on models, the limit cycle.
    """

    metrics: Metrics
    first: Trajectory
    lock_ups: int
    swings: int
    beyond_reach: int = 0
    cycle: Cycle | None = None


def repeated(controller: Controller, case: Case, test: Scenario, noise: bool, seed: int) -> Repeated:
    """One test; with noise it runs ``noise_draws`` times."""
    draws = range(case.noise_draws if noise else 1)
    loops = [close_loop(controller, case, test, case.noise_std if noise else None, seed + DRAW * i) for i in draws]
    rows = [case.score(test, loop.pv, loop.mv) for loop in loops]
    found = [seized(case, test, loop) for loop in loops]
    swing = sum(swings_on(case, test, loop) for loop in loops)
    cycle = cycle_of(case, test, loops[0]) if case.on_models and not noise and not test.replayed else None
    return Repeated(
        mean_of_draws(rows),
        loops[0],
        sum(jammed for jammed, _ in found),
        max(swing, int(cycle is not None)),
        sum(holds for _, holds in found),
        cycle,
    )


def close_loop(controller: Controller, case: Case, test: Scenario, noise: Array | None, seed: int) -> Trajectory:
    """One closed loop; an extra entry of info is 1 if the controller refused the step.

    The MV then stays at its last value, as in the real loop's HOLD. With noise, measured disturbances have theirs.
    """
    plant, state = test.plant or case.plant, controller.cold_state()
    disturbances = test.disturbances(plant)
    if noise is not None:
        disturbances = disturbances + disturbance_noise(plant, test.samples, np.random.default_rng([seed, DV_DRAW]))
    measured = iter(disturbances)
    n_info = len(controller.manifest.info)

    def step(sp: Array, pv: Array, mv_applied: Array) -> tuple[Array, tuple[float, ...]]:
        nonlocal state
        dv = next(measured)
        try:
            mv, state, info = controller.step(sp=sp, pv=pv, dv=dv, mv_applied=mv_applied, state=state)
        except LoopwrightError:
            state = controller.cold_state()
            return mv_applied, (*(0.0 for _ in range(n_info)), 1.0)
        return mv, (*info.tolist(), 0.0)

    return simulate_closed(plant, step, test, noise=noise, seed=seed)


def seized(case: Case, test: Scenario, loop: Trajectory) -> tuple[bool, int]:
    """(whether the loop locked up, holds in which it is at an end because its set point is beyond reach).

    It locks up at an end of an MV, or where the controller refused a step: one refuses to give an MV beyond its range.
    Where the tests run on models, a CV far beyond its range counts too: equations hold far from where they were meant,
    a model of a record does not.

    On a model of a record a hold counts only where a control that knows the model comes near the set point within the
    hold, from the same state: a plant gone wrong may not get there at all.
    """
    n = test.sp.shape[1]
    # As many MVs as set points; a further one may have a part that rests at an end.
    mvs, spans = case.plant.mv_signals[:n], [s.high - s.low for s in case.plant.sp_signals]
    limits = {end: [getattr(s, end) for s in mvs] for end in ("low", "high")}
    jammed = lock_ups(loop.sp, loop.pv[:, :n], loop.mv[:, :n], test.hold, **limits, span=spans)
    plant, beyond = test.plant or case.plant, list[slice]()
    if case.on_models and isinstance(plant, IdentifiedPlant):
        before = np.vstack([test.mv0, loop.mv])  # the MVs at the beginning of each sample
        beyond = [of for of in jammed if not reached(plant, test, of, loop.x[of.start], before[of.start]).near]
    ends = {end: [getattr(s, end) for s in case.plant.sp_signals] for end in ("low", "high")}
    left = case.on_models and left_limits(loop.pv[:, :n], test.hold, **ends)
    return len(jammed) > len(beyond) or left or bool(loop.info[:, -1].any()), len(beyond)


def swings_on(case: Case, test: Scenario, loop: Trajectory) -> bool:
    """Whether a controlled variable swings about its set point to the end of the test; a replayed load may swing."""
    if test.replayed:
        return False
    return bool(swings(loop.sp, loop.pv[:, : test.sp.shape[1]], case.spans).any())


def step_us(controller: Controller, loop: Trajectory, dv: Array) -> dict[str, float]:
    """Time of one step along a loop under dv (n_dv,) [us], with all checks: the fastest of several rounds.

    A round is the loop's first 1,000 samples. Other processes can slow it down.
    """
    n = min(len(loop.sp), TIMED + 1)
    rounds = np.empty((ROUNDS, n - 1))
    for taken in rounds:
        state = controller.cold_state()
        for k in range(1, n):
            begun = time.perf_counter()
            sample = {"sp": loop.sp[k], "pv": loop.pv[k], "dv": dv, "mv_applied": loop.mv[k - 1]}
            state = controller.step(**sample, state=state).state
            taken[k - 1] = 1e6 * (time.perf_counter() - begun)
    p50, p99 = np.quantile(rounds, [0.5, 0.99], axis=1)
    best = int(np.argmin(p50))
    return {"p50": float(p50[best]), "p99": float(p99[best])}
