"""Loads of tests: disturbances that no controller sees, as large as the record's motion, and as MVs can hold."""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.cases.reach import SCALES, TIMES, Reach, held_at
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.simulation.rests import courses

LOAD = 0.25  # standard deviations of the record's CV
ABOVE_NOISE = 3.0  # standard deviations of the CV's measurement noise, where these are more
LEAST_LOAD = 0.01  # of that: a smaller load is no test
ROOM = 0.05  # of an MV's range, at each end: what holding a disturbance leaves for a controller to act in


def load_size(reach: Reach, cv: int) -> float:
    """Largest change of a CV [its unit] by a load within a hold, if no controller acts.

    ``LOAD`` of the record's standard deviations; on a quiet record with much noise ``ABOVE_NOISE`` of the noise's,
    because a smaller one is lost in it.
    """
    return max(LOAD * float(reach.record.pv[:, cv].std()), ABOVE_NOISE * float(reach.model.noise_std[cv]))


def whole_load(reach: Reach, plant: IdentifiedPlant, cv: int, upwards: bool = True) -> float:
    """The load [CV a period] that moves a CV of a plant by ``load_size`` at most.

    An integrating CV moves as far in a third of a hold: there a load is a rate, and three times that is no rest.
    The largest change counts and not the last: a model's answer to a load may swing far out and come back.
    """
    (x, mv), name, size = plant.start, f"load_{plant.pv_signals[cv].name}", load_size(reach, cv)
    samples, tried = reach.hold // TIMES if cv in reach.integrates else reach.hold, 1e-3 * size
    loaded, free = (
        courses(plant, x, mv[None], samples, plant.parameters({name: load}))[0, :, cv] for load in (tried, 0.0)
    )
    return (1 if upwards else -1) * tried * size / float(np.max(np.abs(loaded - free)))


def held_load(reach: Reach, plant: IdentifiedPlant, cv: int, upwards: bool = True) -> float | None:
    """The load [CV a period] on a CV in a test: ``whole_load``, or as much of it as MVs within their ranges can hold.

    None where they hold not even ``LEAST_LOAD`` of it.
    """
    (x, mv), wanted = plant.start, whole_load(reach, plant, cv, upwards)
    cvs, name = plant.measure(x)[: reach.cv.shape[1]], f"load_{plant.pv_signals[cv].name}"

    def can_hold(scale: float) -> bool:
        p = plant.parameters({name: scale * wanted})
        return held_at(plant, (x, mv), cvs, reach.model.mv_signals, p, ROOM) is not None

    for scale in SCALES:
        if can_hold(scale):
            return scale * wanted
    held, too_much = 0.0, SCALES[-1]
    while too_much - held > LEAST_LOAD / 2:
        middle = 0.5 * (held + too_much)
        held, too_much = (middle, too_much) if can_hold(middle) else (held, middle)
    return held * wanted if held >= LEAST_LOAD else None
