"""The bounds of a case that is tested on models: an NMPC that knows the model of each test, kept until that changes."""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.metric import together
from loopwright.pipeline.files import digest, read_json, write_json
from loopwright.pipeline.optimal.bounds import Bounds
from loopwright.pipeline.optimal.sampled import EVERY, HORIZON, SampledHorizon, run_sampled
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario

SCHEMA = 1
ANSWERS = 3  # a hold lasts so many times as long as an answer of the plant; without a hold, the whole test


def model_bounds(case: Case, kept: Path) -> Bounds:
    """Figures of the NMPC by test, of all tests that run on identified plants; ``kept`` is the file they stay in.

    The noise does not reach the NMPC, which is given the state: a test with noise has the bound of that without.
    """
    tests = {name: rows for name, rows in case.tests().items() if all(map(_on_model, rows)) and not rows[0].replayed}
    known, keys = _read(kept), {(name, i): _key(test) for name, rows in tests.items() for i, test in enumerate(rows)}
    work = [item for item, key in keys.items() if key not in known]
    # Sequences of one model follow each other: a process builds the problem of a model once.
    work.sort(key=lambda item: _plant_key(_plant(tests[item[0]][item[1]])))
    found = (
        parallel_map(partial(_bound, case), work, f"report {case.name}: the bound, control that knows the model (NMPC)")
        if work
        else []
    )
    known |= {keys[item]: figures for item, figures in zip(work, found, strict=True)}
    used = {key: known[key] for key in keys.values()}
    if work or set(used) != set(_read(kept)):
        write_json(kept, {"schema": SCHEMA, "figures": used})
    bounds: Bounds = {}
    for name, rows in tests.items():
        figures = together((used[keys[name, i]] for i in range(len(rows))), case.metrics)
        bounds[name] = {"nmpc": figures}
        bounds[name + NOISE_SUFFIX] = {"nmpc": dict(figures)}
    return bounds


def _bound(case: Case, item: tuple[str, int]) -> dict[str, float]:
    test = case.tests()[item[0]][item[1]]
    plant = _plant(test)
    looks = int(np.clip(-(-(test.hold or test.samples // 2) // ANSWERS), *HORIZON))
    figures = run_sampled(_horizon(_Same(plant), looks), test, case.score)
    return {name: float(f"{value:.6g}") for name, value in figures.items()}


class _Same:
    """A plant that equals any other of the same equation and start."""

    def __init__(self, plant: IdentifiedPlant) -> None:
        self.plant, self.key = plant, _plant_key(plant)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.key == self.key

    def __hash__(self) -> int:
        return hash(self.key)


@lru_cache(maxsize=2)
def _horizon(of: _Same, n: int) -> SampledHorizon:
    return SampledHorizon(of.plant, n)


def _on_model(test: Scenario) -> bool:
    return isinstance(test.plant, IdentifiedPlant)


def _plant(test: Scenario) -> IdentifiedPlant:
    assert isinstance(test.plant, IdentifiedPlant)
    return test.plant


def _plant_key(plant: IdentifiedPlant) -> str:
    """Digest of the equation, where the plant starts, and the ranges that errors and moves are counted in."""
    f = plant.arrays
    numbers = (f.a, f.b, f.c, f.w1, f.b1, f.w2, f.y_center, f.y_scale, f.v_center, f.v_scale, *plant.start)
    ranges = [[s.low, s.high] for s in (*plant.sp_signals, *plant.mv_signals)]
    moves = [s.max_move for s in plant.mv_signals]
    limits = [moves] if any(moves) else []
    return digest([[f"{v:.9g}" for v in np.ravel(array)] for array in numbers] + [ranges, plant.period_s, *limits])


def _key(test: Scenario) -> str:
    return digest([_plant_key(_plant(test)), test.digest(), list(HORIZON), EVERY])


def _read(kept: Path) -> dict[str, dict[str, float]]:
    """The kept bounds; nothing where the file is missing, damaged or of another schema."""
    try:
        stored: Any = read_json(kept)
    except (OSError, ValueError, PipelineError):
        return {}
    return dict(stored["figures"]) if isinstance(stored, dict) and stored.get("schema") == SCHEMA else {}
