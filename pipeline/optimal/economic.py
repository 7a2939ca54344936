"""The best rest of an identified plant for its operators: ranges kept by their ranks, then set points, then costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from loopwright.pipeline.optimal.model_bounds import transition
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.plants.simulator import Array

REST_ITERATIONS_OF_IPOPT = 300  # of the solver in each of its solves
GIVEN_AWAY = 1e-6  # scaled: by how much a later aim may worsen an earlier one, for the solver's last digits
NEAR_THE_START = 1e-6  # weight of a squared move away from the start, in ranges: of equal rests the nearest one
WIDE_STATE = 1e3  # scaled: no rest is sought beyond it


@dataclass(frozen=True, slots=True)
class RestWishes:
    """Operators' wishes for a rest; arrays by PV (n_y,) and by MV (n_mv,), in their units.

    ``y_use`` and ``track`` are 0 or 1, ``rank`` is kept first where it is smallest. An MV ``held`` stays at its value,
    NaN for one that is in use. Costs count per unit and period.
    """

    y_use: Array
    track: Array
    y_low: Array
    y_high: Array
    rank: Array
    y_cost: Array
    mv_low: Array
    mv_high: Array
    mv_cost: Array
    held: Array


@dataclass(frozen=True, slots=True)
class BestRest:
    """The best rest: PVs (n_y,), MVs (n_mv,), how far each PV is outside its range (n_y,), all in their units."""

    y: Array
    mv: Array
    outside: Array


class RestProblem:
    """The rests of one plant, and the best of them for what operators ask.

    The aims follow one another, each as good as those before it allow:

        for each rank, 1 first:  min  sum_i use_i (max(low_i - y_i, 0) + max(y_i - high_i, 0)) / width_i
        then                     min  sum_i use_i track_i |r_i - y_i| / width_i
        then                     min  c_y' y + c_u' u

    over x and u with x = F(x, u) and u within the operators' limits; widths are those of the signals' ranges. The plant
    is known exactly, so no controller's rest is better. One that integrates rests under MVs that balance it.
    """

    def __init__(self, plant: IdentifiedPlant) -> None:
        self.plant = plant
        f, m, n, n_y = plant.arrays, plant.n_mv, len(plant.arrays.a), len(plant.arrays.y_scale)
        self._n, self._m, self._n_y, self._n_sp = n, m, n_y, len(plant.sp_signals)
        self._mv_low = np.array([s.low for s in plant.mv_signals])
        self._mv_width = np.array([s.high - s.low for s in plant.mv_signals])
        self._width = np.array([s.high - s.low for s in plant.pv_signals])
        x, z, s, t = ca.SX.sym("x", n), ca.SX.sym("z", m), ca.SX.sym("s", n_y), ca.SX.sym("t", self._n_sp)
        mv = self._mv_low + self._mv_width * z
        scaled = (mv - f.v_center[:m]) / f.v_scale[:m]
        whole = ca.vertcat(x, *[scaled] * plant.most_dead_time)
        p, dv = ca.SX.sym("p", len(plant.parameter_names())), ca.SX.sym("dv", len(plant.dv_signals))
        delayed = np.eye(plant.most_dead_time + 1)[0]  # at rest all past MVs are the present one
        gap = transition(plant)(whole, mv, p, delayed, dv)[:n] - x
        y = f.y_center + f.y_scale * x[:n_y]
        low, high, sp = ca.SX.sym("low", n_y), ca.SX.sym("high", n_y), ca.SX.sym("r", self._n_sp)
        z0, groups = ca.SX.sym("z0", m), ca.SX.sym("groups", n_y * n_y)
        of_s, of_t, of_y, of_z = (ca.SX.sym(*of) for of in (("cs", n_y), ("ct", self._n_sp), ("cy", n_y), ("cz", m)))
        error = (sp - y[: self._n_sp]) / self._width[: self._n_sp]
        cost = ca.dot(of_s, s) + ca.dot(of_t, t) + ca.dot(of_y, y / self._width) + ca.dot(of_z, z)
        cost += NEAR_THE_START * ca.sumsqr(z - z0)
        violated = ca.mtimes(ca.reshape(groups, n_y, n_y), s)
        tracked = ca.SX.sym("use", self._n_sp)
        bound = ca.vertcat(
            gap, s - (low - y) / self._width, s - (y - high) / self._width, t - error, t + error, violated,
            ca.dot(tracked, t),
        )  # fmt: skip
        given = ca.vertcat(p, dv, low, high, sp, z0, groups, of_s, of_t, of_y, of_z, tracked)
        options: Any = {
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.linear_solver": "mumps",
            "ipopt.tol": 1e-9,
            "ipopt.max_iter": REST_ITERATIONS_OF_IPOPT,
        }
        problem: Any = {"x": ca.vertcat(x, z, s, t), "p": given, "f": cost, "g": bound}
        self._solver = ca.nlpsol("rest", "ipopt", problem, options)

    def best(self, asked: RestWishes, sp: Array, p: Array, dv: Array, begin: tuple[Array, Array]) -> BestRest | None:
        """The best rest under set points sp (n_sp,), parameters p (n_p,) and measured disturbances dv (n_dv,).

        ``begin`` is (state (n_x,), mv (n_mv,)) of a rest nearby, where the search starts. None where no rest is found.
        """
        n, m, n_y, n_sp = self._n, self._m, self._n_y, self._n_sp
        x0, z0 = begin[0][:n], (begin[1] - self._mv_low) / self._mv_width
        ranks = sorted(set(asked.rank[asked.y_use > 0].tolist()))
        groups, most = np.zeros((n_y, n_y)), np.full(n_y, np.inf)
        for k, rank in enumerate(ranks[:n_y]):
            groups[k] = (asked.rank == rank) * asked.y_use
        tracked, most_error = (asked.track * asked.y_use)[:n_sp], np.inf
        z_low, z_high = ((of - self._mv_low) / self._mv_width for of in (asked.mv_low, asked.mv_high))
        stay = np.isfinite(asked.held)
        at = (asked.held - self._mv_low) / self._mv_width
        z_low, z_high = np.where(stay, at, z_low), np.where(stay, at, z_high)
        lower = np.concatenate([np.full(n, -WIDE_STATE), z_low, np.zeros(n_y + n_sp)])
        upper = np.concatenate([np.full(n, WIDE_STATE), z_high, np.full(n_y + n_sp, np.inf)])
        values = np.concatenate([x0, np.clip(z0, z_low, z_high), np.zeros(n_y + n_sp)])
        nothing = {"s": np.zeros(n_y), "t": np.zeros(n_sp), "y": np.zeros(n_y), "z": np.zeros(m)}
        stages: list[Mapping[str, Array]] = [{"s": groups[k]} for k in range(len(ranks[:n_y]))]
        stages += [{"t": tracked}] if tracked.any() else []
        cost = {"y": asked.y_cost * self._width, "z": asked.mv_cost * self._mv_width}
        dearest = max(float(np.max(np.abs(of), initial=0.0)) for of in cost.values())
        stages += [{name: of / dearest for name, of in cost.items()}] if dearest > 0 else []
        for k, stage in enumerate(stages or [nothing]):
            of = {**nothing, **stage}
            given = np.concatenate(
                [p, dv, asked.y_low, asked.y_high, sp, z0, groups.ravel("F"), of["s"], of["t"], of["y"], of["z"],
                 tracked]
            )  # fmt: skip
            slack = np.full(2 * (n_y + n_sp), np.inf)
            result = self._solver(
                x0=values, p=given, lbx=lower, ubx=upper,
                lbg=np.concatenate([np.zeros(n + len(slack)), np.full(n_y + 1, -np.inf)]),
                ubg=np.concatenate([np.zeros(n), slack, most, [most_error]]),
            )  # fmt: skip
            if not self._solver.stats()["success"]:
                return None
            values = np.array(result["x"]).ravel()
            s, t = values[n + m : n + m + n_y], values[n + m + n_y :]
            if k < len(ranks[:n_y]):
                most[k] = float(groups[k] @ s) + GIVEN_AWAY
            elif "t" in stage:
                most_error = float(tracked @ t) + GIVEN_AWAY
        y = self.plant.measured(values[:n])
        mv = self._mv_low + self._mv_width * np.clip(values[n : n + m], 0, 1)
        outside = np.maximum(asked.y_low - y, 0) + np.maximum(y - asked.y_high, 0)
        return BestRest(y, mv, np.where(outside > 2 * n_y * GIVEN_AWAY * self._width, outside, 0.0))
