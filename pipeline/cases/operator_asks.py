"""Operators' wishes at the end of a test, as arrays by signal, and the best steady state for them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from loopwright.pipeline.evaluation.case import Array
from loopwright.pipeline.optimal.economic import BestRest, RestProblem, RestWishes
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.operator_changes import OperatedCourse
from loopwright.pipeline.simulation.scenario import Scenario

LAST_RANK = 4.0  # of a PV for which the law has no rank: its range is out of use


def asked_at(course: OperatedCourse, plant: Simulator, stands: Array | None = None, sample: int = -1) -> RestWishes:
    """The wishes at a sample of a course, by default its last.

    An MV out of use stays where it ``stands`` (n_mv,), or at the MVs of the plant's start. A PV without entries is out
    of use.
    """
    pvs, mvs = plant.pv_signals, plant.mv_signals
    stay = plant.start[1] if stands is None else stands

    def of(signals: tuple[str, ...], what: str, default: list[float]) -> Array:
        return np.array([course.at(name, what, of, sample) for name, of in zip(signals, default, strict=True)])

    pv_names, mv_names = tuple(s.name for s in pvs), tuple(s.name for s in mvs)
    nothing, none = [0.0] * len(pvs), [0.0] * len(mvs)
    use = of(mv_names, "use", [1.0] * len(mvs))
    return RestWishes(
        y_use=of(pv_names, "use", nothing),
        track=of(pv_names, "track", nothing),
        y_low=of(pv_names, "low", [s.low for s in pvs]),
        y_high=of(pv_names, "high", [s.high for s in pvs]),
        rank=of(pv_names, "rank", [LAST_RANK] * len(pvs)),
        y_cost=of(pv_names, "cost", nothing),
        mv_low=of(mv_names, "low", [s.low for s in mvs]),
        mv_high=of(mv_names, "high", [s.high for s in mvs]),
        mv_cost=of(mv_names, "cost", none),
        held=np.where(use > 0, np.nan, stay),
    )


def best_rest(test: Scenario, course: OperatedCourse, stands: Array, sample: int = -1) -> BestRest | None:
    """The best steady state of the test's plant for what is asked at a sample, its last; None where no model says one.

    An MV out of use stays where it ``stands`` (n_mv,).
    """
    plant = test.plant
    if not isinstance(plant, IdentifiedPlant):
        return None
    asked, p = asked_at(course, plant, stands, sample), test.parameters(plant)[sample]
    return problem_of(plant).best(asked, test.sp[sample], p, test.disturbances(plant)[sample], (test.x0, test.mv0))


def problem_of(plant: IdentifiedPlant) -> RestProblem:
    """The rests of a plant, kept: its equations are written once."""
    return _problem(plant)


@lru_cache(maxsize=4)
def _problem(plant: IdentifiedPlant) -> RestProblem:
    return RestProblem(plant)
