"""The plants in closed-loop records that no choice is made on; their scores are reported as they come."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from closed_plant import ClosedPlant, Measured, OldLoop, Wander
from plant import column, lags, signal, states, valves

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class Boiler(ClosedPlant):
    """A boiler's drum: the level integrates, cold feed makes it shrink first, and the steam drawn is measured."""

    wander: float = field(default=0.0, metadata={"unit": "%"})
    steam: float = field(default=50.0, metadata={"unit": "t/h"})
    name: ClassVar[str] = "boiler"
    title: ClassVar[str] = "Integrator with inverse response"
    period_s: ClassVar[float] = 5.0
    noise: ClassVar[tuple[float, ...]] = (0.3,)
    hold: ClassVar[int] = 80
    every: ClassVar[float] = 240
    in_manual: ClassVar[tuple[int, int]] = (20, 50)
    state_signals: ClassVar[tuple[Signal, ...]] = states(4)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 38.0, 62.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("LIC-110", 0.7, 400.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 4.0, 220),)
    measured_disturbances: ClassVar[tuple[Measured, ...]] = (Measured("steam", "FI-111", "t/h", 30, 70, 160, 10, 0.2),)

    def output(self, x: Any) -> Any:
        """Water and bubbles."""
        return x[0] + x[1]

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: the water, the bubbles, and two lags of the feed valve."""
        feed, drawn = x[2] - 50, self.steam - 50
        water, bubbles = 0.006 * (feed + self.wander - 0.9 * drawn), 0.12 * drawn - 0.18 * feed
        return column(water, (bubbles - x[1]) / 20, *lags(x[2:], self.loaded(mv)[0], 6.0))


@dataclass(frozen=True)
class Blender(ClosedPlant):
    """Three streams and three qualities that all depend on them, each stream with another dead time."""

    load2: float = field(default=0.0, metadata={"unit": "%"})
    load3: float = field(default=0.0, metadata={"unit": "%"})
    wander: float = field(default=0.0, metadata={"unit": "%"})
    wander2: float = field(default=0.0, metadata={"unit": "%"})
    wander3: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "blender"
    title: ClassVar[str] = "3x3"
    noise: ClassVar[tuple[float, ...]] = (0.2, 0.2, 0.2)
    hold: ClassVar[int] = 60
    every: ClassVar[float] = 240
    reached: ClassVar[tuple[float, float] | None] = (32.0, 68.0)
    state_signals: ClassVar[tuple[Signal, ...]] = states(11)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves(3)
    pv_signals: ClassVar[tuple[Signal, ...]] = tuple(signal("%", 0.0, 100.0, f"y{i}") for i in (1, 2, 3))
    sp_signals: ClassVar[tuple[Signal, ...]] = tuple(signal("%", 32.0, 68.0, f"y{i}") for i in (1, 2, 3))
    loops: ClassVar[tuple[OldLoop, ...]] = (
        OldLoop("QIC-121", 0.55, 80.0), OldLoop("QIC-122", 0.38, 80.0), OldLoop("QIC-123", 0.25, 105.0),
    )  # fmt: skip
    wanders: ClassVar[tuple[Wander, ...]] = (
        Wander("wander", 7.0, 220), Wander("wander2", 7.0, 300), Wander("wander3", 6.0, 260),
    )  # fmt: skip

    def output(self, x: Any) -> Any:
        """The three qualities."""
        return x[:3]

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: each quality behind a lag, the streams behind one, three and four lags."""
        u = self.loaded(mv)
        late = (x[3] + self.wander, x[4] + self.wander2, x[7] + self.wander3)
        gains = ((1.1, 0.35, -0.25), (-0.3, 1.0, 0.35), (0.4, -0.3, 1.2))
        taus, rates = (80.0, 60.0, 100.0), []
        for i in range(3):
            push = sum(g * (v - 50) for g, v in zip(gains[i], late, strict=True))
            rates.append((50 + push - 0.003 * push * ca.fabs(push) - x[i]) / taus[i])
        return column(*rates, (u[0] - x[3]) / 8, *lags(x[4:7], u[1], 10.0), *lags(x[7:], u[2], 10.0))


@dataclass(frozen=True)
class Sluice(ClosedPlant):
    """A dose diluted by the water that carries it: more water gives less, and gives it sooner."""

    wander: float = field(default=0.0, metadata={"unit": "g/s"})
    name: ClassVar[str] = "sluice"
    title: ClassVar[str] = "Dead time that the flow changes"
    noise: ClassVar[tuple[float, ...]] = (0.2,)
    hold: ClassVar[int] = 80
    every: ClassVar[float] = 200
    state_signals: ClassVar[tuple[Signal, ...]] = states(12)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 34.0, 58.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("QIC-131", -0.1, 60.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 3.0, 240),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [g/(l s)]: the sensor, ten cells of the way, and the valve."""
        flow = 0.15 + ca.fmax(0.0, x[11]) / 100
        cells = lags(x[1:11], (27 + self.wander) / flow, 5.5 / flow)
        return column((x[1] - x[0]) / 18, *cells, (self.loaded(mv)[0] - x[11]) / 6)


@dataclass(frozen=True)
class Fouling(ClosedPlant):
    """A heater that fouls slowly and is cleaned: its gain moves by a factor of 1.5, behind a dead time."""

    wander: float = field(default=0.0, metadata={"unit": "degC"})
    fouling: float = field(default=0.4, metadata={"unit": "-"})
    name: ClassVar[str] = "fouling"
    title: ClassVar[str] = "Slow drift of the gain"
    period_s: ClassVar[float] = 20.0
    noise: ClassVar[tuple[float, ...]] = (0.15,)
    hold: ClassVar[int] = 70
    every: ClassVar[float] = 180
    state_signals: ClassVar[tuple[Signal, ...]] = states(6)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 0.0, 150.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 55.0, 78.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("TIC-141", 0.25, 180.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 4.5, 240),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [degC/s]: the sensor, the heater, and four lags of the steam."""
        steady = 20 + 1.15 * (1 - 0.5 * self.fouling) * x[2] + self.wander
        return column((x[1] - x[0]) / 25, (steady - x[1]) / 160, *lags(x[2:], self.loaded(mv)[0], 20.0))

    def drift(self, n: int, rng: np.random.Generator) -> dict[str, Array]:
        """The loads; and the fouling within 0 and .7, up and down every 3,000 samples or so."""
        phase = rng.uniform(0, 2 * np.pi)
        return super().drift(n, rng) | {"fouling": 0.35 + 0.35 * np.sin(2 * np.pi * np.arange(n) / 3_000 + phase)}


@dataclass(frozen=True)
class Evaporator(ClosedPlant):
    """Brine boiled down: what is left of the water divides, so that the gain bends; the feed is measured."""

    wander: float = field(default=0.0, metadata={"unit": "%"})
    feed: float = field(default=10.0, metadata={"unit": "t/h"})
    name: ClassVar[str] = "evaporator"
    title: ClassVar[str] = "Evaporator's bend"
    period_s: ClassVar[float] = 20.0
    noise: ClassVar[tuple[float, ...]] = (0.06,)
    hold: ClassVar[int] = 70
    every: ClassVar[float] = 190
    state_signals: ClassVar[tuple[Signal, ...]] = states(8)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 60.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 17.0, 26.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("DIC-151", 0.7, 180.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 1.0, 240),)
    measured_disturbances: ClassVar[tuple[Measured, ...]] = (Measured("feed", "FI-152", "t/h", 8, 12, 200, 5, 0.03),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: the sensor, the brine, three lags of the steam and three of the feed."""
        left = ca.fmax(1.0, x[5] - 0.08 * x[2])
        return column(
            (x[1] - x[0]) / 30, ((10 + self.wander) * x[5] / left - x[1]) / 150,
            *lags(x[2:5], self.loaded(mv)[0], 18.0), *lags(x[5:], self.feed, 12.0),
        )  # fmt: skip


@dataclass(frozen=True)
class Belt(ClosedPlant):
    """A kiln at the end of a belt: dead time twice the time constant."""

    wander: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "belt"
    title: ClassVar[str] = "Long dead time"
    period_s: ClassVar[float] = 15.0
    noise: ClassVar[tuple[float, ...]] = (0.25,)
    hold: ClassVar[int] = 90
    every: ClassVar[float] = 200
    bounded: ClassVar[bool] = False
    state_signals: ClassVar[tuple[Signal, ...]] = states(21)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 30.0, 62.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("MIC-161", 0.07, 135.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 7.0, 300),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]."""
        u = self.loaded(mv)[0] + self.wander
        return column((x[1] - x[0]) / 120, *lags(x[1:], 0.7 * u + 0.003 * u * u, 12.0))


CLOSED_UNTOUCHED: tuple[type[ClosedPlant], ...] = (Boiler, Blender, Sluice, Fouling, Evaporator, Belt)
