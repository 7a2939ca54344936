"""The model set of the coolant-held CSTR: its local models need no data, so the quick set is the real one."""

from __future__ import annotations

from loopwright.pipeline.models import Model
from loopwright.pipeline.models.local_models import LocalModels
from loopwright.pipeline.models.local_models_part import operating_cv
from loopwright.pipeline.plants.equations import EquationPlant

POINTS = ({"q_c": 110.0}, {"T": 442.0}, {"T": 450.0}, {"T": 465.0}, {"T": 481.0})


def local_models(plant: EquationPlant) -> LocalModels:
    return LocalModels.at_set_points(plant, [operating_cv(plant, point) for point in POINTS], 0.3)


def parts(plant: EquationPlant) -> dict[str, Model]:
    return {"local_models": local_models(plant)}
