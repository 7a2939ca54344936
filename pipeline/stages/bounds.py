"""What no controller can beat by much: perfect-model NMPC and the offline optimum.

``pipeline.optimal.perfect`` says what they know and what they do not.

A plant with a discrete MV is replaced by its ``relaxed()``, the figures' MVs being those that stand
for its own. A test on a plant in discrete time has no bounds.

``loopwright bounds CASE`` computes both for every scenario of a case, NMPC also with
measurement noise, and stores them in ``pipeline/cases/<case>.bounds.json``, from where
``pipeline.optimal.bounds.load_bounds`` gives them as long as neither the plant nor the scenario has changed.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from pipeline.evaluation.case import Case
from pipeline.optimal.bounds import DEFAULTS, SCHEMA, bounded, bounds_path, kinds, problem, read_stored, together
from pipeline.optimal.perfect import PerfectNmpc, run_nmpc, run_offline
from pipeline.plants.equations import equations
from pipeline.simulation.scenario import Scenario

NOISE_SEED = 20_000  # plus the index of the sequence, and DRAW for every further draw
DRAW = 1_000


@dataclass(frozen=True, slots=True)
class Job:
    """One figure to compute."""

    scenario: Scenario
    index: int  # among the sequences of its name
    kind: str  # nmpc, nmpc_noise, offline


def _compute(case: Case, job: Job) -> tuple[Job, dict[str, float], float]:
    begun = time.perf_counter()
    plant = equations(job.scenario.plant or case.plant, f"a bound of case {case.name!r}").relaxed()
    ahead = case.recipe or case.metric == "tracking"
    with threadpool_limits(1):
        if job.kind == "offline":
            figures = run_offline(plant, job.scenario, case.metric, ahead, case.effort, case.score, case.limits)
        else:
            nmpc = PerfectNmpc(plant, case.metric, case.effort, case.limits)
            noise, draws = (case.noise_std.tolist(), case.noise_draws) if job.kind == "nmpc_noise" else (None, 1)
            seeds = [NOISE_SEED + job.index + DRAW * draw for draw in range(draws)]
            know = (ahead, case.unforeseen, case.score)
            figures = together([run_nmpc(nmpc, job.scenario, noise, seed, *know) for seed in seeds])
    return job, figures, time.perf_counter() - begun


def _current(rows: dict[str, Any], tests: Sequence[Scenario]) -> dict[str, Any]:
    """Of the figures stored of a test, those that a case may still have: of random sequences, all."""
    return {digest: row for digest, row in rows.items() if tests[0].seed is not None or digest == tests[0].digest()}


def compute(case: Case, names: list[str], jobs: int = 1, path: Path | None = None) -> Iterator[str]:
    """Compute and store the bounds of some scenarios; yields a line for a person after each figure.

    Every figure is stored at once, so an interruption loses only the figure in work.
    """
    path = path or bounds_path(case)
    stored = read_stored(path)
    current = problem(case)
    if any((DEFAULTS | stored).get(key) != value for key, value in current.items()):
        stored = {"schema": SCHEMA, "case": case.name, **current, "figures": {}}
    scenarios = case.scenarios()
    stored["figures"] = {n: _current(rows, scenarios[n]) for n, rows in stored["figures"].items() if n in scenarios}
    work = [
        Job(s, i, kind)
        for name in names
        if bounded(case, scenarios[name])
        for i, s in enumerate(scenarios[name])
        for kind in kinds(case)
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
        yield f"[{done}/{len(work)}] {which}: {case.metric} {rounded[case.metric]:.6g} ({seconds:.0f} s)"
