"""A plant without equations as one lag near its start, for rules that tune from a linear model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.errors import PlantError
from pipeline.plants.linearization import Linearization
from pipeline.plants.simulator import Array, Simulator

DIFFERENCE = 1e-4  # of a signal's size: the step of the central differences
REST = 1e-6  # of a state's size: what the start may move in one period and count as at rest


def start_lag(plant: Simulator) -> Linearization:
    """The lag with the gain and the mean residence time of the plant near its start, from the first MV to the CV.

        K = C (I - Phi)^-1 Gamma,   T = h sum_k (1 - y(k)/K) - h/2 = h [C (I - Phi)^-2 Gamma] / K - h/2

    y is the response to a unit step of the MV, Phi, Gamma and C are central differences of ``step`` and ``measure``,
    and h is the period. A dead time counts as part of T. Raises PlantError where the start is not at rest or not
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
    once = np.linalg.solve(np.eye(len(phi)) - phi, gamma)
    gain = float(c @ once)
    time_s = h * float(c @ np.linalg.solve(np.eye(len(phi)) - phi, once)) / gain - h / 2 if gain else 0.0
    if not time_s > 0:
        raise PlantError(
            f"plant {plant.name!r} is no lag at its start: gain {gain:.3g}, mean residence time {time_s:.3g} s; "
            f"{remedy}"
        )
    rate = np.array([[1 / time_s]])
    return Linearization(np.zeros(1), mv0[:1], -rate, gain * rate, np.eye(1))


def _slope(f: Callable[[Array], Array], at: Array, by: Array) -> Array:
    """Central differences of ``f`` (m,) at ``at`` (n,), with steps ``by`` (n,), shape (m, n)."""
    return np.column_stack([(f(at + d) - f(at - d)) / (2 * h) for d, h in zip(np.diag(by), by, strict=True)])
