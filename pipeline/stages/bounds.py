"""Bounds that no controller can beat by much: perfect-model NMPC and the offline optimum.

``loopwright.pipeline.optimal.perfect`` says what they know and what they do not. A plant with a discrete MV is replaced
by its ``relaxed()``. The offline optimum is searched from the NMPC's moves too; where no plan is better than the NMPC,
the NMPC's figures stand for the optimum (``from_nmpc``).

``loopwright bounds CASE`` computes both for every scenario of a case, NMPC also with measurement noise, and
stores them beside the case. ``loopwright.pipeline.optimal.bounds.stored_bounds`` reads them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from loopwright.pipeline.engine.parallel import as_done
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.metric import DRAW_SEEDS, mean_of_draws
from loopwright.pipeline.files import write_text
from loopwright.pipeline.optimal.bounds import (
    BOUNDS_SCHEMA,
    DEFAULTS,
    bounded,
    bounds_path,
    kinds,
    problem,
    read_stored,
)
from loopwright.pipeline.optimal.perfect import PerfectNmpc, run_nmpc, run_offline
from loopwright.pipeline.plants.equations import equations
from loopwright.pipeline.simulation.scenario import Scenario

NOISE_SEED = 20_000  # plus the index of the sequence, and DRAW_SEEDS for every further draw


@dataclass(frozen=True, slots=True)
class Job:
    """Figures to compute together: the offline optimum starts from what the NMPC did."""

    scenario: Scenario
    index: int  # among the sequences of its name
    kinds: tuple[str, ...]  # (nmpc, offline), or (nmpc_noise,)


def _compute(case: Case, job: Job) -> tuple[Job, dict[str, dict[str, float]], float]:
    begun = time.perf_counter()
    plant = equations(job.scenario.plant or case.plant, f"a bound of case {case.name!r}").relaxed()
    ahead, criterion = case.foreseen, case.criterion
    first = job.kinds[0]
    nmpc = PerfectNmpc(plant, criterion, case.effort, case.limits)
    noise, draws = (case.noise_std.tolist(), case.noise_draws) if first == "nmpc_noise" else (None, 1)
    seeds = [NOISE_SEED + job.index + DRAW_SEEDS * draw for draw in range(draws)]
    know = (ahead, case.unforeseen, case.score)
    figures = {first: mean_of_draws(run_nmpc(nmpc, job.scenario, noise, seed, *know) for seed in seeds)}
    if "offline" in job.kinds:
        aim = (criterion, ahead, case.effort, case.score, case.limits)
        best = run_offline(plant, job.scenario, *aim, np.array(nmpc.moves))
        figures["offline"] = better(best, figures[first], case.metric)
    return job, figures, time.perf_counter() - begun


def better(offline: dict[str, float], nmpc: dict[str, float], metric: str) -> dict[str, float]:
    """The offline optimum's figures; the NMPC's, and ``from_nmpc`` 1, where they are better or the others no numbers.

    ``failures`` stays the number of offline plans that were not solved.
    """
    if offline[metric] <= nmpc[metric]:
        return offline
    return {key: nmpc[key] for key in offline} | {"failures": offline["failures"], "from_nmpc": 1.0}


def _remark(figures: dict[str, float]) -> str:
    """Doubts about an offline optimum, for a person to read; empty where there are none."""
    remarks = [f"{figures['failures']:.0f} plans were not solved"] if figures.get("failures") else []
    remarks += ["no plan was better than the NMPC, whose figures stand here"] if figures.get("from_nmpc") else []
    return f" - {'; '.join(remarks)}" if remarks else ""


def compute(case: Case, names: list[str], path: Path | None = None) -> Iterator[str]:
    """Compute and store the bounds of some scenarios; yields a line for a person for each figure.

    The line says where an offline optimum did not converge, or is the NMPC's.
    Every figure is stored at once, so an interruption loses only the figure in work.
    """
    path = path or bounds_path(case)
    stored, current, noisy_too = read_stored(path), problem(case), "nmpc_noise" in kinds(case)
    if any((DEFAULTS | stored).get(key) != value for key, value in current.items()):
        stored = {"schema": BOUNDS_SCHEMA, "case": case.name, **current, "figures": {}}
    scenarios = case.tests()
    # What no test can have any more is left out; of random sequences, all are kept.
    stored["figures"] = {
        name: {d: row for d, row in rows.items() if (s := scenarios[name][0]).seed is not None or d == s.digest()}
        for name, rows in stored["figures"].items()
        if name in scenarios
    }
    work = [
        Job(s, i, together)
        for name in names
        if bounded(case, scenarios[name])
        for i, s in enumerate(scenarios[name])
        for together in (("nmpc", "offline"), ("nmpc_noise",))[: 1 + noisy_too]
    ]
    for done, (_, (job, figures, seconds)) in enumerate(as_done(partial(_compute, case), work), start=1):
        entry = stored["figures"].setdefault(job.scenario.name, {}).setdefault(job.scenario.digest(), {})
        for kind, row in figures.items():
            entry[kind] = {key: float(f"{value:.6g}") for key, value in row.items()}
        write_text(path, json.dumps(stored, indent=1, sort_keys=True, allow_nan=False) + "\n")
        for kind in figures:
            which, figure = f"{job.scenario.name} {job.index} {kind}", entry[kind][case.metric]
            yield f"[{done}/{len(work)}] {which}: {case.metric} {figure:.6g} ({seconds:.0f} s){_remark(entry[kind])}"
