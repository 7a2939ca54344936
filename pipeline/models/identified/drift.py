"""Whether a plant drifts inside its record: its gain or its level moves, and no model of it can follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.models.identified.dynamics import Dynamics, Stretch
from pipeline.models.identified.output_error import fit_starts
from pipeline.plants.simulator import Array

PERIODS = 8
"""Parts of the record that get a gain and a level of their own."""

EXPLAINED = 0.5
"""Share of the residual's power, beyond the noise, that they must explain."""

MUCH = 1.5
"""Residual over noise of a model that may lack something."""


def drift_share(model: Dynamics, data: Sequence[Stretch]) -> Array:
    """Share (n_y,) of what a free run misses that a gain and a level of each part of the record explain.

        y = g_p y_hat + l_p,   p = 1 .. ``PERIODS`` in the order of time

    0 for an output that it misses by less than ``MUCH`` times the noise, and for a run that explodes.
    """
    n_y = data[0].y.shape[1]
    starts = fit_starts(model, data)
    runs = [model.free_run(x, part) for x, part in zip(starts, data, strict=True)]
    if any(run is None for run in runs):
        return np.zeros(n_y)
    y = np.concatenate([part.y for part in data])
    predicted = np.concatenate([run[0][:, :n_y] for run in runs if run is not None])
    shares = np.zeros(n_y)
    for i in range(n_y):
        residual = y[:, i] - predicted[:, i]
        noise = np.concatenate([np.diff(p.y[:, i]) for p in data]) - np.concatenate(
            [np.diff(r[0][:, i]) for r in runs if r is not None]
        )
        floor = float(np.mean(noise**2)) / 2
        power = float(np.mean(residual**2))
        if power <= MUCH**2 * floor:
            continue
        left = float(np.mean(_beyond(y[:, i], predicted[:, i], -(-len(y) // PERIODS)) ** 2))
        shares[i] = max(0.0, (power - left) / (power - floor))
    return np.minimum(shares, 1.0)


def drifts(model: Dynamics, data: Sequence[Stretch]) -> bool:
    """Whether drift explains most of what a free run misses of any output."""
    return bool(drift_share(model, data).max() > EXPLAINED)


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
        design = np.column_stack([predicted[rows], np.ones(len(rows))])
        found.append(y[rows] - design @ np.linalg.lstsq(design, y[rows], rcond=1e-10)[0])
    return np.concatenate(found)
