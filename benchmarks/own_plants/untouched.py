"""The plants that no choice was made on; their scores are reported as they come."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from plant import OwnPlant, column, lags, signal, states, valves

from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class Delayed(OwnPlant):
    """One lag behind a long transport of twenty lags: dead time above the time constant."""

    name: ClassVar[str] = "delayed"
    title: ClassVar[str] = "Long transport"
    noise: ClassVar[tuple[float, ...]] = (0.3,)
    hold: ClassVar[int] = 90
    moves: ClassVar[tuple[int, int]] = (5, 60)
    state_signals: ClassVar[tuple[Signal, ...]] = states(21)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 20.0, 70.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]."""
        u = self.loaded(mv)[0]
        return column((x[1] - x[0]) / 40, *lags(x[1:], 0.6 * u + 0.003 * u * u, 5.0))


@dataclass(frozen=True)
class Titration(OwnPlant):
    """A curve like an S, eight times as steep in its middle as at its ends: the curvature changes its sign."""

    name: ClassVar[str] = "titration"
    title: ClassVar[str] = "S-shaped gain"
    noise: ClassVar[tuple[float, ...]] = (0.03,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 50)
    state_signals: ClassVar[tuple[Signal, ...]] = states(3)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("pH", 0.0, 14.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("pH", 4.0, 10.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]: the vessel, a lag, and the electrode behind the curve."""
        excess = (x[2] - 50) / 14
        ph = 7 + 0.35 * excess + 3.2 * excess / ca.sqrt(1 + excess**2)
        return column((x[1] - x[0]) / 15, (ph - x[1]) / 10, (self.loaded(mv)[0] - x[2]) / 90)


@dataclass(frozen=True)
class Pipe(OwnPlant):
    """A dose diluted by the flow that carries it: more flow gives less, and gives it sooner."""

    name: ClassVar[str] = "pipe"
    title: ClassVar[str] = "Delay that the MV changes"
    noise: ClassVar[tuple[float, ...]] = (0.2,)
    hold: ClassVar[int] = 80
    moves: ClassVar[tuple[int, int]] = (6, 70)
    bounded: ClassVar[bool] = False
    state_signals: ClassVar[tuple[Signal, ...]] = states(11)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 28.0, 55.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [g/(l s)]: ten cells of the pipe, and the sensor."""
        flow = 0.2 + ca.fmax(0.0, self.loaded(mv)[0]) / 100
        return column((x[1] - x[0]) / 20, *lags(x[1:], 30 / flow, 5.0 / flow))


@dataclass(frozen=True)
class Triple(OwnPlant):
    """Three valves and three qualities that depend on all of them, each with another dead time."""

    load2: float = field(default=0.0, metadata={"unit": "%"})
    load3: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "triple"
    title: ClassVar[str] = "3x3"
    noise: ClassVar[tuple[float, ...]] = (0.2, 0.2, 0.2)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 50)
    reached: ClassVar[tuple[float, float] | None] = (25.0, 75.0)
    state_signals: ClassVar[tuple[Signal, ...]] = states(9)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves(3)
    pv_signals: ClassVar[tuple[Signal, ...]] = tuple(signal("%", 0.0, 100.0, f"y{i}") for i in (1, 2, 3))
    sp_signals: ClassVar[tuple[Signal, ...]] = tuple(signal("%", 25.0, 75.0, f"y{i}") for i in (1, 2, 3))

    def output(self, x: Any) -> Any:
        """The three qualities."""
        return x[:3]

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: each quality behind a lag, the valves behind one, two and three lags."""
        u = self.loaded(mv)
        late = (x[3], x[4], x[6])
        gains = ((1.0, 0.4, -0.3), (-0.35, 0.9, 0.3), (0.3, -0.4, 1.1))
        taus = (70.0, 50.0, 90.0)
        rates = []
        for i in range(3):
            push = sum(g * (v - 50) for g, v in zip(gains[i], late, strict=True))
            rates.append((50 + push - 0.004 * push * ca.fabs(push) - x[i]) / taus[i])
        second, third = lags(x[4:6], u[1], 10.0), lags(x[6:9], u[2], 12.0)
        return column(*rates, (u[0] - x[3]) / 8, *second, *third)


@dataclass(frozen=True)
class Swell(OwnPlant):
    """A boiler's drum: cold feed makes the bubbles shrink first, and the level integrates; in an operator's hand."""

    name: ClassVar[str] = "swell"
    title: ClassVar[str] = "Integrator with inverse response"
    noise: ClassVar[tuple[float, ...]] = (0.3,)
    hold: ClassVar[int] = 80
    moves: ClassVar[tuple[int, int]] = (5, 40)
    hand: ClassVar[str] = "operator"
    state_signals: ClassVar[tuple[Signal, ...]] = states(3)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 35.0, 65.0),)

    def output(self, x: Any) -> Any:
        """Water and bubbles."""
        return x[0] + x[1]

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: the water, the bubbles, and the feed valve."""
        feed = x[2] - 48
        return column(0.008 * feed, (-0.15 * feed - x[1]) / 25, (self.loaded(mv)[0] - x[2]) / 10)


@dataclass(frozen=True)
class Recycle(OwnPlant):
    """A reactor with recycle: slow, with a pole that moves with the level; recorded under a sluggish PI controller."""

    name: ClassVar[str] = "recycle"
    title: ClassVar[str] = "Reactor with recycle, closed-loop record"
    noise: ClassVar[tuple[float, ...]] = (0.004,)
    hold: ClassVar[int] = 100
    moves: ClassVar[tuple[int, int]] = (15, 90)
    hand: ClassVar[str] = "closed loop"
    state_signals: ClassVar[tuple[Signal, ...]] = states(4)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("mol/l", 0.0, 2.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("mol/l", 0.3, 0.8),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [mol/(l s)]."""
        feed = self.loaded(mv)[0] / 100
        rate = 0.02 * x[0] ** 2
        return column(
            (0.02 * feed + 0.012 * x[3] - 0.012 * x[0]) - rate, *[(x[i - 1] - x[i]) / 20 for i in (1, 2)],
            (0.5 * x[2] - x[3]) / 20,
        )  # fmt: skip


@dataclass(frozen=True)
class Turning(OwnPlant):
    """A fermenter: product over dilution, a gain that falls to a fifth towards the top, a fast and a slow mode."""

    name: ClassVar[str] = "turning"
    title: ClassVar[str] = "Falling gain, fast and slow modes"
    noise: ClassVar[tuple[float, ...]] = (0.3,)
    hold: ClassVar[int] = 80
    moves: ClassVar[tuple[int, int]] = (5, 70)
    state_signals: ClassVar[tuple[Signal, ...]] = states(3)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 0.0, 80.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 20.0, 55.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        u = self.loaded(mv)[0] / 100
        steady = 70 * (1 - ca.exp(-2.2 * u))
        return column((0.6 * x[1] + 0.4 * x[2] - x[0]) / 8, (steady - x[1]) / 30, (steady - x[2]) / 200)


@dataclass(frozen=True)
class Oscillating(OwnPlant):
    """A lightly damped second order behind a saturating actuator."""

    name: ClassVar[str] = "oscillating"
    title: ClassVar[str] = "Lightly damped"
    noise: ClassVar[tuple[float, ...]] = (0.2,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (3, 40)
    state_signals: ClassVar[tuple[Signal, ...]] = states(3)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("bar", -20.0, 120.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("bar", 25.0, 75.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/s]."""
        force = 100 * ca.tanh(1.5 * (self.loaded(mv)[0] / 100 - 0.5)) + 50
        omega, damping = 2 * np.pi / 150, 0.25
        return column(x[1], omega**2 * (x[2] - x[0]) - 2 * damping * omega * x[1], (force - x[2]) / 15)


UNTOUCHED: tuple[type[OwnPlant], ...] = (
    Delayed,
    Titration,
    Pipe,
    Triple,
    Swell,
    Recycle,
    Turning,
    Oscillating,
)
