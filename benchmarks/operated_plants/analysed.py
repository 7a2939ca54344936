"""A column with one analyser and a reactor with two: seldom, late, and now and then without a result."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from operated_plant import OperatedPlant, Steps, Wandering

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

# ---------------------------------------------------------------------------------------------------------- the column
EVERY, LATE = 20, 5  # samples between results of its analyser, and by which they are late
GAIN = np.array([[0.50, -0.20], [0.030, 0.045], [0.010, 0.025]])  # of TI [degC], AI [%], PI [bar], to two valves [%]
LAG = np.array([[12.0, 16.0], [20.0, 14.0], [6.0, 8.0]])  # samples
FAST = 0.3  # of the second lag, over the first
MIDDLE = np.array([120.0, 4.0, 2.5])  # at 50 % and 50 %
NOISE = np.array([0.15, 0.02, 0.008])


def _column(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """Two lags in a row between each valve and each output; loads push at the valves."""
    lag = LAG.ravel().tolist()
    into = [u[j] + w[j] - 50.0 for _ in MIDDLE for j in range(2)]
    first = [(into[i] - x[i]) / (FAST * lag[i]) for i in range(6)]
    return [*first, *((x[i] - x[6 + i]) / lag[i] for i in range(6))]


def _column_shown(x: Any) -> list[Any]:
    return [MIDDLE[o] + GAIN[o, 0] * x[6 + 2 * o] + GAIN[o, 1] * x[7 + 2 * o] for o in range(3)]


def unschemed(plant: OperatedPlant, numbers: Array) -> Any:
    """No PIDs are built for these plants: a PID winds up on a number that stands."""
    raise NotImplementedError(f"{plant.name} has no scheme of PIDs")


DISTILLATION = OperatedPlant(
    name="distillation",
    title="Column: an analyser every 20 samples and 5 late, one result in ten missing",
    pv=(Signal("TI", "degC", 80.0, 160.0), Signal("AI", "%", 0.0, 8.0), Signal("PI", "bar", 0.0, 6.0)),
    sp=(Signal("TI", "degC", 110.0, 130.0), Signal("AI", "%", 3.0, 5.0)),
    mv=tuple(Signal(n, "%", 0.0, 100.0, max_move=10.0) for n in ("reflux", "steam")),
    noise=tuple(NOISE.tolist()),
    rhs=_column,
    output=_column_shown,
    x0=(0.0,) * 12,
    mv0=(50.0, 50.0),
    operate={},
    moves=((30.0, 70.0), (30.0, 70.0)),
    hold=(15, 90),
    sp_steps=(Steps(116.0, 124.0, 60, 180), Steps(3.6, 4.4, 120, 240)),
    wanders=(Wandering(0.0, 3.0, 60.0), Wandering(0.0, 3.0, 60.0)),
    late={1: LATE},
    every={1: EVERY},
    missing={1: 0.1},
    scheme=unschemed,
    settings={},
)

# --------------------------------------------------------------------------------------------------------- the reactor
VOLUME, FEED_HOT, REACTION_HEAT, JACKET = 50.0, 340.0, 10.0, 0.1  # l, K, K l/mol, 1/sample
RATES, BARRIERS, USUAL = (1 / 20, 1 / 40), (6_000.0, 9_000.0), 345.0  # 1/sample at the usual temperature [K], K


def _series(x: Any, u: Any, d: Any, w: Any) -> list[Any]:
    """A -> B -> C in a stirred tank: concentrations of all three [mol/l], and the temperature [K].

    ``u`` is the feed [%] and the jacket's temperature [K], ``w`` the feed's concentration and what the jacket is off.
    """
    a, b, c, hot = (x[i] for i in range(4))
    swept = 0.1 * u[0] / VOLUME
    rates = [k * ca.exp(-e * (1 / hot - 1 / USUAL)) for k, e in zip(RATES, BARRIERS, strict=True)]
    return [
        swept * (w[0] - a) - rates[0] * a,
        -swept * b + rates[0] * a - rates[1] * b,
        -swept * c + rates[1] * b,
        swept * (FEED_HOT - hot) + REACTION_HEAT * rates[0] * a + JACKET * (u[1] + w[1] - hot),
    ]


SERIES = OperatedPlant(
    name="series",
    title="Reactor A -> B -> C: B every 15 samples and 4 late, C every 40 and 12 late; one in ten, one in six missing",
    pv=(Signal("TI", "K", 320.0, 370.0), Signal("B", "mol/l", 0.0, 2.0), Signal("C", "mol/l", 0.0, 1.0)),
    sp=(Signal("TI", "K", 335.0, 355.0), Signal("B", "mol/l", 0.4, 0.7)),
    mv=(Signal("feed", "%", 10.0, 100.0, max_move=10.0), Signal("jacket", "K", 320.0, 370.0, max_move=4.0)),
    noise=(0.1, 0.004, 0.002),
    rhs=_series,
    output=lambda x: [x[3], x[1], x[2]],
    x0=(1.3, 0.53, 0.13, 345.0),
    mv0=(50.0, 345.0),
    operate={},
    moves=((35.0, 70.0), (337.0, 353.0)),
    hold=(12, 90),
    sp_steps=(Steps(341.0, 349.0, 60, 180), Steps(0.5, 0.6, 120, 240)),
    wanders=(Wandering(2.0, 0.04, 80.0), Wandering(0.0, 0.5, 40.0)),
    late={1: 4, 2: 12},
    every={1: 15, 2: 40},
    missing={1: 0.1, 2: 1 / 6},
    scheme=unschemed,
    settings={},
)
