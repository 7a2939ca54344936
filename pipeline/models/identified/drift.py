"""Whether a plant drifts inside its record: its gain or its level moves, and no model of it can follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.output_error import fit_starts
from loopwright.pipeline.plants.simulator import Array

PARTS = (8, 16, 32, 64, 128)
"""Numbers of parts of the record that get a gain and a level of their own: drift may be slow or quick."""

LEAST_ROWS = 50
"""Fewest rows of a part."""

EXPLAINED = 0.5
"""Share of the residual's power, beyond the noise, that they must explain."""

AS_GOOD = 0.05
"""Smaller share at which longer parts still count as the best, because they leave less to chance."""

MUCH = 1.5
"""Residual over noise of a model that may lack something."""


@dataclass(frozen=True, slots=True)
class Drift:
    """Share of what a free run misses that moving gains and levels explain, and the rows over which they hold."""

    share: float
    rows: int

    @property
    def found(self) -> bool:
        """Whether drift explains most of it."""
        return self.share > EXPLAINED


def drift_of(model: Dynamics, data: Sequence[Stretch]) -> Drift:
    """How much of what a free run misses is drift: of the output where that is most.

        y = g_p y_hat + l_p,   p = 1 .. P in the order of time

    A gain and a level of part p come from the parts beside it. So they cannot follow what the model lacks, which
    differs from move to move, but only what goes on from part to part. The longest parts that explain nearly the most
    count. The share is 0 for an output that the run misses by less than ``MUCH`` times the noise after one gain and
    one level of the whole record, and for a run that explodes.
    """
    rows = sum(len(part.y) for part in data)
    none = Drift(0.0, rows // PARTS[0])
    runs = [model.free_run(x, part) for x, part in zip(fit_starts(model, data), data, strict=True)]
    if any(run is None for run in runs):
        return none
    found = [none]
    for i in range(data[0].y.shape[1]):
        both = [(part.y[:, i], run[0][:, i]) for part, run in zip(data, runs, strict=True) if run is not None]
        floor = float(np.mean(np.concatenate([np.diff(y - predicted) for y, predicted in both]) ** 2)) / 2
        y, predicted = (np.concatenate(series) for series in zip(*both, strict=True))
        power = float(np.mean(_beyond(y, predicted, len(y)) ** 2))
        if power <= MUCH**2 * floor:
            continue
        for parts in PARTS:
            if len(y) >= parts * LEAST_ROWS:
                left = float(np.mean(_beyond_neighbours(y, predicted, parts) ** 2))
                found.append(Drift(min((power - left) / (power - floor), 1.0), len(y) // parts))
    best = max(drift.share for drift in found)
    return max((drift for drift in found if drift.share > best - AS_GOOD), key=lambda drift: drift.rows)


def _beyond_neighbours(y: Array, predicted: Array, parts: int) -> Array:
    """Residual (n,) of y (n,) on a gain and a level of ``predicted`` (n,), of each part by the parts beside it."""
    pieces = np.array_split(np.arange(len(y)), parts)
    found = []
    for p, rows in enumerate(pieces):
        beside = np.concatenate([*pieces[max(p - 1, 0) : p], *pieces[p + 1 : p + 2]])
        gain, level = _line(y[beside], predicted[beside])
        found.append(y[rows] - gain * predicted[rows] - level)
    return np.concatenate(found)


def error_beyond_drift(model: Dynamics, data: Sequence[Stretch], part: int) -> float:
    """Rms error of a free run, beyond a gain and a level of each ``part`` rows; infinite where it explodes."""
    n_y, found = data[0].y.shape[1], []
    for start, stretch in zip(fit_starts(model, data), data, strict=True):
        run = model.free_run(start, stretch)
        if run is None:
            return np.inf
        found.append(np.column_stack([_beyond(stretch.y[:, i], run[0][:, i], part) for i in range(n_y)]))
    return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))


def _beyond(y: Array, predicted: Array, part: int) -> Array:
    """Residual (n,) of y (n,) on a gain and a level of ``predicted`` (n,) for each ``part`` rows."""
    found = []
    for rows in np.array_split(np.arange(len(y)), max(round(len(y) / part), 1)):
        gain, level = _line(y[rows], predicted[rows])
        found.append(y[rows] - gain * predicted[rows] - level)
    return np.concatenate(found)


def _line(y: Array, predicted: Array) -> tuple[float, float]:
    """Gain and level of y (n,) on ``predicted`` (n,) by least squares."""
    design = np.column_stack([predicted, np.ones(len(predicted))])
    gain, level = np.linalg.lstsq(design, y, rcond=1e-10)[0]
    return float(gain), float(level)
