"""The plants in sight of which the method was chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from plant import OwnPlant, column, lags, signal, states, valves

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class Exchanger(OwnPlant):
    """A heat exchanger behind a pipe: a gain that falls with the flow, and a transport of six lags."""

    name: ClassVar[str] = "exchanger"
    title: ClassVar[str] = "Heat exchanger"
    noise: ClassVar[tuple[float, ...]] = (0.15,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (5, 60)
    state_signals: ClassVar[tuple[Signal, ...]] = states(8)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 40.0, 65.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = self.loaded(mv)[0] / 100
        steady = 20 + 60 * u / (0.25 + u)
        return column((x[1] - x[0]) / 60, *lags(x[1:], steady, 8.0))


@dataclass(frozen=True)
class Inverse(OwnPlant):
    """Two lags against each other: the answer starts the wrong way."""

    name: ClassVar[str] = "inverse"
    title: ClassVar[str] = "Inverse response"
    noise: ClassVar[tuple[float, ...]] = (0.2,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 50)
    state_signals: ClassVar[tuple[Signal, ...]] = states(3)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 20.0, 75.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = self.loaded(mv)[0]
        slow, fast = (1.4 * u + 0.003 * u * u - x[1]) / 80, (0.6 * u - x[2]) / 25
        return column((x[1] - x[2] - x[0]) / 5, slow, fast)


@dataclass(frozen=True)
class Noisy(OwnPlant):
    """Two lags behind a valve whose gain grows sixfold, with a noise of 10 % of the range."""

    name: ClassVar[str] = "noisy"
    title: ClassVar[str] = "Noisy valve"
    noise: ClassVar[tuple[float, ...]] = (5.0,)
    hold: ClassVar[int] = 80
    moves: ClassVar[tuple[int, int]] = (5, 80)
    state_signals: ClassVar[tuple[Signal, ...]] = states(2)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("m3/h", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("m3/h", 15.0, 65.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = self.loaded(mv)[0] / 100
        return column((x[1] - x[0]) / 40, (100 * (0.3 * u + 0.7 * u * u) - x[1]) / 60)


@dataclass(frozen=True)
class Coupled(OwnPlant):
    """A column: both flows move both purities, relative gain 3.2, and the purities saturate."""

    load2: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "coupled"
    title: ClassVar[str] = "2x2, strongly coupled"
    noise: ClassVar[tuple[float, ...]] = (0.15, 0.15)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 50)
    reached: ClassVar[tuple[float, float] | None] = (25.0, 75.0)
    state_signals: ClassVar[tuple[Signal, ...]] = states(4)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves(2)
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0, 100, "top"), signal("%", 0, 100, "bottom"))
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 25, 75, "top"), signal("%", 25, 75, "bottom"))

    def output(self, x: Any) -> Any:
        """Purities, which bend towards both ends."""
        return column(*(50 + 45 * ca.tanh(x[i] / 45) for i in range(2)))

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u1, u2 = (u - 50 for u in self.loaded(mv))
        top = (0.9 * x[2] - 0.7 * x[3] - x[0]) / 80
        bottom = (0.8 * x[2] - 0.9 * x[3] - x[1]) / 60
        return column(top, bottom, (u1 - x[2]) / 12, (u2 - x[3]) / 18)


@dataclass(frozen=True)
class Level(OwnPlant):
    """The level of a lying drum, fed through a long pipe: an integrator with dead time, in an operator's hand."""

    name: ClassVar[str] = "level"
    title: ClassVar[str] = "Level of a drum"
    noise: ClassVar[tuple[float, ...]] = (0.3,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 25)
    hand: ClassVar[str] = "operator"
    state_signals: ClassVar[tuple[Signal, ...]] = states(5)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 30.0, 70.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]; the drum is widest in its middle."""
        width = 0.6 + 0.4 * ca.sqrt(ca.fmax(0.04, 1 - ((x[0] - 50) / 55) ** 2))
        return column(0.012 * (x[1] - 45) / width, *lags(x[1:], self.loaded(mv)[0], 8.0))


@dataclass(frozen=True)
class Drifting(OwnPlant):
    """A heater that fouls and is cleaned: its gain moves by a factor of 1.7 while the record is taken, and in use."""

    fouling: float = field(default=0.3, metadata={"unit": "-"})
    name: ClassVar[str] = "drifting"
    title: ClassVar[str] = "Gain that drifts"
    noise: ClassVar[tuple[float, ...]] = (0.2,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (5, 50)
    state_signals: ClassVar[tuple[Signal, ...]] = states(3)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 0.0, 120.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 35.0, 60.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [degC/s]."""
        heat = (self.loaded(mv)[0] * (1 - 0.5 * self.fouling)) * 0.8
        return column((x[1] - x[0]) / 15, (20 + x[2] - x[1]) / 60, (heat - x[2]) / 20)

    def drift(self, n: int, rng: np.random.Generator) -> dict[str, Array]:
        """Fouling within 0 and .8, up and down every 1,200 samples or so."""
        at, phase = np.arange(n), rng.uniform(0, 2 * np.pi)
        return {"fouling": 0.4 + 0.4 * np.sin(2 * np.pi * at / 1_200 + phase)}


@dataclass(frozen=True)
class Fading(OwnPlant):
    """A reactor whose catalyst fades by a third and is renewed, with a gain that falls with the feed."""

    activity: float = field(default=0.85, metadata={"unit": "-"})
    name: ClassVar[str] = "fading"
    title: ClassVar[str] = "Catalyst that fades"
    noise: ClassVar[tuple[float, ...]] = (0.2,)
    hold: ClassVar[int] = 70
    moves: ClassVar[tuple[int, int]] = (5, 60)
    state_signals: ClassVar[tuple[Signal, ...]] = states(5)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 0.0, 120.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 44.0, 58.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [degC/s]: the reactor behind a feed line of three lags, and its sensor."""
        feed = ca.fmax(0.0, x[2]) / 100
        heat = 25 + 70 * self.activity * feed / (0.3 + feed)
        return column((x[1] - x[0]) / 12, (heat - x[1]) / 70, *lags(x[2:], self.loaded(mv)[0], 6.0))

    def drift(self, n: int, rng: np.random.Generator) -> dict[str, Array]:
        """Down from 1 to .65 within 700 to 1,500 samples, and up again within 30."""
        course: list[float] = []
        while len(course) < 2 * n + 1_500:
            course += [*np.linspace(1.0, 0.65, int(rng.integers(700, 1_500))), *np.linspace(0.65, 1.0, 30)]
        start = int(rng.integers(0, 1_500))
        return {"activity": np.array(course[start : start + n])}


DEVELOPMENT: tuple[type[OwnPlant], ...] = (Exchanger, Inverse, Coupled, Level, Noisy, Drifting, Fading)
