"""Whether a residual follows curves of the state and the inputs: what a linear model can leave although it is white."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.plants.simulator import Array

EXPLAINED = 0.02
"""Share of a residual's variance beyond which curves count: a model with them would gain 1 % of its error."""

SURE = 4.0
"""Standard deviations by which the share must exceed what chance gives."""

ROWS = 10
"""Rows for each coefficient below which products of different columns are left out."""


def curved(model: Dynamics, starts: Sequence[Array], data: Sequence[Stretch], correction: float = 0.0) -> bool:
    """Whether squares, products and cubes of [x(k), v(k)] explain the residual of any output at k + 1, beyond lines.

    A residual of moves that jump each period, or of runs that the outputs correct, is white whatever the plant; its
    whiteness then says nothing of curves. False where a run explodes, or where the rows are too few.
    """
    runs = [model.free_run(x, part, correction) for x, part in zip(starts, data, strict=True)]
    if any(run is None for run in runs):
        return False
    pairs = [(run, part) for run, part in zip(runs, data, strict=True) if run is not None]
    n_y = data[0].y.shape[1]
    left = np.concatenate([part.y[1:] - before[1:, :n_y] for (before, _), part in pairs])
    z = np.concatenate([np.hstack([after, part.v])[:-1] for (_, after), part in pairs])
    straight, bent = _columns(z)
    n, p, more = len(z), straight.shape[1], bent.shape[1]
    if n < 2 * (p + more):
        return False
    without, beside = _squares_left(straight, left), _squares_left(np.hstack([straight, bent]), left)
    # (n_y,) without what chance explains
    share = 1 - beside / (n - p - more) / np.maximum(without / (n - p), 1e-300)
    return bool(np.any(share > max(EXPLAINED, SURE * np.sqrt(2 * more) / n)))


def _squares_left(columns: Array, values: Array) -> Array:
    """Sum of squares (n_y,) of the values (n, n_y) that no combination of the columns (n, p) explains."""
    rest = values - columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0]
    return np.asarray((rest**2).sum(axis=0))


def _columns(z: Array) -> tuple[Array, Array]:
    """(1 and the columns of z (n, m) by their deviations; their squares, products and cubes)."""
    z = (z - z.mean(axis=0)) / np.maximum(z.std(axis=0), 1e-12)
    n, m = z.shape
    first, second = np.triu_indices(m)
    if n < ROWS * (1 + 2 * m + len(first)):
        first = second = np.arange(m)
    return np.column_stack([np.ones(n), z]), np.column_stack([z[:, first] * z[:, second], z**3])
