"""Steps of the measured disturbances of an own plant, as large as its record has them and its MVs can balance."""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.cases.loads import ROOM
from loopwright.pipeline.cases.reach import SCALES, VISITED_MV, held_at
from loopwright.pipeline.evaluation.case import Array
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.records.record import Record


def course(nominal: Array, place: int, level: float, samples: int, at: int) -> Array:
    """Measured disturbances (samples, n_dv): one steps to ``level`` at sample ``at`` and back half the test later."""
    found = np.tile(nominal, (samples, 1))
    found[at : at + samples // 2, place] = level
    return found


def level_of(plant: IdentifiedPlant, record: Record, place: int, upwards: bool) -> float:
    """The level of a step: the record's quantile, or as far towards it as the plant can hold its CVs.

    A plant that cannot hold them would tell nothing of a law. Where the record has the disturbance at one value in so
    many rows that its quantile is that value, its extreme stands for the quantile.
    """
    values, nominal = record.dv[:, place], float(plant.dv_nominal[place])
    far = float(np.quantile(values, VISITED_MV[upwards]))
    if far == nominal:
        far = float(values.max() if upwards else values.min())
    levels = [nominal + scale * (far - nominal) for scale in SCALES]
    return next((level for level in levels if _holds(plant, place, level)), nominal)


def _holds(plant: IdentifiedPlant, place: int, level: float) -> bool:
    """Whether the CVs can rest where they are at the start, under this disturbance and MVs within their ranges."""
    (x, mv), dv, n_cv = plant.start, plant.dv_nominal, len(plant.sp_signals)
    dv[place] = level
    other = IdentifiedPlant(plant.signals, plant.arrays, mv=mv, dv=dv, most_dead_time=plant.most_dead_time)
    return held_at(other, (x, mv), plant.measure(x)[:n_cv], plant.mv_signals, room=ROOM) is not None
