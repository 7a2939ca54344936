"""Tests of own plants: loads, steps of measured disturbances, and daily work as the record had it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.cases.operating_range import ANSWERS_A_SET_POINT, SCALES, VISITED_MV, OperatingRange, held_at
from loopwright.pipeline.evaluation.case import Array
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.records.record_file import stretches
from loopwright.pipeline.simulation.rests import courses

# --------------------------------------------------------------------------------------------------------------- loads
TEST_LOAD = 0.25  # standard deviations of the record's CV
ABOVE_NOISE = 3.0  # standard deviations of the CV's measurement noise, where these are more
LEAST_LOAD = 0.01  # of that: a smaller load is no test
LOAD_ROOM = 0.05  # of an MV's range, at each end: what holding a disturbance leaves for a controller to act in


def load_size(reach: OperatingRange, cv: int) -> float:
    """Largest change of a CV [its unit] by a load within a hold, if no controller acts.

    ``TEST_LOAD`` of the record's standard deviations; on a quiet record with much noise ``ABOVE_NOISE`` of the noise's,
    because a smaller one is lost in it.
    """
    return max(TEST_LOAD * float(reach.record.pv[:, cv].std()), ABOVE_NOISE * float(reach.model.noise_std[cv]))


def whole_load(reach: OperatingRange, plant: IdentifiedPlant, cv: int, upwards: bool = True) -> float:
    """The load [CV a period] that moves a CV of a plant by ``load_size`` at most.

    An integrating CV moves as far in a third of a hold: there a load is a rate, and three times that is no rest.
    The largest change counts and not the last: a model's answer to a load may swing far out and come back.
    """
    (x, mv), name, size = plant.start, f"load_{plant.pv_signals[cv].name}", load_size(reach, cv)
    samples, tried = reach.hold // ANSWERS_A_SET_POINT if cv in reach.integrates else reach.hold, 1e-3 * size
    loaded, free = (
        courses(plant, x, mv[None], samples, plant.parameters({name: load}))[0, :, cv] for load in (tried, 0.0)
    )
    return (1 if upwards else -1) * tried * size / float(np.max(np.abs(loaded - free)))


def held_load(reach: OperatingRange, plant: IdentifiedPlant, cv: int, upwards: bool = True) -> float | None:
    """The load [CV a period] on a CV in a test: ``whole_load``, or as much of it as MVs within their ranges can hold.

    None where they hold not even ``LEAST_LOAD`` of it.
    """
    (x, mv), wanted = plant.start, whole_load(reach, plant, cv, upwards)
    cvs, name = plant.measure(x)[: reach.cv.shape[1]], f"load_{plant.pv_signals[cv].name}"

    def can_hold(scale: float) -> bool:
        p = plant.parameters({name: scale * wanted})
        return held_at(plant, (x, mv), cvs, reach.model.mv_signals, p, LOAD_ROOM) is not None

    for scale in SCALES:
        if can_hold(scale):
            return scale * wanted
    held, too_much = 0.0, SCALES[-1]
    while too_much - held > LEAST_LOAD / 2:
        middle = 0.5 * (held + too_much)
        held, too_much = (middle, too_much) if can_hold(middle) else (held, middle)
    return held * wanted if held >= LEAST_LOAD else None


# -------------------------------------------------------------------------------------- steps of measured disturbances
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
    return held_at(other, (x, mv), plant.measure(x)[:n_cv], plant.mv_signals, room=LOAD_ROOM) is not None


# ---------------------------------------------------------------------------------------------------------- daily work
MOST_DAILY_ROWS, LEAST_DAILY_ROWS = 2_000, 200  # rows of a window
DAILY_ROWS = 6_000  # of all windows
WARM_UP_ROWS = 300  # rows, at most, over which the model's state finds itself before a window


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """A window of a record on a plant: under the recorded MVs its outputs are the recorded ones, row by row.

    ``load`` is, for each output, what the model misses from one row to the next: loads, noise and the model's errors
    together. Under other MVs the outputs are the recorded ones and the model's answer to the difference.
    """

    x0: Array  # (n_x,)
    mv0: Array  # (n_mv,) before the window
    sp: Array  # (n, n_cv)
    dv: Array  # (n, n_dv)
    load: Array  # (n, n_y) [pv a period]
    pv: Array  # (n, n_y) recorded
    mv: Array  # (n, n_mv) recorded: each acts from its row to the next


def windows(record: Record, sp: Array, hold: int) -> list[slice]:
    """Windows of rows in which all set points (n, n_cv) are known, as long as ``MOST_DAILY_ROWS`` allows, apart.

    None is shorter than ``LEAST_DAILY_ROWS`` and the hold of a set point.
    """
    least = max(LEAST_DAILY_ROWS, min(hold, MOST_DAILY_ROWS))
    found = []
    for part in stretches(np.asarray(np.isfinite(sp).all(axis=1)), record.run, least + 2):
        n = part.stop - part.start - 2
        count = (
            -(-n // MOST_DAILY_ROWS) if n % MOST_DAILY_ROWS >= least or n < MOST_DAILY_ROWS else n // MOST_DAILY_ROWS
        )
        edges = [part.start + 1 + i * MOST_DAILY_ROWS for i in range(count)]
        found += [slice(first, min(first + MOST_DAILY_ROWS, part.stop - 1)) for first in edges]
    return found


def spread(found: Sequence[slice]) -> list[slice]:
    """Windows of ``DAILY_ROWS`` rows at most, spread evenly over the record."""
    if not found:
        return []
    n = min(len(found), DAILY_ROWS // max(rows.stop - rows.start for rows in found))
    return [found[(2 * i + 1) * len(found) // (2 * n)] for i in range(n)]


def day(plant: IdentifiedPlant, record: Record, sp: Array, rows: slice, *, same_row: bool) -> Day | None:
    """The rows of a record on a model; None where the model does not stay finite over them.

    With ``same_row`` an MV acts on the outputs of its own row: then what was done at a row stands in the next one.
    """
    n_y, run = len(plant.pv_signals), record.run
    first = max(rows.start - WARM_UP_ROWS, int(np.argmax(run == run[rows.start])))
    y, mv = record.pv[:, :n_y], record.mv[int(same_row) :]
    p, n_loads = plant.parameters(), n_y
    x = plant.start_at(y[first])
    load = np.empty((rows.stop - rows.start, n_y))
    x0 = x
    for k in range(first, rows.stop):
        if k == rows.start:
            x0 = x
        missed = y[k + 1] - plant.measured(plant.step(x, mv[k], record.dv[k], p))
        if k >= rows.start:
            load[k - rows.start] = missed
        changed = p.copy()
        changed[len(p) - n_loads :] = missed
        x = plant.step(x, mv[k], record.dv[k], changed)
        if not np.isfinite(x).all():
            return None
    return Day(x0, mv[rows.start - 1], sp[rows], record.dv[rows], load, y[rows], mv[rows])
