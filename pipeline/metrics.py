"""How far two series lie apart, in numbers: arrays in, one number out."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def errors(sp: ArrayLike, pv: ArrayLike) -> Array:
    """The errors r - y of two series of one shape; ValueError where they are not."""
    r, y = np.asarray(sp, dtype=np.float64), np.asarray(pv, dtype=np.float64)
    if r.shape != y.shape or r.size == 0:
        raise ValueError(f"set point and process variable have shapes {r.shape} and {y.shape}; give equal, filled ones")
    return r - y


# ---------------------------------------------------------------------- closed loops
def mae(sp: ArrayLike, pv: ArrayLike) -> float:
    """Mean absolute error, MAE = (1/Kt) sum_k |r(k) - y(k)|, in the CV's unit.

    Source: [inverse_rbf, eq. 27].
    """
    return float(np.mean(np.abs(errors(sp, pv))))


def sse(sp: ArrayLike, pv: ArrayLike) -> float:
    """Sum of squared errors, sum_k (r(k) - y(k))^2."""
    return float(np.sum(errors(sp, pv) ** 2))


def ise(sp: ArrayLike, pv: ArrayLike, period_s: float) -> float:
    """Integral of the squared error, h sum_k (r(k) - y(k))^2, in CV^2 s, with h = ``period_s``."""
    return period_s * sse(sp, pv)


def mv_travel(mv: ArrayLike) -> float:
    """Actuator travel, sum_k sum_i |u_i(k) - u_i(k-1)| for MVs of shape (n,) or (n, n_mv)."""
    return float(np.sum(np.abs(np.diff(np.asarray(mv, dtype=np.float64), axis=0))))


# ---------------------------------------------------------------------- models
def rmse(actual: ArrayLike, predicted: ArrayLike) -> float:
    """Root mean square error, sqrt(mean (t - t_hat)^2), over all rows and outputs."""
    return float(np.sqrt(np.mean(errors(actual, predicted) ** 2)))


def r2(actual: ArrayLike, predicted: ArrayLike) -> float:
    """Coefficient of determination, 1 - sum (t - t_hat)^2 / sum (t - mean t)^2.

    0 for data without any variation, where the fraction has no meaning.
    """
    t = np.asarray(actual, dtype=np.float64)
    total = float(np.sum((t - t.mean(axis=0)) ** 2))
    return 1.0 - sse(actual, predicted) / total if total > 0 else 0.0


def fit_percent(actual: ArrayLike, predicted: ArrayLike) -> float:
    """Normalized fit, 100 (1 - ||t - t_hat|| / ||t - mean t||); 100 is perfect, 0 the mean."""
    return 100.0 * (1.0 - float(np.sqrt(max(0.0, 1.0 - r2(actual, predicted)))))


def per_region(
    metric: Callable[[Array, Array], float],
    actual: ArrayLike,
    predicted: ArrayLike,
    where: ArrayLike,
    regions: Mapping[str, tuple[float, float]],
) -> dict[str, float]:
    """``metric`` over the rows whose ``where`` lies in [low, high) of each region.

    ``where`` has shape (n,): the coordinate that tells regions apart, for example the CV at
    sample k. A region without rows is left out.
    """
    t, p = np.asarray(actual, dtype=np.float64), np.asarray(predicted, dtype=np.float64)
    at = np.asarray(where, dtype=np.float64)
    inside = {name: (at >= low) & (at < high) for name, (low, high) in regions.items()}
    return {name: metric(t[rows], p[rows]) for name, rows in inside.items() if np.any(rows)}
