"""One optimal-control problem over a horizon, from a plant's own equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.metric import METRICS, Metric
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


# --------------------------------------------------------------------------------------------------------- the horizon
# The plan is never allowed to leave the states' ranges by more than this fraction of them.
PLAN_MARGIN = 0.1

# w below, for absolute and for squared errors. Squared ones are small where absolute ones still count.
MOVE_WEIGHT = {False: 1e-3, True: 1e-6}


@dataclass(frozen=True, slots=True)
class NmpcPlan:
    """A solution: the moves, the states that they lead to, and what a next solve starts from."""

    mv: Array  # (n, n_mv)
    x: Array  # (n + 1, n_x) states at the samples, the first one given
    cost: float  # of the controlled variables' errors alone, absolute or squared, in fractions of their ranges
    solved: bool
    values: Array  # all variables of the problem, (per period, n)
    multipliers: tuple[Array, Array] | None  # of bounds and constraints


class Horizon:
    r"""Best moves over ``n`` periods for a plant that is known exactly.

        min  sum_k sum_i J((r_i(k) - y_i(k)) / span_i)  +  w sum_k ((u(k) - u(k-1)) / span_u)^2,   k = 1..n

    with J(e) = e^2 where the ``metric`` is squared, else |e|, over u(0)..u(n-1) within the MVs' ranges,
    each held for one period. The plant's ``derivative``
    enters by Radau collocation (``elements`` of ``degree`` a period): implicit, so that neither
    the hot branch's stiffness nor an ignition within one period costs accuracy or stability, and
    cheap to differentiate twice. The absolute value enters through slacks, s >= +-(r - y). Squared
    errors are variables as well, s = r - y: the cost is then convex, and a strongly curved output
    stands in a constraint, which takes the solver half the iterations.

    ``limits`` are ranges of states, by their names, to be kept at the samples. A state that a
    disturbance has carried out of its range may still be out at the first one, but no farther.

    The small weight w chooses among equal tracking errors: an MV that rings between samples, on
    the sampled plant's zero outside the unit circle, costs no error at the samples.
    """

    def __init__(
        self,
        plant: EquationPlant,
        n: int,
        *,
        metric: Metric = METRICS["mae"],
        limits: Mapping[str, tuple[float, float]] | None = None,
        elements: int = 3,
        degree: int = 3,
    ) -> None:
        if metric.floor is None:
            able = ", ".join(name for name, known in METRICS.items() if known.floor is not None)
            raise PlantError(f"no horizon for the metric {metric.name!r}, which has no floor; it may be {able}")
        discrete = [s.name for s in plant.mv_signals if s.values is not None]
        if discrete:
            raise PlantError(
                f"no horizon for the discrete MV {discrete[0]!r} of plant {plant.name!r}; give its relaxed()"
            )
        self.plant, self.n, self._squared = plant, n, metric.squared
        self._n_x, self._n_mv, self._n_cv = len(plant.state_signals), len(plant.mv_signals), len(plant.sp_signals)
        self._points = elements * degree
        self._x_low, self._x_span = scaling(plant.state_signals)
        self._mv_low, self._mv_span = scaling(plant.mv_signals)
        self._cv_span = scaling(plant.sp_signals)[1]
        n_z = self._n_x * self._points
        rows = self._rows = n_z + self._n_mv + self._n_cv

        w = ca.MX.sym("w", rows * n)
        table = ca.reshape(w, rows, n)
        z, u, s = table[:n_z, :], table[n_z : n_z + self._n_mv, :], table[n_z + self._n_mv :, :]
        x0 = ca.MX.sym("x0", self._n_x)
        sp = ca.MX.sym("sp", self._n_cv, n)
        p = ca.MX.sym("p", len(plant.parameter_names()), n)
        ends = z[n_z - self._n_x :, :]
        starts = ca.horzcat(x0, ends[:, :-1])
        self._trace = trace(plant, elements, degree)
        defects = collocation(plant, elements, degree).map(n)(starts, z, u, p)
        error = sp - self._controlled().map(n)(ends)
        moves = u[:, 1:] - u[:, :-1]
        cost = ca.sumsqr(s) if self._squared else ca.sum1(ca.vec(s))
        binds = [ca.vec(s - error)] if self._squared else [ca.vec(s - error), ca.vec(s + error)]
        problem: Any = {
            "x": w,
            "p": ca.vertcat(x0, ca.vec(sp), ca.vec(p)),
            "f": cost + MOVE_WEIGHT[metric.squared] * ca.sumsqr(moves),
            "g": ca.vertcat(ca.vec(defects), *binds),
        }
        options: Any = {
            "expand": True,  # one flat expression evaluates several times faster than the map
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.linear_solver": "mumps",
            "ipopt.tol": 1e-7,
            "ipopt.max_iter": 150,
            "ipopt.mu_init": 1e-5,
            "ipopt.warm_start_init_point": "yes",
            "ipopt.warm_start_bound_push": 1e-6,
            "ipopt.warm_start_slack_bound_push": 1e-6,
            "ipopt.warm_start_mult_bound_push": 1e-6,
        }
        self._solver = ca.nlpsol("horizon", "ipopt", problem, options)

        low, high = np.zeros((rows, n)), np.ones((rows, n))
        low[:n_z], high[:n_z] = -PLAN_MARGIN, 1 + PLAN_MARGIN
        self._limited: list[tuple[int, int]] = []  # a state, and where its value at sample 1 stands
        for name, kept in (limits or {}).items():
            state = self._state(name)
            end = n_z - self._n_x + state
            low[end], high[end] = (np.array(kept)[:, None] - self._x_low[state]) / self._x_span[state]
            self._limited.append((state, end))
        low[n_z + self._n_mv :] = -np.inf if self._squared else 0.0
        high[n_z + self._n_mv :] = np.inf
        self._bounds = {"lbx": low.ravel("F"), "ubx": high.ravel("F")}
        n_s = self._n_cv * n
        slack = np.zeros(n_s) if self._squared else np.full(2 * n_s, np.inf)
        upper = np.concatenate([np.zeros(n_z * n), slack])
        self._bounds |= {"lbg": np.zeros(upper.size), "ubg": upper}

    def _state(self, name: str) -> int:
        names = [s.name for s in self.plant.state_signals]
        if name not in names:
            raise PlantError(f"plant {self.plant.name!r} has no state {name!r} to limit; it has {', '.join(names)}")
        return names.index(name)

    def _controlled(self) -> ca.Function:
        """Controlled variables in fractions of their ranges, from a scaled state."""
        x = ca.SX.sym("x", self._n_x)
        pv = self.plant.measurement(self._x_low + self._x_span * x)
        return ca.Function("controlled", [x], [pv[: self._n_cv] / self._cv_span])

    def solve(self, x0: Array, sp: Array, p: Array, start: NmpcPlan) -> NmpcPlan:
        """The plan from state ``x0``, begun from ``start``.

        ``x0`` (n_x,); set points ``sp`` (n, n_sp) at samples 1..n; plant parameters ``p`` (n, n_p)
        over periods 0..n-1.

        A plan that was not solved says so (``solved``) and raises nothing: the caller has an older one to go on with.
        """
        scaled = (x0 - self._x_low) / self._x_span
        given = np.concatenate([scaled, (sp / self._cv_span).ravel(), p.ravel()])
        arguments = {"x0": start.values.ravel("F"), "p": given, **self._bounds}
        if self._limited:
            low, high = self._bounds["lbx"].copy(), self._bounds["ubx"].copy()
            for state, end in self._limited:
                low[end], high[end] = min(low[end], scaled[state]), max(high[end], scaled[state])
            arguments |= {"lbx": low, "ubx": high}
        if start.multipliers is not None:
            arguments |= {"lam_x0": start.multipliers[0], "lam_g0": start.multipliers[1]}
        result, stats = self._solver(**arguments), self._solver.stats()
        values = np.array(result["x"]).reshape(self._rows, self.n, order="F")
        multipliers = (np.array(result["lam_x"]), np.array(result["lam_g"]))
        return self._plan(x0, sp, values, bool(stats["success"]), multipliers)

    def _plan(
        self,
        x0: Array,
        sp: Array,
        values: Array,
        solved: bool = False,
        multipliers: tuple[Array, Array] | None = None,
    ) -> NmpcPlan:
        n_z = self._n_x * self._points
        x = np.vstack([x0, self._x_low + self._x_span * values[n_z - self._n_x : n_z].T])
        mv = self._mv_low + self._mv_span * np.clip(values[n_z : n_z + self._n_mv].T, 0.0, 1.0)
        cv = self.plant.measured(x[1:])[:, : self._n_cv]
        error = np.abs(sp - cv) / self._cv_span
        cost = float(np.sum(error**2 if self._squared else error))
        return NmpcPlan(mv, x, cost, solved and bool(np.all(np.isfinite(x))), values, multipliers)

    def _kept(self, x: Array, fraction: float, mv: Array, p: Array, step: Callable[..., Array]) -> float:
        """The fraction of the first MV's range nearest to ``fraction`` that keeps the limits over a period.

        By bisection from either end; the fraction itself where neither end keeps them.
        """

        def keeps(trial: float) -> bool:
            moved = np.array([self._mv_low[0] + trial * self._mv_span[0], *mv[1:]])
            after = (step(x, moved, self.plant.dv_nominal, p) - self._x_low) / self._x_span
            low, high = self._bounds["lbx"], self._bounds["ubx"]
            return all(low[end] <= after[state] <= high[end] for state, end in self._limited)

        end = None if keeps(fraction) else next((end for end in (1.0, 0.0) if keeps(end)), None)
        return fraction if end is None else _halved(end, fraction, keeps)[0]

    def shifted(self, plan: NmpcPlan) -> NmpcPlan:
        """The rest of a plan, its last period repeated: where the next sample's solve starts."""
        mv, x = (np.vstack([rows[1:], rows[-1:]]) for rows in (plan.mv, plan.x))
        values = np.hstack([plan.values[:, 1:], plan.values[:, -1:]])
        return NmpcPlan(mv, x, plan.cost, plan.solved, values, plan.multipliers)

    def rollout(
        self, x0: Array, sp: Array, p: Array, reach: int, step: Callable[..., Array], moves: Array | None = None
    ) -> NmpcPlan:
        """A start for ``solve``: the exact inverse over ``reach`` periods, simulated by ``step``.

        ``moves`` (m, n_mv) are taken over the first m periods in place of the inverse's.

        Each move is the MV that, held for ``reach`` periods, brings the first CV to its set point;
        bisection, so an unreachable one saturates. A plant that ignites has several locally best
        plans, and which one a solver finds depends on when the start ignites: short reaches go
        fast and overshoot, long ones creep.
        """
        x, dv = np.asarray(x0, dtype=np.float64), self.plant.dv_nominal
        mv = self._mv_low + 0.5 * self._mv_span
        values = np.zeros((self._rows, self.n))
        n_z = self._n_x * self._points
        given = np.zeros((0, self._n_mv)) if moves is None else moves
        for k in range(self.n):

            def miss(fraction: float, x: Array = x, k: int = k) -> float:
                trial = mv.copy()
                trial[0] = self._mv_low[0] + fraction * self._mv_span[0]
                for _ in range(reach):
                    x = step(x, trial, dv, p[k])
                return float(sp[k, 0]) - float(self.plant.measure(x)[0])

            if k < len(given):
                mv[:] = given[k]
            else:
                mv[0] = self._mv_low[0] + self._kept(x, _root(miss), mv, p[k], step) * self._mv_span[0]
            passed = np.array(self._trace(x, mv, p[k])).T
            x = passed[-1]
            values[:n_z, k] = ((passed - self._x_low) / self._x_span).ravel()
            values[n_z : n_z + self._n_mv, k] = (mv - self._mv_low) / self._mv_span
            error = (sp[k] - self.plant.measure(x)[: self._n_cv]) / self._cv_span
            values[n_z + self._n_mv :, k] = error if self._squared else np.abs(error)
        return self._plan(np.asarray(x0), sp, values)


def _root(miss: Callable[[float], float]) -> float:
    """The root of ``miss`` in [0, 1] by bisection; without a change of sign, the end where it is nearer to zero."""
    low, high = 0.0, 1.0
    at_low, at_high = miss(low), miss(high)
    if at_low * at_high > 0:
        return low if abs(at_low) < abs(at_high) else high
    return 0.5 * sum(_halved(low, high, lambda middle: miss(middle) * at_low > 0))


def _halved(one: float, other: float, like_one: Callable[[float], bool]) -> tuple[float, float]:
    """Where ``like_one`` changes between two numbers, by bisection: a number on either side."""
    for _ in range(12):
        middle = 0.5 * (one + other)
        one, other = (middle, other) if like_one(middle) else (one, middle)
    return one, other
