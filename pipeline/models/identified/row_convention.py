"""The row on whose outputs an MV acts: the next one, or, where a logger stores it late, its own."""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.plants.simulator import Array

LAGS = 12
"""Lags of the ARX whose innovations are looked at."""

AFTER = 10
"""Rows after an innovation in which a controller's reaction to it would show."""

SURE = 5.0
"""Standard deviations from zero beyond which a correlation counts."""


def may_act_in_its_row(data: ScaledRecord, n_mv: int) -> bool:
    """Whether an MV goes with what the rows before do not explain of an output in its row, and nothing says feedback.

    An operator or a controller that reacts to y(k) moves u(k) too, which looks the same; but then what neither the
    past nor u(k) explains of y(k) goes with the later moves, u(k+1) - u(k) and after. Both parts of y(k) are residuals
    of least-squares ARX models.
    """
    ends = [np.arange(i + LAGS, j - AFTER) for i, j in data.bounds() if j - i > LAGS + AFTER]
    rows = np.concatenate([*ends, np.zeros(0, dtype=np.int64)])
    z, mv = np.hstack([data.y, data.v]), data.v[:, :n_mv]
    past = np.column_stack([*(z[rows - lag] for lag in range(1, LAGS + 1)), np.ones(len(rows))])
    if len(rows) < 3 * past.shape[1]:
        return False
    bound = SURE / np.sqrt(len(rows))
    surprise, own = _residual(past, data.y[rows]), _residual(past, mv[rows])
    if not np.any(_correlations(own, surprise) > bound):
        return False
    unexplained = _residual(np.column_stack([past, mv[rows]]), data.y[rows])
    moves = np.diff(mv, axis=0, prepend=mv[:1])
    return not any(np.any(_correlations(moves[rows + j], unexplained) > bound) for j in range(1, AFTER + 1))


def _residual(columns: Array, values: Array) -> Array:
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0])


def _correlations(moves: Array, e: Array) -> Array:
    """Sizes of the correlation coefficients (n_mv, n_y) of moves (n, n_mv) with e (n, n_y); 0 where either is still."""
    size = np.linalg.norm(moves, axis=0)[:, None] * np.linalg.norm(e, axis=0)
    return np.asarray(np.abs(moves.T @ e) / np.where(size > 0, size, np.inf))
