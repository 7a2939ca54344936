"""Linear plants whose answers are known: in other units and minutes, with two MVs, with dead time. Not a test."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.serving.manifest import Signal


@dataclass(frozen=True)
class Lag(EquationPlant):
    """gain u = tau dx/dt + x, written in minutes, measured in tenths."""

    gain: float = field(default=2.0, metadata={"unit": "m/V"})
    tau: float = field(default=3.0, metadata={"unit": "min"})

    name: ClassVar[str] = "lag"
    title: ClassVar[str] = "Lag"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("x", "m", -20.0, 20.0),)
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("y", "dm", -200.0, 200.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = pv_signals
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("u", "V", -5.0, 5.0),)
    period_s: ClassVar[float] = 30.0
    substeps: ClassVar[int] = 10
    time_unit_s: ClassVar[float] = 60.0

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        return (self.gain * mv[0] - x[0]) / self.tau

    def output(self, x: Any) -> Any:
        return 10 * x


@dataclass(frozen=True)
class Mixer(EquationPlant):
    """dx/dt = k u - x / tau for level and temperature, each moved by both MVs."""

    k: float = field(default=0.5, metadata={"unit": "1/s"})
    tau: float = field(default=4.0, metadata={"unit": "s"})

    name: ClassVar[str] = "mixer"
    title: ClassVar[str] = "Mixer"
    state_signals: ClassVar[tuple[Signal, ...]] = (Signal("L", "m", -50.0, 50.0), Signal("T", "K", -50.0, 50.0))
    pv_signals: ClassVar[tuple[Signal, ...]] = state_signals
    sp_signals: ClassVar[tuple[Signal, ...]] = state_signals
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("hot", "l/s", 0.0, 8.0), Signal("cold", "l/s", 1.0, 9.0))
    period_s: ClassVar[float] = 1.0
    substeps: ClassVar[int] = 4

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        return ca.vertcat(self.k * (mv[0] + mv[1]), self.k * (mv[0] - mv[1])) - x / self.tau


@dataclass(frozen=True)
class Chain(EquationPlant):
    """Five equal lags in series, nearly a dead time; with ``back`` above 0 the output first goes the wrong way."""

    tau: float = field(default=4.0, metadata={"unit": "s"})
    back: float = field(default=0.0, metadata={"unit": "-"})

    name: ClassVar[str] = "chain"
    title: ClassVar[str] = "Chain"
    state_signals: ClassVar[tuple[Signal, ...]] = tuple(Signal(f"x{i}", "m", -2.0, 2.0) for i in range(5))
    pv_signals: ClassVar[tuple[Signal, ...]] = (Signal("y", "m", -2.0, 2.0),)
    sp_signals: ClassVar[tuple[Signal, ...]] = (Signal("y", "m", -1.0, 1.0),)
    mv_signals: ClassVar[tuple[Signal, ...]] = (Signal("u", "m", -3.0, 3.0),)
    period_s: ClassVar[float] = 2.0
    substeps: ClassVar[int] = 4

    def derivative(self, x: Any, mv: Any, dv: Any) -> Any:
        return (ca.vertcat(mv[0], x[0], x[1], x[2], x[3]) - x) / self.tau

    def output(self, x: Any) -> Any:
        return (1 + self.back) * x[4] - self.back * x[0]
