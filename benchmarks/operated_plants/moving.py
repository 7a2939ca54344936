"""Two pumps on one header, the better one first, and a reactor of four PVs and three MVs that shall make much."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from operated_plant import Held, OperatedPlant, Steps, Wandering
from pid_blocks import Pi, limited

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal


# ------------------------------------------------------------------------------------------------------------ the pumps
def _pumps(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Header pressure and the first pump's load: flows fall with the pressure, the demand grows with its root."""
    pressure, load = x[0], x[1]
    share = 1.3 - 0.05 * pressure
    first, second = (60 * ((u[i] + 1) / 100) ** 1.1 * share for i in range(2))
    taken = (d[0] + w[0]) * ca.sqrt(ca.fmax(pressure, 0.1) / 6)
    return [(first + second - taken) / 6, (100 * ((u[0] + 1) / 100) ** 2 * (0.7 + 0.05 * pressure) + w[1] - load) / 1.5]


class PumpsScheme:
    """Split range: the pressure asks for one sum; the first pump gives what its motor may, the second one the rest."""

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        kp, tp, kl, tl, self.off, self.of_demand = numbers
        self.ends, self.rates, self.limit = plant.mv_ends(), [s.max_move for s in plant.mv], plant.range_of(1)[1]
        high = self.ends[1]
        self.pressure, self.motor = Pi(kp, tp, 0.0, float(high.sum())), Pi(kl, tl, 0.0, float(high[0]))
        self.demand: float | None = None

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        change = 0.0 if self.demand is None else float(dv[0]) - self.demand
        self.demand = float(dv[0])
        asked = self.pressure(sp[0], pv[0], float(mv.sum())) + self.of_demand * change
        most = self.motor(self.limit - self.off, pv[1], float(mv[0]))
        first = float(np.clip(min(asked, most), mv[0] - self.rates[0], mv[0] + self.rates[0]))
        return limited(mv, np.array([first, asked - first]), *self.ends, self.rates)


PUMPS = OperatedPlant(
    name="pumps",
    title="Two pumps on one header: split range by cost, a motor's limit",
    pv=(Signal("PH", "bar", 0.0, 12.0), Signal("IA", "A", 0.0, 150.0)),
    sp=(Signal("PH", "bar", 5.0, 7.0),),
    mv=(Signal("first", "%", 0.0, 100.0, max_move=6.0), Signal("second", "%", 0.0, 100.0, max_move=6.0)),
    noise=(0.03, 0.6),
    rhs=_pumps,
    output=lambda x: [x[0], x[1]],
    x0=(6.0, 60.0),
    mv0=(70.0, 25.0),
    operate={"IA.high": 80.0, "first.cost": 1.0, "second.cost": 1.7},
    moves=((45.0, 92.0), (0.0, 50.0)),
    sp_steps=(Steps(5.4, 6.6, 70, 140),),
    dv=(Signal("demand", "t/h", 0.0, 120.0),),
    dv_steps=(Steps(44.0, 66.0, 20, 80),),
    wanders=(Wandering(0.0, 2.0, 15.0), Wandering(0.0, 2.0, 50.0)),
    scheme=PumpsScheme,
    settings={
        "Kc header": 12.0, "Ti header": 6.0, "Kc motor": 0.6, "Ti motor": 2.0, "back-off motor": 1.5, "of demand": 1.0,
    },
)  # fmt: skip


# ---------------------------------------------------------------------------------------------------------- the reactor
def _reactor(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Level, concentration, temperature and jacket of a stirred reactor A -> B that heats itself."""
    level, left, hot, jacket = x[0], x[1], x[2], x[3]
    rate = 0.5 * ca.exp(0.045 * (hot - 70)) * left
    fed = u[0] / (5 * ca.fmax(level, 5))
    return [
        (u[0] - u[2]) / 5,
        fed * (10 + w[0] - left) - rate,
        fed * (d[0] - hot) + 8 * rate - (0.25 + w[1]) * (hot - jacket),
        0.01 * u[1] * (20 - jacket) + 0.5 * (hot - jacket),
    ]


class ReactorScheme:
    """Temperature by the coolant, what is left of A by the feed, the level, near its upper mark, by the outflow.

    The jacket's lower limit takes over the coolant by a low selector.
    """

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        kt, tt, kc, tc, kl, tl, self.below, kj, tj, self.off, self.of_feed = numbers
        self.ends, self.rates = plant.mv_ends(), [s.max_move for s in plant.mv]
        low, high = self.ends
        self.top, self.least = plant.range_of(2)[1], plant.range_of(3)[0]
        self.hot, self.left = Pi(-kt, tt, low[1], high[1]), Pi(kc, tc, low[0], high[0])
        self.level, self.jacket = Pi(-kl, tl, low[2], high[2]), Pi(-kj, tj, low[1], high[1])

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        feed = float(np.clip(self.left(sp[1], pv[1], mv[0]), mv[0] - self.rates[0], mv[0] + self.rates[0]))
        coolant = self.hot(sp[0], pv[0], mv[1]) + self.of_feed * (feed - mv[0])
        coolant = min(coolant, self.jacket(self.least + self.off, pv[3], mv[1]))
        out = self.level(self.top - self.below, pv[2], mv[2])
        return limited(mv, np.array([feed, coolant, out]), *self.ends, self.rates)


REACTOR = OperatedPlant(
    name="reactor",
    title="Reactor: two set points, a level in a band, a jacket's limit, much feed",
    pv=(
        Signal("TR", "degC", 20.0, 130.0),
        Signal("CA", "mol/l", 0.0, 10.0),
        Signal("LI", "%", 0.0, 100.0),
        Signal("TJ", "degC", 0.0, 120.0),
    ),
    sp=(Signal("TR", "degC", 62.0, 78.0), Signal("CA", "mol/l", 1.8, 3.2)),
    mv=tuple(Signal(n, "%", 0.0, 100.0, max_move=m) for n, m in (("feed", 4.0), ("coolant", 6.0), ("outflow", 5.0))),
    noise=(0.15, 0.03, 0.5, 0.2),
    rhs=_reactor,
    output=lambda x: [x[2], x[1], x[0], x[3]],
    x0=(50.0, 2.5, 70.0, 50.0),
    mv0=(41.7, 33.0, 41.7),
    operate={"LI.low": 30.0, "LI.high": 80.0, "TJ.low": 42.0, "feed.cost": -1.0},
    moves=((30.0, 64.0), (20.0, 50.0), (0.0, 0.0)),
    held=(Held(2, 2, 0.4, 35.0, 75.0, 0.0, ((0, 1.0),), (2, 4)),),
    hold=(6, 30),
    sp_steps=(Steps(67.0, 73.0, 80, 160), Steps(2.2, 2.8, 80, 160)),
    dv=(Signal("hot feed", "degC", 0.0, 80.0),),
    dv_steps=(Steps(36.0, 44.0, 60, 140),),
    wanders=(Wandering(0.0, 0.3, 50.0), Wandering(0.0, 0.01, 80.0)),
    scheme=ReactorScheme,
    settings={
        "Kc T": 3.0, "Ti T": 8.0, "Kc A": 8.0, "Ti A": 8.0, "Kc level": 0.6, "Ti level": 30.0, "below mark": 6.0,
        "Kc jacket": 2.0, "Ti jacket": 5.0, "back-off jacket": 1.0, "of feed": 0.5,
    },
)  # fmt: skip
