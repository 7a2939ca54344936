"""What no controller can beat by much: perfect-model NMPC and the offline optimum.

Both know the plant exactly, its parameters at every sample included, and its whole state.

NMPC sees the set point of now and no later one, and thinks that it stays; likewise the parameters.
Where a case's disturbances are unforeseen, it knows the parameters of the period before instead,
as a perfect observer tells them from what that period did: with those of now, a disturbance would
cost it nothing.
The offline optimum takes each set point by itself, from the state where it left the one before,
with the whole course of parameters and ``TAIL`` samples more of the same set point, so that it
ends at rest. It does not see the next set point either: with that preview a test of steps gets
a lower bound, which no controller of the tests could use. It is the best of several locally
best plans, and its figures are those of its own prediction.

A case whose set point follows a recipe is another matter: its controllers may know the course, so
NMPC sees it as far as it looks ahead, and the offline optimum is one plan for the whole test.

Both minimize the case's metric: absolute or squared errors.

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

from pipeline.bounds import (
    DEFAULTS,
    SCHEMA,
    bounds_path,
    kinds,
    load_bounds,
    measures_states,
    problem,
    read_stored,
    together,
)
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
NOISE_SEED = 20_000  # plus the index of the sequence, and DRAW for every further draw
DRAW = 1_000


class PerfectNmpc:
    """NMPC whose model is the plant: ``step`` gives the MV for one sample.

    A set point that the last step did not expect starts a fresh search from several rollouts,
    because plans that ignite the reaction at different samples are different local optima; every
    other sample continues the plan of the one before. A sample at which nothing can be solved
    applies that plan's next move and counts in ``failures``.
    """

    def __init__(self, plant: Plant, horizon: int = HORIZON, metric: str = "mae") -> None:
        self.plant = plant
        self._horizon = Horizon(plant, horizon, metric=metric)
        self._simulate = plant.stepper()
        self.reset()

    def reset(self) -> None:
        """Forget the past: plan, set points and the count of failures."""
        self.failures = 0
        self._plan: Plan | None = None
        self._target: Array | None = None

    def step(self, x: Array, sp: Array, parameters: Array | None = None) -> Array:
        """The MV, shape (n_mv,), for state ``x`` (n_x,) and set point ``sp`` (n_sp,).

        ``sp`` may also be the course of the set point from the next sample on, shape (m, n_sp),
        whose last row stays. ``parameters`` (n_p,) are the plant's true ones at this sample; by
        default its nominal ones.
        """
        n = self._horizon.n
        course = np.atleast_2d(np.asarray(sp, dtype=np.float64))
        target = course[np.minimum(np.arange(n), len(course) - 1)]
        p = np.tile(self.plant.parameters() if parameters is None else parameters, (n, 1))
        plan = None
        if self._plan is not None and self._target is not None and np.array_equal(self._target[1:], target[:-1]):
            plan = self._horizon.solve(x, target, p, self._horizon.shifted(self._plan))
        if plan is None or not plan.solved:
            plan = search(self._horizon, x, target, p, self._simulate)
            if not plan.solved:
                self.failures += 1
                if self._plan is not None:
                    plan = self._horizon.shifted(self._plan)
        self._plan, self._target = plan, target
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
    nmpc: PerfectNmpc,
    scenario: Scenario,
    noise_std: Sequence[float] | None = None,
    seed: int = 0,
    recipe: bool = False,
    unforeseen: bool = False,
) -> dict[str, float]:
    """Closed-loop metrics of the NMPC, its failures and its processor time a step.

    The noise, one standard deviation a PV, reaches only the NMPC, which has no filter. With
    ``recipe`` it sees the set points to come; ``unforeseen`` parameters it knows one sample late,
    the first ones from the start. Raises PlantError for noise on a plant whose PVs are not its
    states.
    """
    plant = nmpc.plant
    if noise_std is not None and not measures_states(plant):
        raise PlantError(f"plant {plant.name!r} measures other things than its states; its NMPC cannot be given noise")
    rng = np.random.default_rng(seed)
    noise = np.zeros((scenario.samples, len(scenario.x0)))
    if noise_std is not None:
        noise = noise_draws(plant, scenario.samples, noise_std, rng)
    nmpc.reset()
    simulate, parameters = plant.stepper(), scenario.parameters(plant)
    known = parameters[np.maximum(np.arange(scenario.samples) - unforeseen, 0)]
    x, cv, mv, times = scenario.x0, [], [], []
    for k, (p, error) in enumerate(zip(parameters, noise, strict=True)):
        sp = scenario.sp[min(k + 1, scenario.samples - 1) :] if recipe else scenario.sp[k]
        cv.append(np.array(plant.measure(x))[: scenario.sp.shape[1], 0])
        begun = time.process_time()
        mv.append(nmpc.step(x + error, sp, known[k]))
        times.append(1e3 * (time.process_time() - begun))
        x = simulate(x, mv[-1], plant.dv_nominal, p)
    found = _figures(plant, scenario, np.array(cv), np.array(mv)) | {"failures": float(nmpc.failures)}
    return found | {f"step_ms_p{q}": float(np.percentile(times, q)) for q in (50, 99)}


def run_offline(
    plant: Plant, scenario: Scenario, elements: int = 6, metric: str = "mae", recipe: bool = False
) -> dict[str, float]:
    """Closed-loop metrics of the offline optimum, and how many of its plans were not solved.

    There is one plan for every stretch of equal set points, or a single one for a ``recipe``,
    which ends with its last sample: nothing comes after it that it must be at rest for.
    """
    edges = [0] if recipe else [0, *np.flatnonzero(np.any(np.diff(scenario.sp, axis=0) != 0, axis=1)) + 1]
    lengths = np.diff([*edges, scenario.samples])
    horizon = Horizon(plant, int(lengths.max()) + (0 if recipe else TAIL), metric=metric, elements=elements)
    everything, simulate = scenario.parameters(plant), plant.stepper()
    x, cv, mv, failures = scenario.x0, [], [], 0
    for k, length in zip(edges, lengths, strict=True):
        ahead = k + np.arange(horizon.n)
        target = scenario.sp[np.minimum(ahead + 1, k + length - 1)]
        p = everything[np.minimum(ahead, scenario.samples - 1)]
        plan = search(horizon, x, target, p, simulate)
        failures += not plan.solved
        cv.append(np.array(plant.measure(plan.x[:length].T)).T[:, : target.shape[1]])
        mv.append(plan.mv[:length])
        x = plan.x[length]
    return _figures(plant, scenario, np.vstack(cv), np.vstack(mv)) | {"failures": float(failures)}


def _figures(plant: Plant, scenario: Scenario, cv: Array, mv: Array) -> dict[str, float]:
    span = plant.sp_signals[0].high - plant.sp_signals[0].low
    return closed_loop_metrics(scenario.sp, cv, mv, scenario.hold, plant.period_s, span, scenario.late_from)


def _compute(case: Case, job: Job) -> tuple[Job, dict[str, float], float]:
    begun = time.perf_counter()
    with threadpool_limits(1):
        if job.kind == "offline":
            figures = run_offline(case.plant, job.scenario, metric=case.metric, recipe=case.recipe)
        else:
            nmpc = PerfectNmpc(case.plant, HORIZON, case.metric)
            noise, draws = (case.noise_std.tolist(), case.noise_draws) if job.kind == "nmpc_noise" else (None, 1)
            seeds = [NOISE_SEED + job.index + DRAW * draw for draw in range(draws)]
            know = (case.recipe, case.unforeseen)
            figures = together([run_nmpc(nmpc, job.scenario, noise, seed, *know) for seed in seeds])
    return job, figures, time.perf_counter() - begun


def compute(case: Case, names: list[str], jobs: int = 1, path: Path | None = None) -> Iterator[str]:
    """Compute and store the bounds of some scenarios; yields a line for a person after each figure.

    Every figure is stored at once, so an interruption loses only the figure in work.
    """
    path = path or bounds_path(case)
    stored = read_stored(path)
    current = problem(case) | {"horizon": HORIZON}
    if any((DEFAULTS | stored).get(key) != value for key, value in current.items()):
        stored = {"schema": SCHEMA, "case": case.name, **current, "figures": {}}
    scenarios = case.scenarios()
    work = [Job(s, i, kind) for name in names for i, s in enumerate(scenarios[name]) for kind in kinds(case)]
    results = Parallel(n_jobs=jobs, return_as="generator_unordered")(delayed(_compute)(case, job) for job in work)
    for done, (job, figures, seconds) in enumerate(results, start=1):
        rounded = {key: float(f"{value:.6g}") for key, value in figures.items()}
        entry = stored["figures"].setdefault(job.scenario.name, {}).setdefault(job.scenario.digest(), {})
        entry[job.kind] = rounded
        draft = path.with_suffix(".draft")
        draft.write_text(json.dumps(stored, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(draft, path)
        which = f"{job.scenario.name} {job.index} {job.kind}"
        yield f"[{done}/{len(work)}] {which}: {case.metric} {rounded[case.metric]:.6g} ({seconds:.0f} s)"


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
