"""A plant in equations: from one text of its derivative, all that a simulator gives, and what only equations give."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.simulator import Advance, AdvanceMany, Array, Simulator
from loopwright.pipeline.plants.steady import Linearization, SteadyStates
from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class EquationPlant(Simulator):
    """A continuous-time plant in CasADi, sampled with its MV held over each period.

    A subclass is a frozen dataclass whose fields are its parameters (each with
    ``metadata={"unit": ...}``), states its signals, and writes ``derivative`` once. From that one
    text come the integrators, the steady states, the linearization and the perfect-model NMPC.
    Any parameter may be changed during a simulation by its name: that is a disturbance which the
    controller does not measure. Measured disturbances are ``dv``.
    """

    state_signals: ClassVar[tuple[Signal, ...]]
    substeps: ClassVar[int]  # of RK4 a period
    time_unit_s: ClassVar[float] = 1.0  # the unit of time in which ``derivative`` is written

    @abstractmethod
    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt, shape (n_x,), from CasADi columns x (n_x,), mv (n_mv,), dv (n_dv,)."""

    def output(self, x: Any) -> Any:
        """The process variables of a state; the state itself unless overridden."""
        return x

    @property
    def measures_states(self) -> bool:
        """Whether the process variables are the states."""
        return type(self).output is EquationPlant.output

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.state_signals)

    @property
    def start(self) -> tuple[Array, Array]:
        """(x (n_x,), mv (n_mv,)) where an experiment starts: the steady state nearest the middle of the MV's range."""
        _, xs, mvs = self.steady_curve
        mv = self.mv_signals[0]
        nearest = int(np.argmin(np.abs(mvs - (mv.low + mv.high) / 2)))
        return np.asarray(xs[nearest]), np.array([mvs[nearest]])

    # ------------------------------------------------------------------ discrete MVs
    def relaxed(self) -> EquationPlant:
        """A plant of the same states and parameters whose MVs are all continuous, for solvers that know no others.

        This plant itself unless it has a discrete MV: it then gives one that can do whatever it can, so that
        what is best there bounds what can be done here. PlantError where it does not.
        """
        discrete = [s.name for s in self.mv_signals if s.values is not None]
        if discrete:
            raise PlantError(f"plant {self.name!r} has the discrete MV {discrete[0]!r} and no relaxed() without it")
        return self

    def actual(self, mv: Array) -> Array:
        """The MVs of the plant that this one relaxes, from its own, both (n, n_mv)."""
        return mv

    # ------------------------------------------------------------------ parameters
    def with_parameters(self, changed: Mapping[str, float]) -> Self:
        """A plant with other parameters: a different plant, or one that drifted."""
        self.parameters(changed)
        return replace(self, **{k: float(v) for k, v in changed.items()})

    # ------------------------------------------------------------------ CasADi functions
    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """(x, mv, dv, p, dx/dt) with every parameter symbolic, from the one text of derivative."""
        names = self.parameter_names()
        x = ca.SX.sym("x", len(self.state_signals))
        mv = ca.SX.sym("mv", len(self.mv_signals))
        dv = ca.SX.sym("dv", len(self.dv_signals))
        p = ca.SX.sym("p", len(names))
        symbolic = replace(self, **{n: p[i] for i, n in enumerate(names)})
        return x, mv, dv, p, ca.vertcat(symbolic.derivative(x, mv, dv))

    @cached_property
    def rate(self) -> ca.Function:
        """CasADi function (x, mv, dv, p) -> dx/dt."""
        x, mv, dv, p, dx = self._symbols
        return ca.Function("rate", [x, mv, dv, p], [ca.densify(dx)])

    @cached_property
    def measurement(self) -> ca.Function:
        """CasADi function x -> pv."""
        x = self._symbols[0]
        return ca.Function("measure", [x], [ca.densify(ca.vertcat(self.output(x)))])

    @cached_property
    def transition(self) -> ca.Function:
        """CasADi function (x, mv, dv, p) -> x one period later; fixed-step RK4, ``substeps`` a period."""
        x, mv, dv, p, _ = self._symbols
        h = self.period_s / self.time_unit_s / self.substeps
        state = x
        for _ in range(self.substeps):
            state = rk4_step(lambda at: self.rate(at, mv, dv, p), state, h)
        return ca.Function("transition", [x, mv, dv, p], [ca.densify(state)])

    # ------------------------------------------------------------------ what a closed loop needs
    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        """The state one period later, by ``transition``; shapes as in Simulator."""
        return np.array(self.transition(x, mv, dv, p))[:, 0]

    def measure(self, x: Array) -> Array:
        """The process variables (n_pv,) of a state (n_x,)."""
        return self.measured(x)

    def measured(self, x: Array) -> Array:
        """Process variables, shape (..., n_pv), of states of shape (..., n_x)."""
        if self.measures_states:
            return x  # the state itself, and a call into CasADi for each sample would cost as much as its step
        flat = x.reshape(-1, x.shape[-1])
        return np.array(self.measurement(flat.T)).T.reshape(*x.shape[:-1], -1)

    def many(self, n: int, p: Array | None = None) -> AdvanceMany:
        """``step`` of ``n`` runs side by side through one CasADi map; as in Simulator."""
        batch = self.transition.map(n)
        dv = np.tile(self.dv_nominal[:, None], (1, n))
        columns = np.tile((self.parameters() if p is None else p)[:, None], (1, n))

        def advance(x: Array, mv: Array) -> Array:
            return np.array(batch(x.T, mv.T, dv, columns)).T

        return advance

    def stepper(self) -> Advance:
        """``step(x, mv, dv, p) -> x`` through CasADi's buffers, which skip its argument conversion."""
        buffer: Any  # casadi's type stubs have other signatures than its buffers
        evaluate: Any
        buffer, evaluate = self.transition.buffer()
        args = [np.zeros(n) for n in (self.transition.numel_in(i) for i in range(4))]
        result = np.zeros(len(self.state_signals))
        for i, arg in enumerate(args):
            if arg.size:
                buffer.set_arg(i, arg.data)
        buffer.set_res(0, result.data)

        def step(x: Array, mv: Array, dv: Array, p: Array) -> Array:
            for arg, value in zip(args, (x, mv, dv, p), strict=True):
                arg[:] = value
            evaluate()
            return result.copy()

        step.buffer = buffer  # type: ignore[attr-defined]  # evaluate() only borrows it
        return step

    def meter(self) -> Callable[[Array], Array]:
        """``measure(x) -> pv`` through CasADi's buffers, as ``stepper``."""
        if self.measures_states:
            return self.measure
        buffer: Any
        evaluate: Any
        buffer, evaluate = self.measurement.buffer()
        state, result = np.zeros(self.n_x), np.zeros(self.measurement.numel_out(0))
        buffer.set_arg(0, state.data)
        buffer.set_res(0, result.data)

        def measure(x: Array) -> Array:
            state[:] = x
            evaluate()
            return result.copy()

        measure.buffer = buffer  # type: ignore[attr-defined]  # evaluate() only borrows it
        return measure

    # ------------------------------------------------------------------ steady states
    @cached_property
    def _steady(self) -> SteadyStates:
        scale = self.period_s / self.time_unit_s
        return SteadyStates(
            lambda x, mv: self.rate(x, mv, self.dv_nominal, self.parameters()) * scale,
            lambda x: self.measurement(x)[0],
            (*self.state_signals, *self.mv_signals),
            self.sp_signals[0],
        )

    @cached_property
    def steady_curve(self) -> tuple[Array, Array, Array]:
        """Steady states along the controlled variable: (cv (n,), x (n, n_x), mv (n,)).

        For a plant with one MV and one CV. Raises PlantError where it has none in its set-point range.
        """
        if len(self.mv_signals) != 1:
            raise PlantError(f"plant {self.name!r} has {len(self.mv_signals)} MVs; its steady curve needs exactly one")
        curve = self._steady.curve()
        if not curve[0].size:
            raise PlantError(f"plant {self.name!r} has no steady state in its set-point range")
        return curve

    def steady_state_at(self, cv: float) -> tuple[Array, Array]:
        """(x (n_x,), mv (1,)) of the steady state whose controlled variable is ``cv``.

        Raises PlantError where there is none.
        """
        cvs, xs, mvs = self.steady_curve
        i = int(np.argmin(np.abs(cvs - cv)))
        solved = self._steady.at(cv, (xs[i], float(mvs[i])))
        if solved is None:
            sp = self.sp_signals[0]
            raise PlantError(
                f"plant {self.name!r} has no steady state at {sp.name} = {cv} {sp.unit}; "
                f"it has some from {cvs[0]:.4g} to {cvs[-1]:.4g}"
            )
        return solved[0], np.array([solved[1]])

    def steady_states(self, mv: float) -> list[Array]:
        """All steady states at one MV, the smallest controlled variable first."""
        from scipy import optimize  # a quarter of a second to load, for whoever needs a plant's signals alone

        cvs, _, mvs = self.steady_curve
        found = []
        for i in np.nonzero(np.diff(np.sign(mvs - mv)))[0]:
            cv = optimize.brentq(lambda c: float(self.steady_state_at(c)[1][0]) - mv, cvs[i], cvs[i + 1], xtol=1e-13)
            found.append(self.steady_state_at(float(cv))[0])
        return found

    def turning_points(self) -> list[tuple[Array, float]]:
        """(x, mv) where two steady states meet: extrema of the steady MV over the CV, smallest CV first."""
        from scipy import optimize

        cvs, _, mvs = self.steady_curve

        def singular(cv: float) -> float:
            # Where the steady MV has an extremum over the CV, dx/dt has a direction without slope.
            return float(np.linalg.det(self.linearize(*self.steady_state_at(cv)).a))

        found = []
        for i in np.nonzero(np.diff(np.sign(np.diff(mvs))))[0]:
            x, mv = self.steady_state_at(float(optimize.brentq(singular, cvs[i], cvs[i + 2], xtol=1e-13)))
            found.append((x, float(mv[0])))
        return found

    @cached_property
    def regions(self) -> dict[str, tuple[float, float]]:
        """Operating regions by name: the range [low, high) of the CV in each, smallest CV first.

        The turning points bound them: within one region every steady state is of one branch.
        """
        bounds = [float(self.measure(x)[0]) for x, _ in self.turning_points()]
        edges = [-np.inf, *bounds, np.inf]
        numbered = tuple(f"region {i}" for i in range(1, len(edges)))
        names = {1: ("all",), 2: ("low", "high"), 3: ("low", "middle", "high")}.get(len(numbered), numbered)
        return dict(zip(names, pairwise(edges), strict=True))

    def linearize(self, x: Array, mv: Array) -> Linearization:
        """Linearization at a steady state (x, mv), per second."""
        x, mv = np.asarray(x, dtype=np.float64), np.asarray(mv, dtype=np.float64)
        a, b, c = (np.array(o) for o in self._jacobians(x, mv, self.dv_nominal, self.parameters()))
        return Linearization(x, mv, a / self.time_unit_s, b / self.time_unit_s, c)

    @cached_property
    def _jacobians(self) -> ca.Function:
        x, mv, dv, p, dx = self._symbols
        outputs = [ca.jacobian(dx, x), ca.jacobian(dx, mv), ca.jacobian(ca.vertcat(self.output(x)), x)]
        return ca.Function("jacobians", [x, mv, dv, p], [ca.densify(o) for o in outputs])

    def __getstate__(self) -> dict[str, Any]:
        # The cached CasADi functions are rebuilt in the process that unpickles the plant.
        return {f.name: getattr(self, f.name) for f in fields(self)}


def rk4_step(rate: Callable[[Any], Any], x: Any, h: float) -> Any:
    """The state a time h after x by the classic Runge-Kutta method of order four; ``rate(x)`` is dx/dt."""
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def equations(plant: Simulator | None, why: str) -> EquationPlant:
    """``plant``, where it is one in equations; PlantError says ``why`` it must be, and what to do, where it is not."""
    if isinstance(plant, EquationPlant):
        return plant
    what = "there is no plant" if plant is None else f"plant {plant.name!r} has none"
    raise PlantError(
        f"{why} needs a plant's equations, and {what}: write it as an EquationPlant with its `derivative`, "
        "or choose what needs none"
    )
