"""A column whose steam has a price, and an evaporator that shall make as much as its condenser can take."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from operated_plant import Held, OperatedPlant, Steps, Wandering
from pid_blocks import Pi, limited

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal


# ----------------------------------------------------------------------------------------------------------- the column
def _column(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Logarithms of two impurities behind two lags each, and the pressure drop, which grows faster than the vapour."""
    reflux, steam, feed = u[0] - 50, u[1] - 50, d[0] - 50
    top = np.log(2.0) - 0.030 * reflux + 0.022 * steam + 0.010 * feed + w[0]
    bottom = np.log(2.0) + 0.016 * reflux - 0.040 * steam + 0.030 * feed + w[0] + w[1]
    drop = 10 + 0.25 * u[1] + 0.004 * u[1] ** 2 + 0.15 * feed
    return [(x[1] - x[0]) / 12, (top - x[1]) / 3, (x[3] - x[2]) / 9, (bottom - x[3]) / 3, (drop - x[4]) / 1.5]


class ColumnScheme:
    """Top impurity by reflux, bottom impurity by steam a back-off below its limit; the drop takes over the steam.

    A low selector of two PI, and feedforward of the feed to the steam and of the steam to the reflux.
    """

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        self.plant = plant
        kt, tt, kb, tb, self.off, kp, tp, self.drop_off, self.of_feed, self.of_steam = numbers
        (low, high), mv = plant.mv_ends(), plant.mv
        self.top = Pi(-kt, tt, low[0], high[0])
        self.bottom = Pi(-kb, tb, low[1], high[1])
        self.drop = Pi(kp, tp, low[1], high[1])
        self.ends, self.rates = (low, high), [s.max_move for s in mv]
        self.feed: float | None = None

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        feed = float(dv[0])
        change = 0.0 if self.feed is None else feed - self.feed
        self.feed = feed
        limit, most = self.plant.range_of(1)[1], self.plant.range_of(2)[1]
        asked = self.bottom(limit - self.off, pv[1], mv[1]) + self.of_feed * change
        steam = min(asked, self.drop(most - self.drop_off, pv[2], mv[1]))
        reflux = self.top(sp[0], pv[0], mv[0]) + self.of_steam * (steam - mv[1])
        return limited(mv, np.array([reflux, steam]), *self.ends, self.rates)


COLUMN = OperatedPlant(
    name="column",
    title="Column: two products, steam at a price, flooding",
    pv=(Signal("AT", "%", 0.0, 12.0), Signal("AB", "%", 0.0, 12.0), Signal("PD", "mbar", 0.0, 100.0)),
    sp=(Signal("AT", "%", 1.0, 3.5),),
    mv=(Signal("reflux", "%", 0.0, 100.0, max_move=5.0), Signal("steam", "%", 0.0, 100.0, max_move=4.0)),
    noise=(0.03, 0.04, 0.4),
    rhs=_column,
    output=lambda x: [ca.exp(x[0]), ca.exp(x[2]), x[4]],
    x0=(np.log(2.0), np.log(2.0), np.log(2.0), np.log(2.0), 32.5),
    mv0=(50.0, 50.0),
    operate={"AB.high": 2.5, "PD.high": 40.0, "steam.cost": 1.0},
    moves=((32.0, 68.0), (34.0, 66.0)),
    sp_steps=(Steps(1.4, 3.0, 80, 160),),
    dv=(Signal("feed", "%", 0.0, 100.0),),
    dv_steps=(Steps(42.0, 58.0, 60, 140),),
    wanders=(Wandering(0.0, 0.10, 60.0), Wandering(0.0, 0.08, 30.0)),
    scheme=ColumnScheme,
    settings={
        "Kc top": 8.0, "Ti top": 15.0, "Kc bottom": 5.0, "Ti bottom": 12.0, "back-off bottom": 0.25,
        "Kc drop": 0.8, "Ti drop": 3.0, "back-off drop": 1.0, "of feed": 0.7, "of steam": 0.5,
    },
)  # fmt: skip


# ------------------------------------------------------------------------------------------------------- the evaporator
def _evaporator(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Level, concentration and pressure: what the steam evaporates thickens the feed and loads the condenser."""
    level, thick, pressure = x[0], x[1], x[2]
    vapour = 0.7 * u[1] * (1 - 0.003 * (pressure - 50))
    rest = 20 + 0.9 * vapour + 1.2 * (d[0] - 20) + w[1]
    return [
        (u[0] - vapour - u[2]) / 5,
        (u[0] * (9 + w[0] - thick) + vapour * thick) / (5 * ca.fmax(level, 5)),
        (rest - pressure) / 6,
    ]


class EvaporatorScheme:
    """Concentration by steam, level by the product; the pressure, a back-off below its limit, sets the feed."""

    def __init__(self, plant: OperatedPlant, numbers: Array) -> None:
        kx, tx, kl, tl, self.wish, kp, tp, self.off, self.of_feed = numbers
        self.ends, self.rates = plant.mv_ends(), [s.max_move for s in plant.mv]
        low, high = self.ends
        self.limit = plant.range_of(2)[1]
        self.thick, self.level, self.pressure = (
            Pi(k, t, low[i], high[i]) for k, t, i in ((kx, tx, 1), (-kl, tl, 2), (kp, tp, 0))
        )

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        feed = self.pressure(self.limit - self.off, pv[2], mv[0])
        feed = float(np.clip(feed, mv[0] - self.rates[0], mv[0] + self.rates[0]))
        steam = self.thick(sp[0], pv[0], mv[1]) + self.of_feed * (feed - mv[0])
        product = self.level(min(self.wish, 100.0), pv[1], mv[2])
        return limited(mv, np.array([feed, steam, product]), *self.ends, self.rates)


EVAPORATOR = OperatedPlant(
    name="evaporator",
    title="Evaporator: as much feed as the condenser takes, a level in a band",
    pv=(Signal("XI", "%", 0.0, 80.0), Signal("LI", "%", 0.0, 100.0), Signal("PI", "kPa", 0.0, 120.0)),
    sp=(Signal("XI", "%", 25.0, 35.0),),
    mv=tuple(Signal(n, "%", 0.0, 100.0, max_move=m) for n, m in (("feed", 4.0), ("steam", 5.0), ("product", 4.0))),
    noise=(0.15, 0.5, 0.3),
    rhs=_evaporator,
    output=lambda x: [x[1], x[0], x[2]],
    x0=(50.0, 30.0, 51.5),
    mv0=(50.0, 50.0, 15.0),
    operate={"LI.low": 25.0, "LI.high": 80.0, "PI.high": 60.0, "feed.high": 85.0, "feed.cost": -1.0, "steam.cost": 0.4},
    moves=((0.0, 0.0), (42.0, 64.0), (11.0, 20.0)),
    held=(Held(0, 1, -0.5, 35.0, 75.0, 0.0, ((1, 0.7), (2, 1.0)), (2, 7)),),
    sp_steps=(Steps(27.0, 33.0, 80, 160),),
    dv=(Signal("water", "degC", 0.0, 40.0),),
    dv_steps=(Steps(16.0, 24.0, 60, 140),),
    wanders=(Wandering(0.0, 0.25, 40.0), Wandering(0.0, 1.5, 30.0)),
    scheme=EvaporatorScheme,
    settings={
        "Kc X": 1.5, "Ti X": 8.0, "Kc level": 0.3, "Ti level": 30.0, "wish level": 55.0,
        "Kc P": 0.8, "Ti P": 15.0, "back-off P": 1.5, "of feed": 1.0,
    },
)  # fmt: skip
