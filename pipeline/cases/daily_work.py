"""Daily work: the set points and the loads of a record, replayed on a model of it under another controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.evaluation.case import Array
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.records.set_points import stretches

MOST, LEAST = 2_000, 200  # rows of a window
ROWS = 6_000  # of all windows
BEFORE = 300  # rows, at most, over which the model's state finds itself before a window


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
    """Windows of rows in which all set points (n, n_cv) are known, as long as ``MOST`` allows, apart.

    None is shorter than ``LEAST`` and the hold of a set point.
    """
    least = max(LEAST, min(hold, MOST))
    found = []
    for part in stretches(np.asarray(np.isfinite(sp).all(axis=1)), record.run, least + 2):
        n = part.stop - part.start - 2
        count = -(-n // MOST) if n % MOST >= least or n < MOST else n // MOST
        edges = [part.start + 1 + i * MOST for i in range(count)]
        found += [slice(first, min(first + MOST, part.stop - 1)) for first in edges]
    return found


def spread(found: Sequence[slice]) -> list[slice]:
    """Windows of ``ROWS`` rows at most, spread evenly over the record."""
    if not found:
        return []
    n = min(len(found), ROWS // max(rows.stop - rows.start for rows in found))
    return [found[(2 * i + 1) * len(found) // (2 * n)] for i in range(n)]


def day(plant: IdentifiedPlant, record: Record, sp: Array, rows: slice, *, same_row: bool) -> Day | None:
    """The rows of a record on a model; None where the model does not stay finite over them.

    With ``same_row`` an MV acts on the outputs of its own row: then what was done at a row stands in the next one.
    """
    n_y, run = len(plant.pv_signals), record.run
    first = max(rows.start - BEFORE, int(np.argmax(run == run[rows.start])))
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
