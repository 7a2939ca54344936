"""Whether a law suits a plant that is known by simulation alone, before anything is designed."""

from __future__ import annotations

from pipeline.errors import LawError
from pipeline.laws.base import ControlLaw, require_single_loop
from pipeline.plants.equations import EquationPlant
from pipeline.plants.simulator import Simulator
from pipeline.tuning.responses import StepResponses

INSTEAD = "choose law 'predictive' or 'pid', or remove the section"


def require_fit(law: type[ControlLaw], plant: Simulator) -> None:
    """Raise LawError, with what was found of the plant, where the law's needs are not met.

    They are the law's ``one_loop`` and ``looks_ahead``, held against step responses near the plant's start. A plant
    in equations is left alone: who wrote them down chooses the law.
    """
    if isinstance(plant, EquationPlant):
        return
    if law.one_loop:
        require_single_loop(plant.signals, law.name)
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
        raise LawError(
            f"law {law.name!r} is withheld: {cv} first goes the other way after {mv} moves, and a law that looks "
            f"{law.looks_ahead} sample ahead follows it there; {INSTEAD}"
        )
