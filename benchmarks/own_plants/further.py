"""Plants whose gains turn, fade or cross, and one with much noise: what `new` and `run` must not refuse."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
from plant import OwnPlant, column, lags, signal, states, valves

from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class Burner(OwnPlant):
    """A furnace over its air: hottest at 62 % of the damper, and the record visits both sides of it."""

    name: ClassVar[str] = "burner"
    title: ClassVar[str] = "Gain that turns its sign"
    noise: ClassVar[tuple[float, ...]] = (1.5,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 60)
    state_signals: ClassVar[tuple[Signal, ...]] = states(4)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 300.0, 1_100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 620.0, 860.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [degC/s]: the sensor, the furnace, and two lags of the damper."""
        air = x[2] - 62
        steady = 900 - 480 * air * air / (1_900 + air * air)
        return column((x[1] - x[0]) / 12, (steady - x[1]) / 80, *lags(x[2:], self.loaded(mv)[0], 8.0))


@dataclass(frozen=True)
class Saturating(OwnPlant):
    """A reactor's conversion over its catalyst: the gain fades to a fiftieth of its first value."""

    name: ClassVar[str] = "saturating"
    title: ClassVar[str] = "Gain that fades"
    noise: ClassVar[tuple[float, ...]] = (0.25,)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 50)
    state_signals: ClassVar[tuple[Signal, ...]] = states(5)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 40.0, 90.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: the analyser, the reactor, and a transport of three lags."""
        steady = 96 * (1 - ca.exp(-ca.fmax(x[2], 0.0) / 21))
        return column((x[1] - x[0]) / 20, (steady - x[1]) / 60, *lags(x[2:], self.loaded(mv)[0], 7.0))


@dataclass(frozen=True)
class Mixer(OwnPlant):
    """Three streams into one vessel: its level follows their sum, its colour and its heat their ratios."""

    load2: float = field(default=0.0, metadata={"unit": "%"})
    load3: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "mixer"
    title: ClassVar[str] = "3x3 by ratios"
    noise: ClassVar[tuple[float, ...]] = (0.3, 0.2, 0.2)
    hold: ClassVar[int] = 70
    moves: ClassVar[tuple[int, int]] = (4, 60)
    span: ClassVar[tuple[float, float]] = (25.0, 75.0)
    reached: ClassVar[tuple[float, float] | None] = (35.0, 65.0)
    state_signals: ClassVar[tuple[Signal, ...]] = states(6)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves(3)
    pv_signals: ClassVar[tuple[Signal, ...]] = (
        signal("%", 0.0, 150.0, "y1"), signal("%", 0.0, 100.0, "y2"), signal("%", 0.0, 100.0, "y3"),
    )  # fmt: skip
    sp_signals: ClassVar[tuple[Signal, ...]] = (
        signal("%", 14.0, 94.0, "y1"), signal("%", 13.0, 53.0, "y2"), signal("%", 13.0, 53.0, "y3"),
    )  # fmt: skip

    def output(self, x: Any) -> Any:
        """Level, colour and heat."""
        return x[:3]

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: the three qualities behind the streams' lags."""
        late = [ca.fmax(v, 1.0) for v in (x[3], x[4], x[5])]
        total = late[0] + late[1] + late[2]
        level = 0.0024 * total * total
        rates = [(level - x[0]) / 150]
        rates += [(100 * share / total - y) / tau for share, y, tau in ((late[1], x[1], 45.0), (late[2], x[2], 70.0))]
        return column(*rates, *((v - s) / 12 for v, s in zip(self.loaded(mv), (x[3], x[4], x[5]), strict=True)))


@dataclass(frozen=True)
class Frothing(OwnPlant):
    """A flotation cell's level: noise of 10 % of the range, a gain that falls, and a transport."""

    name: ClassVar[str] = "frothing"
    title: ClassVar[str] = "Noise of 10 %"
    noise: ClassVar[tuple[float, ...]] = (4.0,)
    hold: ClassVar[int] = 80
    moves: ClassVar[tuple[int, int]] = (5, 80)
    state_signals: ClassVar[tuple[Signal, ...]] = states(5)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("cm", 0.0, 100.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("cm", 30.0, 70.0),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [cm/s]."""
        u = ca.fmax(x[2], 0.0) / 100
        return column((x[1] - x[0]) / 30, (100 * u / (0.35 + u) - x[1]) / 70, *lags(x[2:], self.loaded(mv)[0], 8.0))


@dataclass(frozen=True)
class Ridge(OwnPlant):
    """Two by two: the first valve's gain on the second output turns its sign inside the range."""

    load2: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "ridge"
    title: ClassVar[str] = "2x2, a coupling that turns its sign"
    noise: ClassVar[tuple[float, ...]] = (0.2, 0.2)
    hold: ClassVar[int] = 60
    moves: ClassVar[tuple[int, int]] = (4, 50)
    reached: ClassVar[tuple[float, float] | None] = (20.0, 80.0)
    state_signals: ClassVar[tuple[Signal, ...]] = states(6)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves(2)
    pv_signals: ClassVar[tuple[Signal, ...]] = tuple(signal("%", -50.0, 150.0, f"y{i}") for i in (1, 2))
    sp_signals: ClassVar[tuple[Signal, ...]] = tuple(signal("%", 0.0, 100.0, f"y{i}") for i in (1, 2))

    def output(self, x: Any) -> Any:
        """Both outputs."""
        return x[:2]

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [%/s]: the outputs behind a lag, the valves behind two."""
        u = self.loaded(mv)
        first, second = x[2] - 50, x[4] - 50
        rates = [(50 + 0.8 * first + 0.2 * second - x[0]) / 60, (50 - 0.012 * first * first + 0.9 * second - x[1]) / 45]
        return column(*rates, *lags(x[2:4], u[0], 7.0), *lags(x[4:6], u[1], 9.0))


FURTHER: tuple[type[OwnPlant], ...] = (Burner, Saturating, Mixer, Frothing, Ridge)
