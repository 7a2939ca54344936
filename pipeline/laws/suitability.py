"""Whether a law suits a plant that is known by simulation alone, before anything is designed."""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.dynamics.step_response import RESPONSE_ROUNDING, first_answer_within
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.tuning.responses import RESPONSE_STEP, SHORTEST_STEP_RUN, StepResponses

INSTEAD = "choose law 'predictive' or 'pid', or remove the section"


def require_fit(law: type[ControlLaw], plant: Simulator) -> None:
    """Raise LawError, with what was found of the plant, where the law's needs are not met.

    They are the law's ``one_loop``, ``observes_within`` and ``looks_ahead``, held against step responses near the
    plant's start. A plant in equations is left alone: who wrote them down chooses the law.
    """
    if isinstance(plant, EquationPlant):
        return
    n_sp, n_mv = len(plant.sp_signals), len(plant.mv_signals)
    if law.one_loop and (n_sp, n_mv) != (1, 1):
        raise LawError(
            f"law {law.name!r} is withheld: it controls one variable by one; got {n_sp} set points and {n_mv} MVs; "
            f"{INSTEAD}"
        )
    if law.observes_within is not None:
        _require_an_observation(law, law.observes_within, plant)
    if law.looks_ahead is None:
        return
    responses, cv, mv = StepResponses.near_start(plant), plant.pv_signals[0].name, plant.mv_signals[0].name
    after = responses.answers_after(0, 0)
    if after > law.looks_ahead:
        raise LawError(
            f"law {law.name!r} is withheld: {cv} answers {after} samples after {mv} moves, the law looks "
            f"{law.looks_ahead} ahead; {INSTEAD}"
        )
    if responses.starts_inverse(0, 0):
        y = responses.y[0, 0] * np.sign(responses.gain[0, 0])
        raise LawError(
            f"law {law.name!r} is withheld: {cv} first goes the other way after {mv} moves, by "
            f"{100 * -y.min() / abs(y[-1]):.0f} % of its answer at sample {int(y.argmin()) + 1}, and a law that looks "
            f"{law.looks_ahead} sample ahead follows it there; {INSTEAD}"
        )


def _require_an_observation(law: type[ControlLaw], within: int, plant: Simulator) -> None:
    """LawError unless a PV answers the MV in time: in a period by more than a tenth of its fastest change in one."""
    (x, mv), signal = plant.start, plant.mv_signals[0]
    size = RESPONSE_STEP * (signal.high - signal.low) * (1 if mv[0] < signal.middle else -1)
    moved = np.stack([mv, mv + size * (np.arange(len(mv)) == 0)])
    x, advance, course = np.tile(x, (2, 1)), plant.many(2), []
    for _ in range(SHORTEST_STEP_RUN):
        x = advance(x, moved)
        course.append(plant.measured(x))
    answers = np.diff(np.array(course), axis=1)[:, 0].T  # (n_pv, n)
    rounding = RESPONSE_ROUNDING * np.abs(answers).max(axis=1)
    after = [first_answer_within(y, least) or SHORTEST_STEP_RUN for y, least in zip(answers, rounding, strict=True)]
    if min(after) > within:
        found = ", ".join(f"{s.name} answers after {k}" for s, k in zip(plant.pv_signals, after, strict=True))
        raise LawError(
            f"law {law.name!r} is withheld: no PV answers within {within} sample after {signal.name} moves "
            f"({found}), and the law takes what it sees by then for a disturbance; {INSTEAD}"
        )
