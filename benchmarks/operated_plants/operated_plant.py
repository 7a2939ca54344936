"""What a plant of this benchmark is: equations, what wanders in it, what operators want of it, and its day."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import root

from loopwright.pipeline.plants.simulator import Array, Signals
from loopwright.serving.manifest import Signal

PERIOD_S = 180.0  # 480 samples a day
DAY = 480
SUBSTEPS = 3  # of RK4 a sample

Rhs = Callable[[Any, Any, Any, Any], list[Any]]


@dataclass(frozen=True, slots=True)
class Wandering:
    """An unmeasured quantity w(k+1) = mean + a (w(k) - mean) + e, a = exp(-1/samples), of standard deviation ``sd``."""

    mean: float
    sd: float
    samples: float

    @property
    def kept(self) -> float:
        """Share a of a deviation that is left after a sample."""
        return float(np.exp(-1 / self.samples))

    @property
    def push(self) -> float:
        """Standard deviation of e."""
        return self.sd * float(np.sqrt(1 - self.kept**2))

    def course(self, n: int, rng: np.random.Generator) -> Array:
        """Values (n,), from a random one on."""
        found, draws = np.empty(n), rng.standard_normal(n)
        found[0] = self.mean + self.sd * draws[0]
        for k in range(1, n):
            found[k] = self.mean + self.kept * (found[k - 1] - self.mean) + self.push * draws[k]
        return found


@dataclass(frozen=True, slots=True)
class Steps:
    """A course of steps between ``low`` and ``high``, each held for a random number of samples."""

    low: float
    high: float
    shortest: int
    longest: int

    def course(self, n: int, rng: np.random.Generator) -> Array:
        """Values (n,)."""
        found: list[float] = []
        while len(found) < n:
            found += [rng.uniform(self.low, self.high)] * int(rng.integers(self.shortest, self.longest + 1))
        return np.array(found[:n])


@dataclass(frozen=True, slots=True)
class Held:
    """In the record an operator holds a level: at each look, MV = where it balances + gain (PV - a random wish).

    It balances at ``mv0``, ``of_dv`` times what the first measured disturbance is off its middle, and ``of_mv`` times
    what other MVs are off theirs. The operator looks every ``look`` samples.
    """

    mv: int
    pv: int
    gain: float
    low: float
    high: float
    of_dv: float = 0.0
    of_mv: tuple[tuple[int, float], ...] = ()
    look: tuple[int, int] = (5, 20)


class Called:
    """A CasADi function of dense columns, from arrays to arrays, without CasADi's own conversions."""

    def __init__(self, function: Any) -> None:
        self.buffer, self.run = function.buffer()
        self.given = [np.zeros(max(function.size1_in(i), 1)) for i in range(function.n_in())]
        self.sizes = [function.size1_in(i) for i in range(function.n_in())]
        self.found = [np.zeros(function.size_out(i), order="F") for i in range(function.n_out())]
        for i, values in enumerate(self.given):
            self.buffer.set_arg(i, memoryview(values))
        for i, values in enumerate(self.found):
            self.buffer.set_res(i, memoryview(values.reshape(-1, order="A")))

    def __call__(self, *given: Array) -> list[Array]:
        """Columns (n,) and matrices (n, m)."""
        for own, size, values in zip(self.given, self.sizes, given, strict=True):
            own[:size] = values
        self.run()
        return [v[:, 0].copy() if v.shape[1] == 1 else v.copy() for v in self.found]


@dataclass(frozen=True)
class Day:
    """Courses of a day, the same for all controllers; everything is drawn by ``seed``."""

    sp: Array  # (n, n_sp)
    dv: Array  # (n, n_dv)
    w: Array  # (n, n_w)
    noise: Array  # (n, n_pv)
    fresh: Array  # (n, n_pv) 0 or 1


@dataclass(frozen=True)
class OperatedPlant:
    """A plant whose derivatives are a sample's; the first PVs are those with set points.

    ``rhs(x, mv, dv, w)`` -> dx/dt [1/sample], ``output(x)`` -> the PVs. ``late`` and ``every``: PV -> samples by which
    an analyser is late, and between its readings; ``missing``: PV -> share of these that it does not give. ``operate``:
    what operators have set. ``moves``: spans of the MVs in the record. Set points and measured disturbances go by
    ``sp_steps`` and ``dv_steps``.
    """

    name: str
    title: str
    pv: tuple[Signal, ...]
    sp: tuple[Signal, ...]
    mv: tuple[Signal, ...]
    noise: tuple[float, ...]
    rhs: Rhs
    output: Callable[[Any], list[Any]]
    x0: tuple[float, ...]
    mv0: tuple[float, ...]
    operate: Mapping[str, float]
    moves: tuple[tuple[float, float], ...]
    sp_steps: tuple[Steps, ...]
    scheme: Callable[[OperatedPlant, Array], Any]  # PIDs, from their numbers
    settings: Mapping[str, float]  # of the PIDs, where their tuning begins
    dv: tuple[Signal, ...] = ()
    dv_steps: tuple[Steps, ...] = ()
    wanders: tuple[Wandering, ...] = ()
    held: tuple[Held, ...] = ()
    hold: tuple[int, int] = (6, 40)  # samples of a move in the record
    late: Mapping[int, int] = field(default_factory=dict)
    every: Mapping[int, int] = field(default_factory=dict)
    missing: Mapping[int, float] = field(default_factory=dict)

    @property
    def signals(self) -> Signals:
        """Of a controller for it."""
        return Signals(PERIOD_S, self.sp, self.pv, self.dv, self.mv)

    @property
    def dv0(self) -> Array:
        """The middle of each measured disturbance's course."""
        return np.array([0.5 * (s.low + s.high) for s in self.dv_steps])

    @property
    def w0(self) -> Array:
        """The mean of what wanders."""
        return np.array([w.mean for w in self.wanders])

    @property
    def sp0(self) -> Array:
        """The middle of each set point's course."""
        return np.array([0.5 * (s.low + s.high) for s in self.sp_steps])

    @property
    def n_c(self) -> int:
        """Number of states without those of delays."""
        return len(self.x0)

    @cached_property
    def step_symbols(self) -> tuple[Any, Any, Any, Any, Any]:
        """(x, mv, dv, w, x one sample later), all SX columns; behind the states stand the readings on their way."""
        tail = sum(self.late.values())
        x, u, d, w = (
            ca.SX.sym(n, k)
            for n, k in (("x", self.n_c + tail), ("u", len(self.mv)), ("d", len(self.dv)), ("w", len(self.wanders)))
        )

        def rate(z: Any) -> Any:
            return ca.vertcat(*self.rhs(z, u, d, w))

        z, h = x[: self.n_c], 1.0 / SUBSTEPS
        for _ in range(SUBSTEPS):
            k1 = rate(z)
            k2 = rate(z + h / 2 * k1)
            k3 = rate(z + h / 2 * k2)
            k4 = rate(z + h * k3)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        pieces, at, now = [z], self.n_c, self.output(x[: self.n_c])
        for pv, samples in self.late.items():
            pieces += [now[pv], x[at : at + samples - 1]]
            at += samples
        return x, u, d, w, ca.vertcat(*pieces)

    @cached_property
    def advance(self) -> Called:
        """x(k+1) of x, mv, dv, w."""
        *given, after = self.step_symbols
        return Called(ca.Function("advance", given, [ca.densify(after)]))

    @cached_property
    def outputs(self) -> Called:
        """The true PVs now, and the PVs as measured, of x."""
        x = self.step_symbols[0]
        true = ca.vertcat(*self.output(x[: self.n_c]))
        return Called(ca.Function("outputs", [x], [ca.densify(y) for y in (true, self.measured_of(x))]))

    def measured_of(self, x: Any) -> Any:
        """The PVs as an instrument shows them: those of an analyser late."""
        shown, at = list(self.output(x[: self.n_c])), self.n_c
        for pv, samples in self.late.items():
            at += samples
            shown[pv] = x[at - 1]
        return ca.vertcat(*shown)

    def step(self, x: Array, mv: Array, dv: Array, w: Array) -> Array:
        """X (n_x,) a sample later."""
        return self.advance(x, mv, dv, w)[0]

    def look(self, x: Array) -> tuple[Array, Array]:
        """(true PVs, PVs as measured), without noise."""
        true, shown = self.outputs(x)
        return true, shown

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """(x, mv) at rest at ``mv0``, nothing deviating; integrators where ``x0`` has them."""
        mv, x = np.array(self.mv0), np.array(self.x0)
        kept = [h.pv for h in self.held]
        free = [h.mv for h in self.held]
        rate = ca.Function("rate", [*self.step_symbols[:4]], [ca.vertcat(*self.rhs(*self.step_symbols[:4]))])
        y0 = np.array(ca.DM(self.output(x)))[:, 0] if kept else np.zeros(0)

        def miss(z: Array) -> Array:
            u = mv.copy()
            u[free] = z[self.n_c :]
            full = np.concatenate([z[: self.n_c], np.zeros(sum(self.late.values()))])
            y = np.array(ca.DM(self.output(z[: self.n_c])))[:, 0]
            return np.concatenate([np.array(rate(full, u, self.dv0, self.w0))[:, 0], y[kept] - y0[kept]])

        found = root(miss, np.concatenate([x, mv[free]]))
        if not found.success:
            raise RuntimeError(f"{self.name}: no rest near x0 and mv0: {found.message}")
        mv[free] = found.x[self.n_c :]
        x = found.x[: self.n_c]
        y = np.array(ca.DM(self.output(x)))[:, 0]
        return np.concatenate([x, *[np.full(n, y[pv]) for pv, n in self.late.items()]]), mv

    def day(self, seed: int, samples: int = DAY) -> Day:
        """The day of a seed."""
        rng = np.random.default_rng(seed)
        sp, dv, w = (
            np.column_stack([np.empty((samples, 0)), *(s.course(samples, rng) for s in of)])
            for of in (self.sp_steps, self.dv_steps, self.wanders)
        )
        noise = np.array(self.noise) * rng.standard_normal((samples, len(self.pv)))
        return Day(sp, dv, w, noise, self.fresh(samples, rng))

    def fresh(self, samples: int, rng: np.random.Generator) -> Array:
        """Whether each PV has a new reading, (samples, n_pv): 1 or 0; the first sample has all."""
        fresh = np.ones((samples, len(self.pv)))
        for pv, every in self.every.items():
            fresh[:, pv] = np.arange(samples) % every == 0
            if self.missing.get(pv):
                fresh[1:, pv] *= rng.random(samples - 1) >= self.missing[pv]
        return fresh

    def range_of(self, pv: int) -> tuple[float, float]:
        """The range in which operators want a PV."""
        s = self.pv[pv]
        return self.operate.get(f"{s.name}.low", s.low), self.operate.get(f"{s.name}.high", s.high)

    def tracked(self, pv: int) -> bool:
        """Whether a PV has a set point that counts."""
        return pv < len(self.sp) and bool(self.operate.get(f"{self.pv[pv].name}.track", 1.0))

    def mv_ends(self) -> tuple[Array, Array]:
        """Operators' limits (n_mv,) and (n_mv,) of the MVs."""
        low, high = (
            np.array([self.operate.get(f"{s.name}.{end}", getattr(s, end)) for s in self.mv]) for end in ("low", "high")
        )
        return low, high

    @property
    def costs(self) -> tuple[Array, Array]:
        """Costs per unit and sample of the PVs (n_pv,) and of the MVs (n_mv,)."""
        pv, mv = (np.array([self.operate.get(f"{s.name}.cost", 0.0) for s in of]) for of in (self.pv, self.mv))
        return pv, mv
