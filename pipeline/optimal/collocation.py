"""A plant over one sampling period, as equations that a solver can differentiate."""

from __future__ import annotations

import casadi as ca
import numpy as np

from loopwright.pipeline.plants.equations import EquationPlant, rk4_step
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal


def scaling(signals: tuple[Signal, ...]) -> tuple[Array, Array]:
    """Lower ends and widths of the signals' ranges, each (n,)."""
    low = np.array([s.low for s in signals])
    return low, np.array([s.high for s in signals]) - low


def collocation(plant: EquationPlant, elements: int, degree: int) -> ca.Function:
    """Defects of one period by Radau collocation: (x, z, u, p) -> (n_x * points,).

    States x (n_x,) at its start and z (n_x * points,) at its ``elements * degree`` points, and MVs
    u (n_mv,), all in fractions of their ranges; parameters p (n_p,).
    """
    x_low, x_span = scaling(plant.state_signals)
    mv_low, mv_span = scaling(plant.mv_signals)
    x = ca.SX.sym("x", len(plant.state_signals))
    z = ca.SX.sym("z", len(plant.state_signals), elements * degree)
    u = ca.SX.sym("u", len(plant.mv_signals))
    p = ca.SX.sym("p", len(plant.parameter_names()))
    differentiate, _, _ = ca.collocation_coeff(ca.collocation_points(degree, "radau"))
    h = plant.period_s / plant.time_unit_s / elements
    mv = mv_low + mv_span * u
    defects, start = [], x
    for element in range(elements):
        inside = z[:, element * degree : (element + 1) * degree]
        rate = ca.horzcat(
            *(plant.rate(x_low + x_span * inside[:, j], mv, plant.dv_nominal, p) / x_span for j in range(degree))
        )
        defects.append(ca.vec(ca.horzcat(start, inside) @ differentiate - h * rate))
        start = inside[:, -1]
    return ca.Function("collocation", [x, ca.vec(z), u, p], [ca.vertcat(*defects)])


def trace(plant: EquationPlant, elements: int, degree: int) -> ca.Function:
    """States at the collocation points of one period by RK4, in their units: (x, mv, p) -> (n_x, points)."""
    x = ca.SX.sym("x", len(plant.state_signals))
    mv = ca.SX.sym("mv", len(plant.mv_signals))
    p = ca.SX.sym("p", len(plant.parameter_names()))
    points = np.array(ca.collocation_points(degree, "radau"))
    times = np.concatenate([e + points for e in range(elements)]) / elements
    period = plant.period_s / plant.time_unit_s
    state, found = x, []
    for span in np.diff(times, prepend=0.0):
        substeps = int(np.ceil(span * plant.substeps))
        h = span * period / substeps
        for _ in range(substeps):
            state = rk4_step(lambda at: plant.rate(at, mv, plant.dv_nominal, p), state, h)
        found.append(state)
    return ca.Function("trace", [x, mv, p], [ca.horzcat(*found)])
