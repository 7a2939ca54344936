"""What every plant is: named parameters, signals, and one text of its derivative."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from pipeline.errors import PlantError
from serving.manifest import Signal

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Linearization:
    """dx' = A dx + B dmv, dpv = C dx around a steady state (x, mv); per unit of the plant's time."""

    x: Array  # shape: (n_x,)
    mv: Array  # shape: (n_mv,)
    a: Array  # shape: (n_x, n_x)
    b: Array  # shape: (n_x, n_mv)
    c: Array  # shape: (n_pv, n_x)

    @property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of A, largest real part first."""
        values = np.linalg.eigvals(self.a).astype(np.complex128)
        order = np.lexsort((values.imag, -values.real))
        return np.asarray(values[order])

    def sampled(self, period_s: float) -> tuple[Array, Array]:
        """Zero-order-hold discretization (Phi, Gamma): x(k+1) = Phi x(k) + Gamma mv(k)."""
        n, m = self.b.shape
        block = np.zeros((n + m, n + m))
        block[:n, :n], block[:n, n:] = self.a, self.b
        power = linalg.expm(block * period_s)
        return power[:n, :n], power[:n, n:]

    def sampled_zeros(self, period_s: float, pv: int = 0, mv: int = 0) -> NDArray[np.complex128]:
        """Zeros of the sampled transfer function from one MV to one PV.

        The exact one-step inverse puts a closed-loop eigenvalue on each of them.
        """
        phi, gamma = self.sampled(period_s)
        n = phi.shape[0]
        pencil = np.zeros((n + 1, n + 1))
        pencil[:n, :n], pencil[:n, n], pencil[n, :n] = phi, gamma[:, mv], self.c[pv]
        mass = np.zeros_like(pencil)
        mass[:n, :n] = np.eye(n)
        zeros = linalg.eigvals(pencil, mass)
        # The pencil has infinite eigenvalues beside the zeros: a relative degree's worth.
        return np.asarray(zeros[np.abs(zeros) < 1e8], dtype=np.complex128)


@dataclass(frozen=True)
class Plant(ABC):
    """A continuous-time plant in CasADi, sampled with its MV held over each period.

    A subclass is a frozen dataclass whose fields are its parameters (each with
    ``metadata={"unit": ...}``), states its signals, and writes ``derivative`` once. From that one
    text come the integrators, the steady states, the linearization and the perfect-model NMPC.
    Any parameter may be changed during a simulation by its name: that is a disturbance which the
    controller does not measure. Measured disturbances are ``dv``.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    state_signals: ClassVar[tuple[Signal, ...]]
    pv_signals: ClassVar[tuple[Signal, ...]]  # controlled variables first
    sp_signals: ClassVar[tuple[Signal, ...]]
    mv_signals: ClassVar[tuple[Signal, ...]]
    dv_signals: ClassVar[tuple[Signal, ...]] = ()
    period_s: ClassVar[float]
    substeps: ClassVar[int]  # of RK4 a period
    time_unit_s: ClassVar[float] = 1.0  # the unit of time in which ``derivative`` is written

    @abstractmethod
    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt, shape (n_x,), from CasADi columns x (n_x,), mv (n_mv,), dv (n_dv,)."""

    def output(self, x: Any) -> Any:
        """The process variables of a state; the state itself unless overridden."""
        return x

    @property
    def dv_nominal(self) -> Array:
        """Nominal measured disturbances, shape (n_dv,)."""
        return np.zeros(len(self.dv_signals))

    # ------------------------------------------------------------------ parameters
    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        """Names of the plant's parameters, in the order of the parameter vector."""
        return tuple(f.name for f in fields(cls))

    @classmethod
    def parameter_units(cls) -> dict[str, str]:
        """Unit of each parameter."""
        return {f.name: str(f.metadata.get("unit", "")) for f in fields(cls)}

    def parameters(self, changed: Mapping[str, float] | None = None) -> Array:
        """The parameter vector, shape (n_p,), with some of them changed by name.

        Raises PlantError for a name that the plant does not have.
        """
        names = self.parameter_names()
        values = {n: float(getattr(self, n)) for n in names}
        for key, value in (changed or {}).items():
            if key not in values:
                raise PlantError(f"plant {self.name!r} has no parameter {key!r}; it has {', '.join(names)}")
            values[key] = float(value)
        return np.array([values[n] for n in names])

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
    def measure(self) -> ca.Function:
        """CasADi function x -> pv."""
        x = self._symbols[0]
        return ca.Function("measure", [x], [ca.densify(ca.vertcat(self.output(x)))])

    @cached_property
    def transition(self) -> ca.Function:
        """CasADi function (x, mv, dv, p) -> x one period later; fixed-step RK4, ``substeps`` a period."""
        return self.rk4(self.substeps)

    def rk4(self, substeps: int) -> ca.Function:
        """The transition over one period with another number of RK4 substeps."""
        x, mv, dv, p, _ = self._symbols
        h = self.period_s / self.time_unit_s / substeps
        state = x
        for _ in range(substeps):
            k1 = self.rate(state, mv, dv, p)
            k2 = self.rate(state + h / 2 * k1, mv, dv, p)
            k3 = self.rate(state + h / 2 * k2, mv, dv, p)
            k4 = self.rate(state + h * k3, mv, dv, p)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return ca.Function("transition", [x, mv, dv, p], [ca.densify(state)])

    @cached_property
    def exact_transition(self) -> ca.Function:
        """The same map by CVODES at tight tolerances: the reference for ``transition``."""
        x, mv, dv, p, dx = self._symbols
        dae = {"x": x, "p": ca.vertcat(mv, dv, p), "ode": dx}
        options = {"abstol": 1e-12, "reltol": 1e-10, "max_num_steps": 100_000}
        span = self.period_s / self.time_unit_s
        solver = ca.integrator("exact", "cvodes", dae, 0.0, span, options)
        x0, m0, d0, p0 = (ca.MX.sym(n, s.numel()) for n, s in zip("xmdp", (x, mv, dv, p), strict=True))
        return ca.Function(
            "exact_transition", [x0, m0, d0, p0], [solver(x0=x0, p=ca.vertcat(m0, d0, p0))["xf"]]
        )

    def stepper(self) -> Callable[[Array, Array, Array, Array], Array]:
        """``step(x, mv, dv, p) -> x`` through CasADi's buffers, which skip its argument conversion."""
        buffer, evaluate = self.transition.buffer()
        args = [np.zeros(n) for n in (self.transition.numel_in(i) for i in range(4))]
        result = np.zeros(len(self.state_signals))
        for i, arg in enumerate(args):
            if arg.size:
                buffer.set_arg(i, memoryview(arg))
        buffer.set_res(0, memoryview(result))

        def step(x: Array, mv: Array, dv: Array, p: Array) -> Array:
            for arg, value in zip(args, (x, mv, dv, p), strict=True):
                arg[:] = value
            evaluate()
            return result.copy()

        step.buffer = buffer  # type: ignore[attr-defined]  # evaluate() only borrows it
        return step

    # ------------------------------------------------------------------ steady states
    @cached_property
    def _jacobians(self) -> ca.Function:
        x, mv, dv, p, dx = self._symbols
        return ca.Function(
            "jacobians",
            [x, mv, dv, p],
            [dx, ca.jacobian(dx, x), ca.jacobian(dx, mv), ca.jacobian(ca.vertcat(self.output(x)), x)],
        )

    def _balance(self, x: Array, mv: Array) -> tuple[Array, Array, Array, Array]:
        out = self._jacobians(x, mv, self.dv_nominal, self.parameters())
        f, fx, fu, c = (np.array(o) for o in out)
        return f[:, 0], fx, fu, c

    @cached_property
    def steady_curve(self) -> tuple[Array, Array, Array]:
        """Steady states along the controlled variable: (cv (n,), x (n, n_x), mv (n,)).

        For a plant with one MV and one CV whose steady MV is a function of the CV (the converse
        need not hold: that is what multiplicity means). Each point starts from the one before.
        """
        sp = self.sp_signals[0]
        grid = np.linspace(sp.low, sp.high, 802)[1:-1]
        rows: list[tuple[float, Array, float]] = []
        guess = None
        for cv in grid[::-1]:
            solved = self._solve_steady(float(cv), guess)
            if solved is not None:
                guess = solved
                rows.append((float(cv), *solved))
        if not rows:
            raise PlantError(f"plant {self.name!r} has no steady state in its set-point range")
        rows.reverse()
        cvs, xs, mvs = zip(*rows, strict=True)
        return np.array(cvs), np.array(xs), np.array(mvs)

    def _solve_steady(self, cv: float, guess: tuple[Array, float] | None) -> tuple[Array, float] | None:
        """Root of [derivative; pv[0] - cv] in (x, mv), scaled by the signals' ranges."""
        signals = (*self.state_signals, *self.mv_signals)
        low = np.array([s.low for s in signals])
        span = np.array([s.high - s.low for s in signals])

        def residual(z: Array) -> Array:
            v = low + span * z
            f, _, _, _ = self._balance(v[:-1], v[-1:])
            return np.append(f * self.time_unit_s / span[:-1], (float(self.measure(v[:-1])[0]) - cv) / span[0])

        def jacobian(z: Array) -> Array:
            v = low + span * z
            _, fx, fu, c = self._balance(v[:-1], v[-1:])
            top = np.hstack([fx, fu]) * self.time_unit_s * span / span[:-1, None]
            return np.vstack([top, np.append(c[0], 0.0) * span / span[0]])

        if guess is not None:
            starts = [(np.append(*guess) - low) / span]
        else:
            n = len(signals)
            starts = list(np.random.default_rng(0).uniform(0.02, 0.98, (60, n)))
        for start in starts:
            with np.errstate(all="ignore"):
                found = optimize.root(residual, start, jac=jacobian, method="hybr", tol=1e-13)
            if np.all(np.isfinite(found.x)) and np.max(np.abs(residual(found.x))) < 1e-9:
                v = low + span * found.x
                return v[:-1], float(v[-1])
        return None

    def steady_state_at(self, cv: float) -> tuple[Array, Array]:
        """(x, mv) of the steady state whose controlled variable is ``cv``.

        Raises PlantError where there is none.
        """
        cvs, xs, mvs = self.steady_curve
        i = int(np.argmin(np.abs(cvs - cv)))
        solved = self._solve_steady(cv, (xs[i], float(mvs[i])))
        if solved is None:
            sp = self.sp_signals[0]
            raise PlantError(
                f"plant {self.name!r} has no steady state at {sp.name} = {cv} {sp.unit}; "
                f"it has some from {cvs[0]:.4g} to {cvs[-1]:.4g}"
            )
        return solved[0], np.array([solved[1]])

    def steady_states(self, mv: float) -> list[Array]:
        """All steady states at one MV, the smallest controlled variable first."""
        cvs, _, mvs = self.steady_curve
        found = []
        for i in np.nonzero(np.diff(np.sign(mvs - mv)))[0]:
            cv = optimize.brentq(lambda c: float(self.steady_state_at(c)[1][0]) - mv, cvs[i], cvs[i + 1], xtol=1e-13)
            found.append(self.steady_state_at(float(cv))[0])
        return found

    def turning_points(self) -> list[tuple[Array, float]]:
        """(x, mv) where two steady states meet: extrema of the steady MV over the CV."""
        cvs, _, mvs = self.steady_curve
        slope = np.diff(mvs)
        found = []
        for i in np.nonzero(np.diff(np.sign(slope)))[0]:
            sign = float(np.sign(slope[i + 1]))
            best = optimize.minimize_scalar(
                lambda c, s=sign: s * float(self.steady_state_at(float(c))[1][0]),
                bounds=(cvs[i], cvs[i + 2]),
                method="bounded",
                options={"xatol": 1e-10},
            )
            x, mv = self.steady_state_at(float(best.x))
            found.append((x, float(mv[0])))
        return found

    def linearize(self, x: Array, mv: Array) -> Linearization:
        """Linearization per unit of ``time_unit_s`` at (x, mv)."""
        _, fx, fu, c = self._balance(np.asarray(x, float), np.asarray(mv, float))
        return Linearization(np.asarray(x, float), np.asarray(mv, float), fx, fu, c)
