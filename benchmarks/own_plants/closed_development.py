"""The plants in closed-loop records in sight of which the method may be chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
from closed_plant import ClosedPlant, Measured, OldLoop, Wander
from plant import column, lags, signal, states, valves

from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class Dryer(ClosedPlant):
    """A drum dryer behind its burner: dead time, a measured feed with a dead time of its own, a load that wanders."""

    wander: float = field(default=0.0, metadata={"unit": "degC"})
    feed: float = field(default=10.0, metadata={"unit": "t/h"})
    name: ClassVar[str] = "dryer"
    title: ClassVar[str] = "Dryer: dead time, measured feed"
    period_s: ClassVar[float] = 30.0
    noise: ClassVar[tuple[float, ...]] = (0.15,)
    hold: ClassVar[int] = 100
    every: ClassVar[float] = 240
    state_signals: ClassVar[tuple[Signal, ...]] = states(14)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 0.0, 150.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 80.0, 105.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("TIC-101", 0.15, 420.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 6.5, 360),)
    measured_disturbances: ClassVar[tuple[Measured, ...]] = (Measured("feed", "FI-7", "t/h", 6, 14, 180, 8, 0.05),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [degC/s]: the sensor, the drum, and the ways of the hot gas (8 lags) and of the feed (4 lags)."""
        gas = self.loaded(mv)[0] - 50
        heated = 92 + 1.2 * x[2] - 0.004 * x[2] * x[2] - 3.0 * (x[10] - 10) + self.wander
        return column(
            (x[1] - x[0]) / 40, (heated - x[1]) / 420, *lags(x[2:10], gas, 26.0), *lags(x[10:], self.feed, 30.0)
        )


@dataclass(frozen=True)
class Sump(ClosedPlant):
    """A sump that is boiled down: its level integrates, its concentration settles; both valves move both."""

    load2: float = field(default=0.0, metadata={"unit": "%"})
    wander: float = field(default=0.0, metadata={"unit": "%"})
    wander2: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "sump"
    title: ClassVar[str] = "2x2 with an integrator"
    noise: ClassVar[tuple[float, ...]] = (0.3, 0.2)
    hold: ClassVar[int] = 70
    every: ClassVar[float] = 220
    in_manual: ClassVar[tuple[int, int]] = (20, 50)
    state_signals: ClassVar[tuple[Signal, ...]] = states(7)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves(2)
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 0, 100, "level"), signal("g/l", 0, 100, "strength"))
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("%", 35, 65, "level"), signal("g/l", 38, 62, "strength"))
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("LIC-201", -1.2, 500.0), OldLoop("QIC-202", 0.45, 130.0))
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 5.0, 200), Wander("wander2", 8.0, 260))

    def output(self, x: Any) -> Any:
        """Level and strength."""
        return x[:2]

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt: the drain valve behind two lags, the steam behind three; the inflow wanders, and so does the steam."""
        u1, u2 = self.loaded(mv)
        drain, steam = x[2] - 50, x[4] + self.wander2 - 50
        level = 0.004 * (self.wander - drain - 0.45 * steam)
        strength = 50 + 0.8 * steam + 0.004 * steam * steam - 0.35 * drain - 0.25 * self.wander
        return column(level, (strength - x[1]) / 120, *lags(x[2:4], u1, 8.0), *lags(x[4:], u2, 12.0))


@dataclass(frozen=True)
class Crest(ClosedPlant):
    """A burner's draught: more air heats until it cools. The gain turns its sign at 60 %, the PI works below."""

    wander: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "crest"
    title: ClassVar[str] = "Gain that turns its sign"
    noise: ClassVar[tuple[float, ...]] = (0.15,)
    hold: ClassVar[int] = 60
    every: ClassVar[float] = 160
    hand_moves: ClassVar[tuple[float, float]] = (6.0, 34.0)
    state_signals: ClassVar[tuple[Signal, ...]] = states(5)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 0.0, 120.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 60.0, 78.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("TIC-301", 0.48, 90.0, 0.0, 56.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 6.5, 180),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [degC/s]: the sensor, the chamber, and three lags of the draught."""
        draught = x[2] + self.wander - 60
        steady = 80 - 48 * draught * draught / (2_600 + draught * draught)
        return column((x[1] - x[0]) / 12, (steady - x[1]) / 90, *lags(x[2:], self.loaded(mv)[0], 8.0))


@dataclass(frozen=True)
class Foam(ClosedPlant):
    """A foaming vessel's weight: noise of 10 % of the set points' range, behind a valve whose gain grows."""

    wander: float = field(default=0.0, metadata={"unit": "%"})
    name: ClassVar[str] = "foam"
    title: ClassVar[str] = "Noise of 10 %"
    noise: ClassVar[tuple[float, ...]] = (4.0,)
    hold: ClassVar[int] = 70
    every: ClassVar[float] = 170
    state_signals: ClassVar[tuple[Signal, ...]] = states(4)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("kg", 0.0, 120.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("kg", 25.0, 65.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("WIC-401", 0.24, 90.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 9.0, 200),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [kg/s]."""
        u = ca.fmax(0.0, x[2] + self.wander) / 100
        return column(
            (x[1] - x[0]) / 25, (110 * (0.4 * u + 0.6 * u * u) - x[1]) / 80, *lags(x[2:], self.loaded(mv)[0], 8.0)
        )


@dataclass(frozen=True)
class Sticking(ClosedPlant):
    """A heater whose valve sticks: it stays until the command is 1.5 % off, then goes on to the command."""

    wander: float = field(default=0.0, metadata={"unit": "degC"})
    stick: float = field(default=1.5, metadata={"unit": "%"})
    name: ClassVar[str] = "sticking"
    title: ClassVar[str] = "Valve that sticks"
    noise: ClassVar[tuple[float, ...]] = (0.1,)
    substeps: ClassVar[int] = 10
    hold: ClassVar[int] = 60
    every: ClassVar[float] = 160
    state_signals: ClassVar[tuple[Signal, ...]] = states(6)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 0.0, 120.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("degC", 45.0, 70.0),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("TIC-501", 0.5, 90.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 5.0, 200),)

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt: sensor, heater, two lags; the valve x4, and x5, which is 1 while the valve moves."""
        off = self.loaded(mv)[0] - x[4]
        loose = 0.5 * (1 + ca.tanh((ca.fabs(off) - self.stick * (1 - 0.87 * x[5])) / 0.08))
        steady = 20 + 0.9 * x[2] - 0.0025 * x[2] * x[2] + self.wander
        return column(
            (x[1] - x[0]) / 12, (steady - x[1]) / 80, (x[3] - x[2]) / 10, (x[4] - x[3]) / 10,
            x[5] * off / 3.0, (loose - x[5]) / 2.0,
        )  # fmt: skip

    @property
    def bounding(self) -> ClosedPlant:
        """The heater with a valve that does not stick: no solver plans through the valve's."""
        return self.with_parameters({"stick": 0.0})


@dataclass(frozen=True)
class Growth(ClosedPlant):
    """A continuous fermenter: the dilution washes substrate in, growth (Monod) eats it; the gain grows sixfold."""

    wander: float = field(default=0.0, metadata={"unit": "-"})
    strength: float = field(default=10.0, metadata={"unit": "g/l"})
    name: ClassVar[str] = "growth"
    title: ClassVar[str] = "Growth kinetics"
    period_s: ClassVar[float] = 300.0
    time_unit_s: ClassVar[float] = 3_600.0
    noise: ClassVar[tuple[float, ...]] = (0.006,)
    hold: ClassVar[int] = 80
    every: ClassVar[float] = 200
    state_signals: ClassVar[tuple[Signal, ...]] = states(4)
    mv_signals: ClassVar[tuple[Signal, ...]] = valves()
    pv_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 0.0, 4.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (signal("g/l", 0.4, 1.4),)
    loops: ClassVar[tuple[OldLoop, ...]] = (OldLoop("QIC-601", 8.0, 4_000.0),)
    wanders: ClassVar[tuple[Wander, ...]] = (Wander("wander", 0.11, 260),)
    measured_disturbances: ClassVar[tuple[Measured, ...]] = (
        Measured("strength", "QI-602", "g/l", 7, 13, 200, 6, 0.03),
    )

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        """dx/dt [1/h]: the probe, substrate, cells, and the feed pump."""
        rate = 0.42 * (1 + self.wander) * x[1] / (0.6 + x[1])
        dilution = 0.0042 * x[3]
        substrate = dilution * (self.strength - x[1]) - 2.0 * rate * x[2]
        return column((x[1] - x[0]) / 0.2, substrate, (rate - dilution) * x[2], (self.loaded(mv)[0] - x[3]) / 0.05)


CLOSED_DEVELOPMENT: tuple[type[ClosedPlant], ...] = (Dryer, Sump, Crest, Foam, Sticking, Growth)
