"""The bounds of a case that is tested on models: an NMPC that knows the model of each test, kept until that changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.metric import together
from loopwright.pipeline.files import digest, read_json, write_json
from loopwright.pipeline.optimal.bounds import Bounds
from loopwright.pipeline.optimal.nmpc_horizon import MOVE_WEIGHT
from loopwright.pipeline.plants.identified import IdentifiedPlant, shift_rows
from loopwright.pipeline.plants.plant_digest import identified_digest
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario

HORIZON = (20, 60)  # least and most samples that a plan looks ahead
EVERY = 4  # parts of the horizon: a plan is followed over one of them while its predictions come true
SCALED_CAME_TRUE = 1e-7  # scaled: how far a state may be from its prediction
ARRIVED_ERROR = 1e-4  # of the CVs' ranges: a plan whose error from here on is less is followed to its end
MOST_ITERATIONS = 200  # of the solver at a sample


@dataclass(frozen=True, slots=True)
class SampledPlan:
    """Moves over the horizon, the states that they lead to, and what the next solve begins from."""

    mv: Array  # (n, n_mv)
    x: Array  # (n + 1, n_x), the first one given
    error: Array  # (n,) sum of the CVs' errors at samples 1..n, in shares of their ranges
    solved: bool
    values: Array  # all variables of the problem
    multipliers: tuple[Array, Array]


def transition(plant: IdentifiedPlant) -> ca.Function:
    """CasADi function (x, mv, p, delayed, dv) -> x one period later; as ``IdentifiedPlant.step``.

    ``p`` (n_p,) are the plant's parameters, ``delayed`` (most_dead_time + 1,) the shares of the present and the past
    MVs that a dead time lets act (``shares``); p's own entry for the dead time is not used.
    """
    f, m, most = plant.arrays, plant.n_mv, plant.most_dead_time
    n, n_y = len(f.a), len(f.y_scale)
    x, mv = ca.SX.sym("x", n + most * m), ca.SX.sym("mv", m)
    p, delayed = ca.SX.sym("p", len(plant.parameter_names())), ca.SX.sym("delayed", most + 1)
    first = (plant.start[1] - f.v_center[:m]) / f.v_scale[:m]
    held = ca.vertcat((mv - f.v_center[:m]) / f.v_scale[:m], x[n:])
    acting = sum(delayed[k] * held[k * m : (k + 1) * m] for k in range(most + 1))
    dv = ca.SX.sym("dv", len(plant.dv_signals))
    v = ca.vertcat(first + p[:m] * (acting - first), (dv - f.v_center[m:]) / f.v_scale[m:])
    remembers = ca.DM(shift_rows(f).astype(np.float64))

    def advanced(at: Any) -> Any:
        after = ca.mtimes(f.a, at) + ca.mtimes(f.b, v) + f.c
        return after + ca.mtimes(f.w2, ca.tanh(ca.mtimes(f.w1, ca.vertcat(at, v)) + f.b1)) if len(f.b1) else after

    ahead = advanced(x[:n])
    second = advanced(remembers * x[:n] + (1 - remembers) * ahead)
    slower, faster = x[:n] + (ahead - x[:n]) / p[m], ahead + (1 / p[m] - 1) * (second - ahead)
    ahead = remembers * ahead + (1 - remembers) * ca.if_else(p[m] < 1, faster, slower)
    load = ca.vertcat(p[m + 2 :] / f.y_scale, np.zeros(n - n_y))
    after_a_period = ca.densify(ca.vertcat(ahead + load, held[: most * m]))
    return ca.Function("transition", [x, mv, p, delayed, dv], [after_a_period])


def shares(plant: IdentifiedPlant, p: Array) -> Array:
    """Shares (most_dead_time + 1,) of the present and the past MVs that act under the dead time in p (n_p,)."""
    dead = min(p[plant.n_mv + 1], plant.most_dead_time)
    return np.clip(1 - np.abs(np.arange(plant.most_dead_time + 1) - dead), 0, 1)


class SampledHorizon:
    r"""Best moves over ``n`` samples for an identified plant that is known exactly.

        min  sum_k sum_i |r_i - y_i(k)| / span_i  +  w sum_k ((u(k) - u(k-1)) / span_u)^2,   k = 1..n

    over u(0)..u(n-1) within the MVs' ranges, and |u(k) - u(k-1)| at most ``max_move`` of an MV that has one, u(-1)
    being the MV that acts now. All states are variables and the state equation a constraint; the absolute value
    enters through slacks. The weight w chooses among equal errors.
    """

    def __init__(self, plant: IdentifiedPlant, n: int) -> None:
        self.plant, self.n = plant, n
        self._n_x, self._m, self._n_cv = plant.n_x, plant.n_mv, len(plant.sp_signals)
        self._low = np.array([s.low for s in plant.mv_signals])
        self._span = np.array([s.high - s.low for s in plant.mv_signals])
        self._cv_span = np.array([s.high - s.low for s in plant.sp_signals])
        self._rows = self._n_x + self._m + self._n_cv
        f, n_cv = plant.arrays, self._n_cv
        w = ca.MX.sym("w", self._rows * n)
        table = ca.reshape(w, self._rows, n)
        x, z, s = ca.vertsplit(table, [0, self._n_x, self._n_x + self._m, self._rows])
        p = ca.MX.sym("p", len(plant.parameter_names()))
        x0, delayed, sp = ca.MX.sym("x0", self._n_x), ca.MX.sym("d", plant.most_dead_time + 1), ca.MX.sym("r", n_cv)
        held = [j for j, s in enumerate(plant.mv_signals) if s.max_move is not None]
        most = np.array([plant.mv_signals[j].max_move for j in held], dtype=np.float64) / self._span[held]
        last = ca.MX.sym("u", self._m if held else 0)  # in shares of the range
        starts, dv = ca.horzcat(x0, x[:, :-1]), ca.MX.sym("dv", len(plant.dv_signals))
        every = [ca.repmat(value, 1, n) for value in (p, delayed, dv)]
        gap = x - transition(plant).map(n)(starts, self._low + self._span * z, *every)
        y = f.y_center[:n_cv] + f.y_scale[:n_cv] * x[:n_cv, :]
        error = (ca.repmat(sp, 1, n) - y) / self._cv_span
        moves = z[:, 1:] - z[:, :-1]
        cost = ca.sum1(ca.vec(s)) + MOVE_WEIGHT[False] * ca.sumsqr(moves)
        change = ca.horzcat(z[held, 0] - last[held], moves[held, :]) if held else ca.MX(0, n)
        bound = ca.vertcat(ca.vec(gap), ca.vec(s - error), ca.vec(s + error), ca.vec(change))
        problem: Any = {"x": w, "p": ca.vertcat(x0, sp, p, delayed, dv, last), "f": cost, "g": bound}
        options: Any = {
            "expand": True,
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.linear_solver": "mumps",
            "ipopt.tol": 1e-7,
            "ipopt.max_iter": MOST_ITERATIONS,
            "ipopt.mu_init": 1e-3,
            "ipopt.warm_start_init_point": "yes",
            "ipopt.warm_start_bound_push": 1e-6,
            "ipopt.warm_start_slack_bound_push": 1e-6,
            "ipopt.warm_start_mult_bound_push": 1e-6,
        }
        self._solver = ca.nlpsol("sampled", "ipopt", problem, options)
        low, high = np.full((self._rows, n), -np.inf), np.full((self._rows, n), np.inf)
        low[self._n_x :] = 0.0
        high[self._n_x : self._n_x + self._m] = 1.0
        size, step = 2 * n_cv * n, np.tile(most, n)
        of_g = {"lbg": np.concatenate([np.zeros(self._n_x * n + size), -step])}
        of_g |= {"ubg": np.concatenate([np.zeros(self._n_x * n), np.full(size, np.inf), step])}
        self._bounds = {"lbx": low.ravel("F"), "ubx": high.ravel("F"), **of_g}
        # Groups of constraints, in the order of ``bound``: rows of each in a sample.
        self._groups, self._limited = (self._n_x, n_cv, n_cv, len(held)), bool(held)

    def solve(
        self, x0: Array, mv: Array, sp: Array, p: Array, dv: Array, before: SampledPlan | None = None, age: int = 0
    ) -> SampledPlan:
        """The plan from a state x0 (n_x,) to set points sp (n_cv,) under parameters p (n_p,) and dv (n_dv,).

        It begins with the rest of the plan ``before`` after ``age`` samples, its last period repeated, else with
        mv (n_mv,) held, the MV that acts now.
        """
        last = (mv - self._low) / self._span if self._limited else np.zeros(0)
        arguments: dict[str, Any] = {"p": np.concatenate([x0, sp, p, shares(self.plant, p), dv, last]), **self._bounds}
        if before is None:
            arguments["x0"] = self._held(x0, mv, sp, p, dv).ravel("F")
        else:
            at = np.minimum(np.arange(self.n) + age, self.n - 1)
            arguments["x0"] = self._table(before.values)[:, at].ravel("F")
            of_x, of_g = before.multipliers[0].ravel(), before.multipliers[1].ravel()
            groups = np.split(of_g, np.cumsum(self._groups)[:-1] * self.n)
            shifted = [group.reshape(-1, self.n, order="F")[:, at].ravel("F") for group in groups]
            arguments |= {"lam_x0": self._table(of_x)[:, at].ravel("F"), "lam_g0": np.concatenate(shifted)}
        result, stats = self._solver(**arguments), self._solver.stats()
        values = np.array(result["x"]).ravel()
        table = self._table(values)
        x = np.vstack([x0, table[: self._n_x].T])
        moves = self._low + self._span * np.clip(table[self._n_x : self._n_x + self._m].T, 0, 1)
        error = np.abs(sp - self.plant.measured(x[1:])[:, : self._n_cv]) / self._cv_span
        multipliers = (np.array(result["lam_x"]), np.array(result["lam_g"]))
        solved = bool(stats["success"]) and bool(np.all(np.isfinite(values)))
        return SampledPlan(moves, x, error.sum(axis=1), solved, values, multipliers)

    def _table(self, values: Array) -> Array:
        """All variables as rows (states, moves, slacks) by samples."""
        return values.reshape(self._rows, self.n, order="F")

    def _held(self, x0: Array, mv: Array, sp: Array, p: Array, dv: Array) -> Array:
        """All variables with the MVs held."""
        values, x = np.zeros((self._rows, self.n)), x0
        for k in range(self.n):
            x = self.plant.step(x, mv, dv, p)
            error = np.abs(sp - self.plant.measured(x)[: self._n_cv]) / self._cv_span
            values[:, k] = np.concatenate([np.clip(x, -1e3, 1e3), (mv - self._low) / self._span, error])
        return values


def run_sampled(
    horizon: SampledHorizon, test: Scenario, score: Callable[[Scenario, Array, Array], Mapping[str, float]]
) -> dict[str, float]:
    """Figures of the NMPC over one test on its plant, by ``score``, with its ``failures``; it sees no noise.

    It sees the set points and the measured disturbances of now and thinks that they stay. Parameters it knows one
    sample late, as an observer tells them at best. A plan is followed while it comes true, at most ``1 / EVERY`` of
    the horizon, or to its end once nothing is left of the error.
    """
    plant = horizon.plant
    parameters, measured = test.parameters(plant), test.disturbances(plant)
    x, mv, age, failures = test.x0, test.mv0, 0, 0
    plan: SampledPlan | None = None
    states, moves = [], []
    for k in range(test.samples):
        sp, p, dv = test.sp[k], parameters[max(k - 1, 0)], measured[k]
        before = (test.sp[k - 1], parameters[max(k - 2, 0)], measured[k - 1])
        same = k > 0 and all(map(np.array_equal, (sp, p, dv), before))
        expected = (
            plan is not None
            and same
            and np.max(np.abs(x - plan.x[age])) <= SCALED_CAME_TRUE * max(1.0, np.abs(x).max())
        )
        arrived = plan is not None and age < horizon.n and float(plan.error[age:].max()) <= ARRIVED_ERROR
        if plan is None or not expected or age >= (horizon.n if arrived else max(horizon.n // EVERY, 1)):
            found = horizon.solve(x, mv, sp, p, dv, plan if expected else None, age)
            if not found.solved and plan is not None and expected:
                found = horizon.solve(x, mv, sp, p, dv)
            failures += not found.solved
            plan, age = found, 0
        states.append(x)
        mv = plan.mv[age]
        moves.append(mv)
        x, age = plant.step(x, mv, dv, parameters[k]), age + 1
    figures = score(test, plant.measured(np.array(states)), np.array(moves))
    return {**figures, "failures": float(failures)}


# --------------------------------------------------------------------------- bounds of a case that is tested on models
MODEL_BOUNDS_SCHEMA = 1  # version of the file of kept bounds: another one is computed anew
ANSWERS_A_HOLD = 3  # a hold lasts so many times as long as an answer of the plant; without a hold, the whole test


def model_bounds(case: Case, kept: Path) -> Bounds:
    """Figures of the NMPC by test, of all tests that run on identified plants; ``kept`` is the file they stay in.

    The noise does not reach the NMPC, which is given the state: a test with noise has the bound of that without.
    """
    tests = {name: rows for name, rows in case.tests().items() if all(map(_on_model, rows)) and not rows[0].replayed}
    known, keys = _read(kept), {(name, i): _key(test) for name, rows in tests.items() for i, test in enumerate(rows)}
    work = [item for item, key in keys.items() if key not in known]
    # Sequences of one model follow each other: a process builds the problem of a model once.
    work.sort(key=lambda item: identified_digest(_plant(tests[item[0]][item[1]])))
    found = (
        parallel_map(partial(_bound, case), work, f"report {case.name}: the bound, control that knows the model (NMPC)")
        if work
        else []
    )
    known |= {keys[item]: figures for item, figures in zip(work, found, strict=True)}
    used = {key: known[key] for key in keys.values()}
    if work or set(used) != set(_read(kept)):
        write_json(kept, {"schema": MODEL_BOUNDS_SCHEMA, "figures": used})
    bounds: Bounds = {}
    for name, rows in tests.items():
        figures = together((used[keys[name, i]] for i in range(len(rows))), case.metrics)
        bounds[name] = {"nmpc": figures}
        bounds[name + NOISE_SUFFIX] = {"nmpc": dict(figures)}
    return bounds


def _bound(case: Case, item: tuple[str, int]) -> dict[str, float]:
    test = case.tests()[item[0]][item[1]]
    plant = _plant(test)
    looks = int(np.clip(-(-(test.hold or test.samples // 2) // ANSWERS_A_HOLD), *HORIZON))
    figures = run_sampled(_horizon(_Same(plant), looks), test, case.score)
    return {name: float(f"{value:.6g}") for name, value in figures.items()}


class _Same:
    """A plant that equals any other of the same equation and start."""

    def __init__(self, plant: IdentifiedPlant) -> None:
        self.plant, self.key = plant, identified_digest(plant)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.key == self.key

    def __hash__(self) -> int:
        return hash(self.key)


@lru_cache(maxsize=2)
def _horizon(of: _Same, n: int) -> SampledHorizon:
    return SampledHorizon(of.plant, n)


def _on_model(test: Scenario) -> bool:
    return isinstance(test.plant, IdentifiedPlant)


def _plant(test: Scenario) -> IdentifiedPlant:
    assert isinstance(test.plant, IdentifiedPlant)
    return test.plant


def _key(test: Scenario) -> str:
    return digest([identified_digest(_plant(test)), test.digest(), list(HORIZON), EVERY])


def _read(kept: Path) -> dict[str, dict[str, float]]:
    """The kept bounds; nothing where the file is missing, damaged or of another schema."""
    try:
        stored: Any = read_json(kept)
    except (OSError, ValueError, PipelineError):
        return {}
    return dict(stored["figures"]) if isinstance(stored, dict) and stored.get("schema") == MODEL_BOUNDS_SCHEMA else {}
