"""The tests with the loop open: the MVs rest where they stand as a test begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.errors import PlantError
from pipeline.evaluation.case import Array, Case
from pipeline.evaluation.metric import together
from pipeline.simulation.scenario import Scenario
from pipeline.simulation.simulate import simulate_closed

RUNS_AWAY = 10.0
"""Ranges of a controlled variable, from its set point, where no plant is any more."""


def errors_at_rest(case: Case) -> dict[str, float]:
    """Test -> the error that is there without control, in the case's metric: what a controller has to make smaller.

    A test whose plant runs away under MVs at rest, farther than ``RUNS_AWAY`` ranges of a controlled variable, is left
    out: there every law that holds it is better, and how far an integrator would go says nothing.
    """
    found = {name: _error(case, tests) for name, tests in case.scenarios().items()}
    return {name: error for name, error in found.items() if error is not None}


def _error(case: Case, tests: Sequence[Scenario]) -> float | None:
    rows = []
    for test in tests:
        try:
            loop = simulate_closed(test.plant or case.plant, _rests, test)
        except PlantError:
            return None
        ranges = np.array([s.high - s.low for s in case.plant.sp_signals])
        if np.any(np.abs(loop.pv[:, : len(ranges)] - loop.sp) > RUNS_AWAY * ranges):
            return None
        rows.append(case.score(test, loop.pv, loop.mv))
    error = together(rows, case.metrics)[case.metric]
    return error if np.isfinite(error) else None


def _rests(sp: Array, pv: Array, mv: Array) -> tuple[Array, Array]:
    return mv, np.empty(0)
