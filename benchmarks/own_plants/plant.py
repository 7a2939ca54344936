"""What a plant of the benchmark is: equations, unmeasured loads at its MVs, and how its record and tests are made."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from scipy.optimize import root

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.manifest import Signal

SETTLE = 3_000  # samples to come to rest


@dataclass(frozen=True)
class OwnPlant(EquationPlant):
    """Outputs that are not its states, MVs in %, and a load on each MV [%]; ``noise`` [unit of the output]."""

    load: float = field(default=0.0, metadata={"unit": "%"})
    noise: ClassVar[tuple[float, ...]]
    hold: ClassVar[int]  # samples of a set point
    moves: ClassVar[tuple[int, int]]  # fewest and most samples of a step in the record
    span: ClassVar[tuple[float, float]] = (10.0, 90.0)  # of the MVs in the record
    reached: ClassVar[tuple[float, float] | None] = None  # range of MVs at rest whose outputs are set points; None: all
    hand: ClassVar[str] = "steps"  # how the record comes about: steps, operator, closed loop
    bounded: ClassVar[bool] = True  # the NMPC's solver comes to an end
    period_s: ClassVar[float] = 10.0
    substeps: ClassVar[int] = 4

    def output(self, x: Any) -> Any:
        """The first state."""
        return x[0]

    @property
    def noise_std(self) -> Array:
        """Standard deviation of the measurement noise, shape (n_pv,)."""
        return np.array(self.noise)

    def loaded(self, mv: Any) -> list[Any]:
        """The MVs with their loads [%]."""
        return [mv[i] + getattr(self, name) for i, name in enumerate(self.load_names())]

    @classmethod
    def load_names(cls) -> list[str]:
        """Names of the parameters that are loads, one a MV."""
        return [f.name for f in fields(cls) if f.name.startswith("load")]

    def drift(self, n: int, rng: np.random.Generator) -> dict[str, Array]:
        """Parameters (n,) that change by themselves, in the record and in use."""
        return {}

    def known(self, scenario: Scenario) -> Array:
        """What a controller is given of the measured disturbances of a test (n, n_dv): there are none."""
        return np.zeros((scenario.samples, 0))

    @property
    def start(self) -> tuple[Array, Array]:
        """The rest at the middle of the set points."""
        return self.rest(np.array([s.middle for s in self.sp_signals]))

    def rest(self, sp: Array) -> tuple[Array, Array]:
        """(x (n_x,), mv (n_mv,)) at rest with outputs ``sp`` (n_cv,); PlantError where there is none."""
        return _rest(self, tuple(float(v) for v in sp))

    def at_rest_under(self, mv: Array) -> Array:
        """The state (n_x,) after a long time under constant MVs."""
        step, x, p = self.stepper(), self.start[0], self.parameters()
        for _ in range(SETTLE):
            x = step(x, mv, self.dv_nominal, p)
        return x

    def set_points(self, rng: np.random.Generator, count: int, inner: float = 0.0) -> Array:
        """Random set points (count, n_cv) that the plant reaches, this share of their range off its ends."""
        low, high = (np.array([getattr(s, end) for s in self.sp_signals]) for end in ("low", "high"))
        if self.reached is None:
            return rng.uniform(low + inner * (high - low), high - inner * (high - low), (count, len(low)))
        ends = np.array(self.reached)
        ends = ends + inner * np.array([1, -1]) * np.diff(ends)
        mvs = rng.uniform(ends[0], ends[1], (count, len(self.mv_signals)))
        return np.clip(self.measured(np.array([self.at_rest_under(mv) for mv in mvs])), low, high)


@cache
def _rest(plant: OwnPlant, sp: tuple[float, ...]) -> tuple[Array, Array]:
    n_x, n_mv = len(plant.state_signals), len(plant.mv_signals)
    p, dv = plant.parameters(), plant.dv_nominal
    low, high = (np.array([getattr(s, end) for s in plant.mv_signals]) for end in ("low", "high"))

    def miss(z: Array) -> Array:
        rate = np.array(plant.rate(z[:n_x], z[n_x:], dv, p))[:, 0] * plant.period_s
        return np.concatenate([rate, plant.measure(z[:n_x]) - np.array(sp)])

    rng = np.random.default_rng(0)
    for attempt in range(60):
        mv = low + (high - low) * (0.5 if not attempt else rng.uniform(0.05, 0.95, n_mv))
        x, step = np.full(n_x, np.mean(sp)), plant.stepper()
        for _ in range(300):
            x = step(x, mv * np.ones(n_mv), dv, p)
        found = root(miss, np.concatenate([x, mv * np.ones(n_mv)]))
        at = found.x[n_x:]
        if (
            found.success
            and np.abs(miss(found.x)).max() < 1e-6
            and (at >= low - 1e-6).all()
            and (at <= high + 1e-6).all()
        ):
            return found.x[:n_x], at
    raise PlantError(f"plant {plant.name!r} has no rest at {sp} within its MVs' ranges")


def lags(x: Any, u: Any, tau: Any) -> list[Any]:
    """Rates of a chain of equal lags ``tau`` [s], the last state first behind the input ``u``."""
    n = x.shape[0]
    return [((x[i + 1] if i + 1 < n else u) - x[i]) / tau for i in range(n)]


def states(n: int, unit: str = "-") -> tuple[Signal, ...]:
    """Signals of n states."""
    return tuple(Signal(f"x{i}", unit, -1e3, 1e3) for i in range(n))


def valves(n: int = 1) -> tuple[Signal, ...]:
    """Signals of n MVs."""
    return (Signal("u", "%", 0.0, 100.0),) if n == 1 else tuple(Signal(f"u{i + 1}", "%", 0.0, 100.0) for i in range(n))


def signal(unit: str, low: float, high: float, name: str = "y") -> Signal:
    """A signal of an output or of its set point."""
    return Signal(name, unit, low, high)


column = ca.vertcat
