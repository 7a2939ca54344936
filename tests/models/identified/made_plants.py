"""Small plants with known truth for the tests of identification: their records, gains and noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal


def signals_of(n_y: int, n_mv: int, n_dv: int = 0) -> Signals:
    pv = tuple(Signal(f"y{i}", "degC", -100.0, 200.0) for i in range(n_y))
    mv = tuple(Signal(f"u{i}", "%", 0.0, 100.0) for i in range(n_mv))
    dv = tuple(Signal(f"d{i}", "kg/s", -10.0, 10.0) for i in range(n_dv))
    return Signals(2.0, pv, pv, dv, mv)


def random_holds(rng: np.random.Generator, n: int, hold: int, low: float = 10.0, high: float = 90.0) -> np.ndarray:
    moves = np.empty(n)
    k = 0
    while k < n:
        m = int(rng.integers(hold // 2, 2 * hold))
        moves[k : k + m] = rng.uniform(low, high)
        k += m
    return moves


def second_order(n: int = 1500, delay: int = 4, noise: float = 0.1, seed: int = 0, runs: int = 1) -> Record:
    """y = 20 + G(q) u: poles .9 and .7, steady gain .5, ``delay`` extra periods, white noise."""
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(runs), -(-n // runs))[:n]
    u = random_holds(rng, n, 20)
    y = np.empty(n)
    x1 = x2 = late = 0.0
    for k in range(n):
        first = k == 0 or run[k] != run[k - 1]
        if first:
            x1 = x2 = u[k]
            begin = k
        y[k] = 20 + 0.5 * x2 + noise * rng.normal()
        late = u[max(k - delay, begin)]
        x1, x2 = 0.9 * x1 + 0.1 * late, 0.7 * x2 + 0.3 * x1
    return Record.of(signals_of(1, 1), y[:, None], u[:, None], run=run)


def two_by_two(n: int = 2000, noise: float = 0.1, seed: int = 0, measured: bool = False) -> Record:
    """Gains [[.5, -.3], [.2, .6]] through first orders; with ``measured`` a disturbance of gain (2, -1) too."""
    rng = np.random.default_rng(seed)
    u = np.column_stack([random_holds(rng, n, 20) for _ in range(2)])
    d = np.column_stack([random_holds(rng, n, 30, -3, 3)]) if measured else np.zeros((n, 0))
    gain, of_d = np.array([[0.5, -0.3], [0.2, 0.6]]), np.array([[2.0], [-1.0]])
    x, w = u[0] @ gain.T, d[0] @ of_d.T if measured else np.zeros(2)
    y = np.empty((n, 2))
    for k in range(n):
        y[k] = x + w + noise * rng.normal(size=2)
        x = x + np.array([0.1, 0.2]) * (gain @ u[k] - x)
        if measured:
            w = w + 0.15 * (of_d @ d[k] - w)
    return Record.of(signals_of(2, 2, int(measured)), y, u, dv=d)


def curve(u: float) -> float:
    """The steady output of ``hammerstein``; its slope is .1 + .009 u."""
    return 0.1 * u + 0.0045 * u**2


def hammerstein(
    n: int = 2000,
    noise: float = 0.1,
    seed: int = 0,
    quiet: int = 0,
    at: float = 25.0,
    steady: Callable[[float], float] = curve,
) -> Record:
    """A static curve before a second-order lag: the gain is .1 at the low end and 1 at the high one.

    The input rests ``at`` one value in the last ``quiet`` rows. ``steady`` is another curve.
    """
    rng = np.random.default_rng(seed)
    u = random_holds(rng, n, 20)
    u[n - quiet :] = at
    x1 = x2 = steady(u[0])
    y = np.empty(n)
    for k in range(n):
        y[k] = x2 + noise * rng.normal()
        x1, x2 = x1 + 0.2 * (steady(u[k]) - x1), x2 + 0.3 * (x1 - x2)
    return Record.of(signals_of(1, 1), y[:, None], u[:, None])


def integrator(n: int = 2000, noise: float = 0.1, seed: int = 0) -> Record:
    """A level: y+ = y + .05 (w - 50), w a lag of u; a slow proportional hand keeps it in its range."""
    rng = np.random.default_rng(seed)
    push = random_holds(rng, n, 10, -30, 30)
    y, u = np.empty(n), np.empty(n)
    level, w = 50.0, 50.0
    for k in range(n):
        y[k] = level + noise * rng.normal()
        u[k] = np.clip(50 + push[k] - 1.0 * (y[k] - 50), 0, 100)
        level, w = level + 0.05 * (w - 50), w + 0.5 * (u[k] - w)
    return Record.of(signals_of(1, 1), y[:, None], u[:, None])


def closed_loop(n: int = 3000, noise: float = 0.1, seed: int = 0) -> Record:
    """A lag of gain .8 under a PI controller whose set point moves."""
    rng = np.random.default_rng(seed)
    sp = random_holds(rng, n, 40, 20, 60)
    y, u = np.empty(n), np.empty(n)
    x, total = 40.0, 50.0
    for k in range(n):
        y[k] = x + noise * rng.normal()
        e = sp[k] - y[k]
        total = np.clip(total + 0.12 * e, 0, 100)
        u[k] = np.clip(total + 0.8 * e, 0, 100)
        x = x + 0.1 * (0.8 * u[k] - x)
    return Record.of(signals_of(1, 1), y[:, None], u[:, None])
