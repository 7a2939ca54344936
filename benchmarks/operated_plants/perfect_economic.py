"""The reference: NMPC with the true equations, the same measurements through a filter, and the law's own cost.

    min  sum_k [ sum_o q rho(e_o(k)) + sum_o P(rank_o) rho(b_o(k)) + s (c_y y(k) + c_z z(k)) ]
         + mu sum_j |z_j - z_{j-1}|^2 + sum_k w rest_use (z(k) - rest)^2/2

e is the error on a set point that is followed, b what lies beyond a range, all in the law's own scales; weights,
prices, slope of the costs, move weight, horizon and margin are the law's. It has 8 moves of each MV where the law has
5, and IPOPT solves it at each sample. The extended Kalman filter knows the equations, and the means, speeds and sizes
of what wanders; it has the measurements that the law has, an analyser's as they come.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from operated_plant import Called, OperatedPlant

from loopwright.pipeline.laws.predictive.horizon import Moves
from loopwright.pipeline.laws.predictive.operating import (
    COST_SLOPE,
    MARGIN_SDS,
    RANK_RATIO,
    REST_WEIGHT,
    TINY_COST,
    USUAL_RANK,
)
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.laws.predictive.soft_limits import EPS, PRICE
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Array

MOVES = 8  # of each MV in a plan
LONGEST = 50  # samples of its horizon at most
SMALL = 1e-9  # variance of a state a sample: the equations are exact
ITERATIONS = 40  # of IPOPT at most


class TrueFilter:
    """Extended Kalman filter of [x, w] over the true equations, begun at the rest that the day begins at."""

    def __init__(self, plant: OperatedPlant) -> None:
        self.plant, self.n = plant, len(plant.start[0])
        self.z = np.concatenate([plant.start[0], plant.w0])
        first = [w.sd**2 for w in plant.wanders]
        self.cov = np.diag([SMALL] * self.n + first)
        self.pushes = np.diag([SMALL] * self.n + [w.push**2 for w in plant.wanders])
        x, u, d, w, after = plant.step_symbols
        z = ca.vertcat(x, w)
        kept, mean = ca.DM([v.kept for v in plant.wanders]), ca.DM(plant.w0)
        onward = ca.vertcat(after, mean + kept * (w - mean)) if plant.wanders else after
        shown, true = plant.measured_of(x), ca.vertcat(*plant.output(x[: plant.n_c]))
        self._on = Called(ca.Function("on", [z, u, d], [ca.densify(v) for v in (onward, ca.jacobian(onward, z))]))
        seen = [shown, *(ca.jacobian(y, z) for y in (shown, true))]
        self._see = Called(ca.Function("see", [z], [ca.densify(v) for v in seen]))

    def see(self, pv: Array, fresh: Array) -> Array:
        """Correct by what is fresh; the standard deviation (n_pv,) of the true PVs then."""
        shown, by, of_true = self._see(self.z)
        at = np.flatnonzero(fresh > 0)
        by, left = by[at], pv[at] - shown[at]
        spread = by @ self.cov @ by.T + np.diag(np.array(self.plant.noise)[at] ** 2)
        gain = np.linalg.solve(spread, by @ self.cov).T
        self.z = self.z + gain @ left
        self.cov = self.cov - gain @ by @ self.cov
        self.cov = 0.5 * (self.cov + self.cov.T)
        return np.sqrt(np.maximum(np.diag(of_true @ self.cov @ of_true.T), 0.0))

    def go_on(self, mv: Array, dv: Array) -> None:
        """To the next sample."""
        after, by = self._on(self.z, mv, dv)
        self.z, self.cov = after, by @ self.cov @ by.T + self.pushes


class PerfectEconomic:
    """The NMPC, for the scales and numbers of ``law``; one object may run one day after another."""

    def __init__(self, plant: OperatedPlant, law: Predictive, model: Identified) -> None:
        self.plant, self.moves = plant, Moves.over(
            min(law.moves.horizon, LONGEST), MOVES, len(plant.mv), ramps=law.moves.ramps
        )  # fmt: skip
        self.y_scale = model.y_scale.numpy()[: len(plant.pv)]
        self.middle, self.half = law.mv_middle.numpy(), law.mv_half.numpy()
        # The law's curvature of its moves' cost is 2 mu on the last move, which only one change touches.
        self.mu = float(law.planner.moved[-1, -1]) / 2
        self.eps = float(law.planner.eps_squared) ** 0.5
        self.failures = 0
        self.reset()

    def reset(self) -> None:
        """Begin a day."""
        self.filter, self.mv = TrueFilter(self.plant), None
        _, mv = self.plant.start
        self.plan = np.tile((mv - self.middle) / self.half, len(self.moves.starts))
        self.sd = np.zeros(len(self.plant.pv))

    @cached_property
    def solver(self) -> tuple[Any, Array, Array, Array, Array]:
        """The solver, and ends of the plan and of its changes."""
        plant, moves, y_scale = self.plant, self.moves, self.y_scale
        n_mv, operate = len(plant.mv), plant.operate
        x, u, d, w, after = plant.step_symbols
        kept, mean = ca.DM([v.kept for v in plant.wanders]), ca.DM(plant.w0)
        on = ca.Function("on", [x, u, d, w], [after, mean + kept * (w - mean) if plant.wanders else w])
        true = ca.Function("true", [x], [ca.vertcat(*plant.output(x[: plant.n_c]))])
        z = ca.SX.sym("z", moves.count)
        x0, w0, dv, sp, mv, sd = (
            ca.SX.sym(n, k)
            for n, k in (("x0", x.shape[0]), ("w0", w.shape[0]), ("dv", d.shape[0]), ("sp", len(plant.sp)),
                         ("mv", n_mv), ("sd", len(plant.pv)))
        )  # fmt: skip
        plan = ca.reshape(z, n_mv, len(moves.starts))
        of_pv, of_mv = plant.costs
        of_pv, of_mv = of_pv * y_scale, of_mv * self.half
        largest = max(float(np.abs(np.r_[of_pv, of_mv]).max()), TINY_COST)
        cost, now, wandering = 0, x0, w0
        for k in range(moves.horizon):
            share = plan @ ca.DM(moves.profile[k])
            now, wandering = on(now, ca.DM(self.middle) + ca.DM(self.half) * share, dv, wandering)
            y = true(now)
            for i, s in enumerate(plant.pv):
                low, high = plant.range_of(i)
                if plant.tracked(i):
                    e = (y[i] - ca.fmin(ca.fmax(sp[i], low), high)) / y_scale[i]
                    cost += ca.sqrt(e * e + self.eps**2)
                    inside = 0
                else:
                    inside = ca.fmin(MARGIN_SDS * sd[i], 0.5 * (high - low))
                if (low, high) != (s.low, s.high):
                    b = (ca.fmax(y[i] - high + inside, 0) + ca.fmax(low + inside - y[i], 0)) / y_scale[i]
                    price = PRICE * RANK_RATIO ** (USUAL_RANK - operate.get(f"{s.name}.rank", USUAL_RANK))
                    cost += price * ca.sqrt(b * b + EPS**2)
                cost += COST_SLOPE / largest * of_pv[i] * y[i] / y_scale[i]
            for i, m in enumerate(plant.mv):
                cost += COST_SLOPE / largest * of_mv[i] * share[i]
                if operate.get(f"{m.name}.rest_use", 0.0):
                    rest = (operate.get(f"{m.name}.rest", m.middle) - self.middle[i]) / self.half[i]
                    cost += 0.5 * REST_WEIGHT * (share[i] - rest) ** 2
        first = (mv - ca.DM(self.middle)) / ca.DM(self.half)
        changes = z - ca.vertcat(first, z[:-n_mv])
        cost += self.mu * ca.sumsqr(changes)
        rate = np.array([np.inf if m.max_move is None else m.max_move for m in plant.mv]) / self.half
        rates = np.tile(rate, len(moves.starts)) * moves.lengths
        low, high = ((end - self.middle) / self.half for end in plant.mv_ends())
        ends = (np.tile(end, len(moves.starts)) for end in (low, high))
        nlp = {"x": z, "f": cost, "g": changes, "p": ca.vertcat(x0, w0, dv, sp, mv, sd)}
        options = {
            "print_time": False,
            "ipopt": {"print_level": 0, "sb": "yes", "max_iter": ITERATIONS, "tol": 1e-4, "acceptable_tol": 1e-3,
                      "mu_init": 1e-3, "warm_start_init_point": "yes"},
        }  # fmt: skip
        return ca.nlpsol("nmpc", "ipopt", nlp, options), *ends, -rates, rates

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        if self.mv is not None:
            self.filter.go_on(mv, self.dv)
        sd = self.filter.see(pv, fresh)
        solver, low, high, least, most = self.solver
        known = np.concatenate([self.filter.z, dv, sp, mv, sd])
        found = solver(x0=self.plan, p=known, lbx=low, ubx=high, lbg=least, ubg=most)
        if solver.stats()["success"] or solver.stats()["return_status"] == "Maximum_Iterations_Exceeded":
            plan = np.array(found["x"])[:, 0]
        else:
            self.failures += 1
            plan = self.plan
        self.plan, n_mv = plan @ self.moves.shift, len(mv)
        wanted = self.middle + self.half * plan[:n_mv]
        rate = np.array([np.inf if m.max_move is None else m.max_move for m in self.plant.mv])
        ends = self.plant.mv_ends()
        self.mv = np.clip(np.clip(wanted, *ends), mv - rate, mv + rate)
        self.dv = dv.copy()
        return np.asarray(self.mv)
