"""A surge tank whose level only has a band, and a blender with an analyser that speaks seldom and late."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from operated_plant import Held, OperatedPlant, Steps, Wandering
from pid_blocks import Pi, limited

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal


# ------------------------------------------------------------------------------------------------------------- the tank
def _tank(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Level and temperature of a heated tank, between a measured and an unmeasured inflow and a pumped outflow."""
    level, hot = x[0], x[1]
    inflow = d[0] + w[0]
    return [(inflow - u[1]) / 9, (inflow * (w[1] - hot) + 40 * u[0]) / (10 * ca.fmax(level, 5))]


class TankScheme:
    """Averaging level control by a slow PI and the inflow's mean; temperature by a PI and the inflow, fed forward."""

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        kt, tt, kl, tl, self.follow, self.of_flow = numbers
        self.ends, self.rates = plant.mv_ends(), [s.max_move for s in plant.mv]
        low, high = plant.range_of(1)
        self.middle = 0.5 * (low + high)
        self.hot, self.level = Pi(kt, tt, 0.0, 100.0), Pi(-kl, tl, 0.0, 100.0)
        self.inflow: float | None = None
        self.mean: float | None = None

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        flow = float(dv[0])
        change = 0.0 if self.inflow is None else flow - self.inflow
        mean = flow if self.mean is None else self.mean
        self.inflow, self.mean = flow, mean + min(self.follow, 1.0) * (flow - mean)
        out = self.level(self.middle, pv[1], mv[1]) + self.mean - mean
        heat = self.hot(sp[0], pv[0], mv[0]) + self.of_flow * change
        return limited(mv, np.array([heat, out]), *self.ends, self.rates)


TANK = OperatedPlant(
    name="tank",
    title="Surge tank: a level in a band (averaging), a temperature",
    pv=(Signal("TI", "degC", 0.0, 120.0), Signal("LI", "%", 0.0, 100.0)),
    sp=(Signal("TI", "degC", 45.0, 75.0),),
    mv=(Signal("heater", "%", 0.0, 100.0, max_move=10.0), Signal("outflow", "%", 0.0, 100.0, max_move=8.0)),
    noise=(0.15, 0.5),
    rhs=_tank,
    output=lambda x: [x[1], x[0]],
    x0=(50.0, 60.0),
    mv0=(50.0, 50.0),
    operate={"LI.low": 20.0, "LI.high": 80.0},
    moves=((25.0, 75.0), (0.0, 0.0)),
    held=(Held(1, 1, 0.6, 25.0, 75.0, 1.0),),
    hold=(5, 20),
    sp_steps=(Steps(52.0, 68.0, 70, 150),),
    dv=(Signal("inflow", "%", 0.0, 100.0),),
    dv_steps=(Steps(38.0, 62.0, 15, 60),),
    wanders=(Wandering(0.0, 3.0, 12.0), Wandering(20.0, 2.0, 40.0)),
    scheme=TankScheme,
    settings={
        "Kc heat": 2.0, "Ti heat": 10.0, "Kc level": 0.3, "Ti level": 120.0, "follow inflow": 0.1, "of flow": 1.0,
    },
)  # fmt: skip


# ---------------------------------------------------------------------------------------------------------- the blender
BEST, MIDDLE, CHEAP = 95.0, 88.0, 80.0  # quality of the three components
VOLATILE = (8.0, 4.0, 6.0)  # their vapour pressures


def _blender(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """A flow, and quality and vapour pressure of a stirred tank; the best and the cheap one help each other."""
    a, b, c = (0.5 * u[i] + 0.02 for i in range(3))
    total = a + b + c
    quality = (BEST * a + MIDDLE * b + (CHEAP + w[0]) * c) / total + 6 * a * c / (total * total)
    vapour = (VOLATILE[0] * a + VOLATILE[1] * b + VOLATILE[2] * c) / total + w[1]
    return [(total - x[0]) / 1.0, total * (quality - x[1]) / 500, total * (vapour - x[2]) / 500]


class BlenderScheme:
    """Shares in a total: the total by the flow, the best one's by the analyser, the middle one's by the vapour.

    More of the middle one, which is dear, comes where the vapour pressure is a back-off below its limit; it is taken
    from the others half and half.
    """

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        kf, tf, kq, tq, kv, tv, self.off = numbers
        self.ends, self.rates, self.limit = plant.mv_ends(), [s.max_move for s in plant.mv], plant.range_of(2)[1]
        self.every = plant.every[0]
        self.flow, self.quality, self.vapour = Pi(kf, tf, 0.0, 300.0), Pi(kq, tq, 0.0, 1.0), Pi(-kv, tv, 0.0, 0.9)
        self.shares: Array | None = None

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        if self.shares is None:
            self.shares = mv / mv.sum()
        total = self.flow(sp[1], pv[1], float(mv.sum()))
        middle = self.vapour(self.limit - self.off, pv[2], float(self.shares[1]))
        best = float(self.shares[0]) - 0.5 * (middle - float(self.shares[1]))
        if fresh[0] > 0:
            best = self.quality(sp[0], pv[0], best, dt=self.every)
        best = float(np.clip(best, 0.0, 1.0 - middle))
        self.shares = np.array([best, middle, 1.0 - best - middle])
        return limited(mv, total * self.shares, *self.ends, self.rates)


BLENDER = OperatedPlant(
    name="blender",
    title="Blender: three components at prices, an analyser every 20 samples and 5 late",
    pv=(Signal("QI", "-", 75.0, 100.0), Signal("FI", "t/h", 0.0, 150.0), Signal("VP", "psi", 0.0, 10.0)),
    sp=(Signal("QI", "-", 83.0, 91.0), Signal("FI", "t/h", 30.0, 70.0)),
    mv=tuple(Signal(n, "%", 0.0, 100.0, max_move=8.0) for n in ("best", "middle", "cheap")),
    noise=(0.08, 0.4, 0.04),
    rhs=_blender,
    output=lambda x: [x[1], x[0], x[2]],
    x0=(50.0, 87.7, 6.0),
    mv0=(33.0, 33.0, 34.0),
    operate={"VP.high": 6.3, "best.cost": 3.0, "middle.cost": 2.2, "cheap.cost": 1.2},
    moves=((10.0, 60.0), (5.0, 60.0), (10.0, 60.0)),
    hold=(8, 50),
    sp_steps=(Steps(85.0, 89.0, 100, 200), Steps(40.0, 60.0, 60, 140)),
    wanders=(Wandering(0.0, 0.7, 80.0), Wandering(0.0, 0.08, 60.0)),
    late={0: 5},
    every={0: 20},
    scheme=BlenderScheme,
    settings={
        "Kc flow": 1.0, "Ti flow": 2.0, "Kc quality": 0.03, "Ti quality": 20.0, "Kc vapour": 0.5, "Ti vapour": 12.0,
        "back-off vapour": 0.1,
    },
)  # fmt: skip
