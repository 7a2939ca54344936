"""A furnace with two fuels of different price, and an exchanger whose bypass is quick and whose steam is slow."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from operated_plant import OperatedPlant, Steps, Wandering
from pid_blocks import Pi, limited

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

OIL_HEAT = 1.3  # of a unit of oil over one of gas
AIR = 1.52  # fuel that a unit of air burns


# ---------------------------------------------------------------------------------------------------------- the furnace
def _furnace(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Duty, outlet and skin temperature, and oxygen: much air carries heat away, too little leaves fuel unburnt."""
    duty, outlet, oxygen, skin = x[0], x[1], x[2], x[3]
    fuel = (1 + w[0]) * u[0] + OIL_HEAT * u[1] + 0.5
    excess = 21 * (1 - fuel / (AIR * u[2] + 0.5))
    left = 0.5 * (excess + ca.sqrt(excess * excess + 0.3))
    unburnt = left - excess  # above 0 where air is short
    made = fuel * (0.92 - 0.008 * left - 0.01 * unburnt)
    rest = 200 + 138 * duty / d[0]
    return [
        (made - duty) / 4,
        d[0] * (rest - outlet) / 500,
        (left - oxygen) / 1.5,
        (outlet + 2.2 * duty + w[1] - skin) / 5,
    ]


class FurnaceScheme:
    """Outlet temperature by the heat of both fuels, gas first and oil as it falls short; air by ratio, oxygen trims it.

    The skin temperature takes over the heat by a low selector; the charge is fed forward.
    """

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        kt, tt, ko, to, self.oxygen, ks, ts, self.off, self.of_charge = numbers
        self.ends, self.rates = plant.mv_ends(), [s.max_move for s in plant.mv]
        most = float(self.ends[1][0] + OIL_HEAT * self.ends[1][1])
        self.limit, self.least = plant.range_of(2)[1], plant.range_of(1)[0]
        self.outlet, self.skin, self.trim = Pi(kt, tt, 0.0, most), Pi(ks, ts, 0.0, most), Pi(ko, to, 0.3, 1.5)
        self.ratio: float | None = None
        self.charge: float | None = None

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        heat = float(mv[0] + OIL_HEAT * mv[1])
        ratio = float(mv[2]) / max(heat, 1.0) if self.ratio is None else self.ratio
        change = 0.0 if self.charge is None else float(dv[0]) - self.charge
        self.charge = float(dv[0])
        asked = self.outlet(sp[0], pv[0], heat) + self.of_charge * change
        asked = min(asked, self.skin(self.limit - self.off, pv[2], heat))
        gas = min(asked, float(self.ends[1][0]))
        self.ratio = self.trim(self.least + self.oxygen, pv[1], ratio)
        wanted = np.array([gas, (asked - gas) / OIL_HEAT, 0.0])
        wanted[:2] = np.clip(wanted[:2], mv[:2] - self.rates[0], mv[:2] + self.rates[0])
        wanted[2] = self.ratio * (wanted[0] + OIL_HEAT * wanted[1])
        return limited(mv, wanted, *self.ends, self.rates)


FURNACE = OperatedPlant(
    name="furnace",
    title="Furnace: cheap gas up to its limit, dear oil, air",
    pv=(Signal("TO", "degC", 200.0, 500.0), Signal("O2", "%", 0.0, 15.0), Signal("TS", "degC", 300.0, 700.0)),
    sp=(Signal("TO", "degC", 335.0, 385.0),),
    mv=(
        Signal("gas", "%", 0.0, 100.0, max_move=6.0),
        Signal("oil", "%", 0.0, 100.0, max_move=6.0),
        Signal("air", "%", 0.0, 100.0, max_move=8.0),
    ),
    noise=(0.4, 0.1, 0.8),
    rhs=_furnace,
    output=lambda x: [x[1], x[2], x[3]],
    x0=(58.0, 360.0, 3.2, 488.0),
    mv0=(45.0, 15.0, 50.0),
    operate={"O2.low": 2.0, "O2.high": 8.0, "TS.high": 525.0, "gas.high": 55.0, "gas.cost": 1.0, "oil.cost": 2.4},
    moves=((32.0, 58.0), (4.0, 28.0), (42.0, 66.0)),
    sp_steps=(Steps(345.0, 375.0, 80, 160),),
    dv=(Signal("charge", "t/h", 20.0, 80.0),),
    dv_steps=(Steps(44.0, 56.0, 60, 140),),
    wanders=(Wandering(0.0, 0.04, 50.0), Wandering(0.0, 5.0, 100.0)),
    scheme=FurnaceScheme,
    settings={
        "Kc outlet": 0.3, "Ti outlet": 12.0, "Kc oxygen": 0.02, "Ti oxygen": 4.0, "oxygen above": 0.8,
        "Kc skin": 0.15, "Ti skin": 10.0, "back-off skin": 3.0, "of charge": 1.2,
    },
)  # fmt: skip


# -------------------------------------------------------------------------------------------------------- the exchanger
def _exchanger(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Shell, tube and mixed temperature: what goes through the tubes is heated, what bypasses them is not."""
    shell, tube, mixed = x[0], x[1], x[2]
    past = u[0] / 100
    through = d[0] * (1 - past) + 2.0
    units = (1.1 + w[1]) * (through / 35) ** -0.4
    cold = 30 + w[0]
    return [
        (120 + 1.2 * (u[1] - 50) - 0.8 * (through - 37) - shell) / 20,
        (cold + (shell - cold) * (1 - ca.exp(-units)) - tube) / 3,
        ((1 - past) * tube + past * cold - mixed) / 1.5,
    ]


class ExchangerScheme:
    """Valve position control: the bypass holds the temperature, and the steam brings the bypass back to its rest.

    A low selector keeps the shell below its limit.
    """

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        kt, tt, kv, tv, ks, ts, self.off = numbers
        self.ends, self.rates = plant.mv_ends(), [s.max_move for s in plant.mv]
        low, high = self.ends
        self.rest, self.limit = plant.operate["bypass.rest"], plant.range_of(1)[1]
        self.mixed = Pi(-kt, tt, low[0], high[0])
        self.position, self.shell = Pi(-kv, tv, low[1], high[1]), Pi(ks, ts, low[1], high[1])

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        bypass = self.mixed(sp[0], pv[0], mv[0])
        # A bypass that is too far shut asks for more steam.
        steam = self.position(-self.rest, -bypass, mv[1])
        steam = min(steam, self.shell(self.limit - self.off, pv[1], mv[1]))
        return limited(mv, np.array([bypass, steam]), *self.ends, self.rates)


EXCHANGER = OperatedPlant(
    name="exchanger",
    title="Exchanger: a quick bypass with a rest, slow steam (valve position control)",
    pv=(Signal("TM", "degC", 20.0, 140.0), Signal("TS", "degC", 40.0, 200.0)),
    sp=(Signal("TM", "degC", 60.0, 84.0),),
    mv=(Signal("bypass", "%", 0.0, 100.0, max_move=15.0), Signal("steam", "%", 0.0, 100.0, max_move=2.0)),
    noise=(0.15, 0.3),
    rhs=_exchanger,
    output=lambda x: [x[2], x[0]],
    x0=(120.0, 90.0, 72.0),
    mv0=(30.0, 50.0),
    operate={"TS.high": 132.0, "bypass.rest": 30.0, "bypass.rest_use": 1.0},
    moves=((5.0, 60.0), (32.0, 66.0)),
    sp_steps=(Steps(65.0, 79.0, 70, 140),),
    dv=(Signal("flow", "t/h", 20.0, 80.0),),
    dv_steps=(Steps(43.0, 57.0, 60, 140),),
    wanders=(Wandering(0.0, 1.5, 20.0), Wandering(0.0, 0.04, 80.0)),
    scheme=ExchangerScheme,
    settings={
        "Kc mixed": 1.2, "Ti mixed": 4.0, "Kc position": 0.05, "Ti position": 10.0, "Kc shell": 1.0, "Ti shell": 15.0,
        "back-off shell": 1.0,
    },
)  # fmt: skip
