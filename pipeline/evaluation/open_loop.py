"""The tests with the loop open: the MVs rest where they stand as a test begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.case import Array, Case
from loopwright.pipeline.evaluation.metric import together
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import simulate_closed

RUNS_AWAY = 1.0
"""Ranges of a controlled variable from its set point, where no plant and no transmitter goes."""


def errors_at_rest(case: Case) -> dict[str, float]:
    """Test -> the error that is there without control, in the case's metric: what a controller has to make smaller.

    A test whose plant does not stay finite under MVs at rest is left out: there every law that does is better. An
    error counts as far as ``RUNS_AWAY`` ranges of its controlled variable: how far an integrator would go says nothing.
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
        far = RUNS_AWAY * np.array([s.high - s.low for s in case.plant.sp_signals])
        pv = loop.pv.copy()
        pv[:, : len(far)] = np.clip(pv[:, : len(far)], loop.sp - far, loop.sp + far)
        rows.append(case.score(test, pv, loop.mv))
    error = together(rows, case.metrics)[case.metric]
    return error if np.isfinite(error) else None


def _rests(sp: Array, pv: Array, mv: Array) -> tuple[Array, Array]:
    return mv, np.empty(0)
