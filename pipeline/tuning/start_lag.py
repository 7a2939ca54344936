"""A plant without equations as one or two lags near its start, for rules that tune from a linear model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.errors import PlantError
from pipeline.plants.linearization import Linearization
from pipeline.plants.simulator import Array, Simulator

DIFFERENCE = 1e-4  # of a signal's size: the step of the central differences
REST = 1e-6  # of a state's size: what the start may move in one period and count as at rest


def start_lag(plant: Simulator) -> Linearization:
    """The lags with the gain and the residence times' mean and variance of the plant near its start, first MV to CV.

        r(k) = 1 - y(k)/K,   T = h sum_k r(k) - h/2,   S = 2 h^2 sum_k k r(k) - T^2
        G(s) = K / ((t1 s + 1) (t2 s + 1)),   t1 + t2 = T,   t1^2 + t2^2 = S

    y is the response to a unit step of the MV, K its end, h the period; it follows from central differences of
    ``step`` and ``measure``. A dead time counts as part of T; where S is too small for two lags, they are equal, and
    where the smaller one would be below h/2, there is one lag. Raises PlantError where the start is not at rest or not
    stable, or the CV does not follow the MV.
    """
    x0, mv0 = (np.asarray(v, dtype=np.float64) for v in plant.start)
    dv, p, h = plant.dv_nominal, plant.parameters(), plant.period_s
    size = np.maximum(np.abs(x0), 1e-3 * max(1.0, float(np.abs(x0).max())))
    moved = np.abs(plant.step(x0, mv0, dv, p) - x0)
    remedy = "tune the controller by hand (`manual`), or give the plant's equations"
    if not (moved <= REST * size).all():
        raise PlantError(
            f"plant {plant.name!r} is not at rest at its start: its state moves by up to {moved.max():.3g} in a period "
            f"with the MV held; give a start at rest, {remedy}"
        )
    span = DIFFERENCE * np.array([s.high - s.low for s in plant.mv_signals])
    phi = _slope(lambda x: plant.step(x, mv0, dv, p), x0, DIFFERENCE * size)
    gamma = _slope(lambda mv: plant.step(x0, mv, dv, p), mv0, span)[:, 0]
    c = _slope(plant.measure, x0, DIFFERENCE * size)[0]
    radius = float(np.abs(np.linalg.eigvals(phi)).max())
    if not radius < 1 - 1e-6:
        raise PlantError(
            f"plant {plant.name!r} is not stable at its start (a sampled pole of size {radius:.6g}); {remedy}"
        )
    ends = np.linalg.inv(np.eye(len(phi)) - phi)
    rest = ends @ gamma
    gain = float(c @ rest)
    time_s = h * float(c @ ends @ rest) / gain - h / 2 if gain else 0.0
    if not time_s > 0:
        raise PlantError(
            f"plant {plant.name!r} is no lag at its start: gain {gain:.3g}, mean residence time {time_s:.3g} s; "
            f"{remedy}"
        )
    variance = 2 * h**2 * float(c @ phi @ ends @ ends @ rest) / gain - time_s**2
    apart = np.sqrt(max(0.0, variance / 2 - time_s**2 / 4))
    slow, fast = time_s / 2 + apart, time_s / 2 - apart
    if fast < h / 2:
        rate = np.array([[1 / time_s]])
        return Linearization(np.zeros(1), mv0[:1], -rate, gain * rate, np.eye(1))
    a, b = np.array([[-1 / slow, 0.0], [1 / fast, -1 / fast]]), np.array([[gain / slow], [0.0]])
    return Linearization(np.zeros(2), mv0[:1], a, b, np.array([[0.0, 1.0]]))


def _slope(f: Callable[[Array], Array], at: Array, by: Array) -> Array:
    """Central differences of ``f`` (m,) at ``at`` (n,), with steps ``by`` (n,), shape (m, n)."""
    return np.column_stack([(f(at + d) - f(at - d)) / (2 * h) for d, h in zip(np.diag(by), by, strict=True)])
