"""What no controller can beat by much: perfect-model NMPC and the offline optimum.

Both know the plant exactly, its parameters at every sample included, and its whole state.

NMPC sees the set point of now and no later one, and thinks that it stays; likewise the parameters.
The offline optimum takes each hold by itself, from the state where it left the one before, with the
hold's whole course of parameters and ``TAIL`` samples more of the same set point, so that a hold
ends at rest. It does not see the next set point either: with that preview a test of steps gets
a lower bound, which no controller of the tests could use. It is the best of several locally
best plans, and its figures are those of its own prediction.

``python -m pipeline.oracle CASE`` computes both for every scenario of a case, NMPC also with
measurement noise, and stores them in ``pipeline/cases/<case>.bounds.json``, from where
``pipeline.bounds.load_bounds`` gives them as long as neither the plant nor the scenario has changed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pipeline.bounds import SCHEMA, bounds_path, load_bounds, plant_digest, read_stored
from pipeline.cases import CASES, Case, Scenario
from pipeline.errors import PlantError
from pipeline.horizon import Horizon, Plan
from pipeline.metrics import closed_loop_metrics
from pipeline.plants.base import Plant
from pipeline.simulate import noise_draws
from serving.errors import LoopwrightError

__all__ = ["Job", "PerfectNmpc", "compute", "load_bounds", "main", "run_nmpc", "run_offline", "search"]

Array = NDArray[np.float64]

HORIZON = 40  # periods that the NMPC looks ahead; with 20 it does 2 % worse, with 60 half a percent better
REACHES = (1, 2, 3)  # of the rollouts that a fresh search starts from
TAIL = 20
NOISE_SEED = 20_000  # plus the index of the sequence


class PerfectNmpc:
    """NMPC whose model is the plant: ``step`` gives the MV for one sample.

    A new set point starts a fresh search from several rollouts, because plans that ignite the
    reaction at different samples are different local optima; every other sample continues the
    plan of the one before. A sample at which nothing can be solved applies that plan's next move
    and counts in ``failures``.
    """

    def __init__(self, plant: Plant, horizon: int = HORIZON) -> None:
        self.plant = plant
        self._horizon = Horizon(plant, horizon)
        self._simulate = plant.stepper()
        self.reset()

    def reset(self) -> None:
        """Forget the past: plan, set point and the count of failures."""
        self.failures = 0
        self._plan: Plan | None = None
        self._sp: Array | None = None

    def step(self, x: Array, sp: Array, parameters: Array | None = None) -> Array:
        """The MV, shape (n_mv,), for state ``x`` (n_x,) and set point ``sp`` (n_sp,).

        ``parameters`` (n_p,) are the plant's true ones at this sample; by default its nominal ones.
        """
        n = self._horizon.n
        target = np.tile(np.atleast_1d(np.asarray(sp, dtype=np.float64)), (n, 1))
        p = np.tile(self.plant.parameters() if parameters is None else parameters, (n, 1))
        plan = None
        if self._plan is not None and self._sp is not None and np.array_equal(self._sp, target[0]):
            plan = self._horizon.solve(x, target, p, self._horizon.shifted(self._plan))
        if plan is None or not plan.solved:
            plan = search(self._horizon, x, target, p, self._simulate)
            if not plan.solved:
                self.failures += 1
                if self._plan is not None:
                    plan = self._horizon.shifted(self._plan)
        self._plan, self._sp = plan, target[0]
        return plan.mv[0]


def search(horizon: Horizon, x: Array, sp: Array, p: Array, simulate: Callable[..., Array]) -> Plan:
    """The best plan found from several rollouts; the best rollout itself where none was solved."""
    starts = [horizon.rollout(x, sp, p, reach, simulate) for reach in REACHES]
    plans = [horizon.solve(x, sp, p, start) for start in starts]
    return min([plan for plan in plans if plan.solved] or starts, key=lambda plan: plan.cost)


@dataclass(frozen=True, slots=True)
class Job:
    """One figure to compute."""

    scenario: Scenario
    index: int  # among the sequences of its name
    kind: str  # nmpc, nmpc_noise, offline


def run_nmpc(
    nmpc: PerfectNmpc, scenario: Scenario, noise_std: Sequence[float] | None = None, seed: int = 0
) -> dict[str, float]:
    """Closed-loop metrics of the NMPC, its failures and its processor time a step.

    The noise, one standard deviation a PV, reaches only the NMPC, which has no filter. Raises
    PlantError for noise on a plant whose PVs are not its states.
    """
    plant = nmpc.plant
    if noise_std is not None and type(plant).output is not Plant.output:
        raise PlantError(f"plant {plant.name!r} measures other things than its states; its NMPC cannot be given noise")
    rng = np.random.default_rng(seed)
    noise = np.zeros((scenario.samples, len(scenario.x0)))
    if noise_std is not None:
        noise = noise_draws(plant, scenario.samples, noise_std, rng)
    nmpc.reset()
    simulate, parameters = plant.stepper(), scenario.parameters(plant)
    x, cv, mv, times = scenario.x0, [], [], []
    for sp, p, error in zip(scenario.sp, parameters, noise, strict=True):
        cv.append(np.array(plant.measure(x))[: scenario.sp.shape[1], 0])
        begun = time.process_time()
        mv.append(nmpc.step(x + error, sp, p))
        times.append(1e3 * (time.process_time() - begun))
        x = simulate(x, mv[-1], plant.dv_nominal, p)
    span = plant.sp_signals[0].high - plant.sp_signals[0].low
    found = closed_loop_metrics(scenario.sp, np.array(cv), np.array(mv), scenario.hold, plant.period_s, span)
    found |= {"failures": float(nmpc.failures)}
    return found | {f"step_ms_p{q}": float(np.percentile(times, q)) for q in (50, 99)}


def run_offline(plant: Plant, scenario: Scenario, elements: int = 6) -> dict[str, float]:
    """Closed-loop metrics of the offline optimum, and how many holds were not solved."""
    hold, simulate = scenario.hold or scenario.samples, plant.stepper()
    horizon = Horizon(plant, hold + TAIL, elements=elements)
    everything = scenario.parameters(plant)
    x, cv, mv, failures = scenario.x0, [], [], 0
    for k in range(0, scenario.samples, hold):
        target = np.tile(scenario.sp[k], (horizon.n, 1))
        p = everything[np.minimum(np.arange(k, k + horizon.n), scenario.samples - 1)]
        plan = search(horizon, x, target, p, simulate)
        failures += not plan.solved
        cv.append(np.array(plant.measure(plan.x[:hold].T)).T[:, : target.shape[1]])
        mv.append(plan.mv[:hold])
        x = plan.x[hold]
    span = plant.sp_signals[0].high - plant.sp_signals[0].low
    found = closed_loop_metrics(scenario.sp, np.vstack(cv), np.vstack(mv), scenario.hold, plant.period_s, span)
    return found | {"failures": float(failures)}


def _compute(case: Case, job: Job) -> tuple[Job, dict[str, float], float]:
    begun = time.perf_counter()
    with threadpool_limits(1):
        if job.kind == "offline":
            figures = run_offline(case.plant, job.scenario)
        else:
            noise = case.noise_std.tolist() if job.kind == "nmpc_noise" else None
            figures = run_nmpc(PerfectNmpc(case.plant, HORIZON), job.scenario, noise, NOISE_SEED + job.index)
    return job, figures, time.perf_counter() - begun


def compute(case: Case, names: list[str], jobs: int = 1, path: Path | None = None) -> Iterator[str]:
    """Compute and store the bounds of some scenarios; yields a line for a person after each figure.

    Every figure is stored at once, so an interruption loses only the figure in work.
    """
    path = path or bounds_path(case)
    stored = read_stored(path)
    digest = plant_digest(case.plant)
    if stored.get("plant") != digest or stored.get("horizon") != HORIZON:
        stored = {"schema": SCHEMA, "case": case.name, "plant": digest, "horizon": HORIZON, "figures": {}}
    scenarios = case.scenarios()
    work = [
        Job(s, i, kind)
        for name in names
        for i, s in enumerate(scenarios[name])
        for kind in ("nmpc", "nmpc_noise", "offline")
    ]
    results = Parallel(n_jobs=jobs, return_as="generator_unordered")(delayed(_compute)(case, job) for job in work)
    for done, (job, figures, seconds) in enumerate(results, start=1):
        rounded = {key: float(f"{value:.6g}") for key, value in figures.items()}
        entry = stored["figures"].setdefault(job.scenario.name, {}).setdefault(job.scenario.digest(), {})
        entry[job.kind] = rounded
        draft = path.with_suffix(".draft")
        draft.write_text(json.dumps(stored, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(draft, path)
        which = f"{job.scenario.name} {job.index} {job.kind}"
        yield f"[{done}/{len(work)}] {which}: mae {rounded['mae']:.5f} ({seconds:.0f} s)"


def main(arguments: list[str] | None = None) -> int:
    """Compute and store the bounds of a case."""
    parser = argparse.ArgumentParser(prog="python -m pipeline.oracle", description=main.__doc__)
    parser.add_argument("case", choices=sorted(CASES))
    parser.add_argument("--scenario", action="append", help="only this one (may be given again)")
    parser.add_argument("--jobs", type=int, default=1, help="processes side by side")
    given = parser.parse_args(arguments)
    case = CASES[given.case]
    names = given.scenario or list(case.scenarios())
    unknown = sorted(set(names) - set(case.scenarios()))
    if unknown:
        parser.error(f"case {case.name!r} has no scenario {unknown[0]!r}; it has {', '.join(case.scenarios())}")
    try:
        for line in compute(case, names, given.jobs):
            print(line, flush=True)
    except (LoopwrightError, OSError) as error:
        print(f"python -m pipeline.oracle: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
