"""Records of loops in operation: a PI controller with feedback, loads that nobody measures, few moves. Not a test.

The sign of each plant is known, so that a test can ask whether a record, or a model of it, finds it.
``python tests/closed_loop_records.py SEED`` fits linear models to 20 such records of 2,400 rows, and prints of each
what was true, what the model says, and whether it is proven.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal

Array = np.ndarray
PV, MV = Signal("y", "degC", 0.0, 100.0), Signal("u", "%", 0.0, 100.0)
SIGNALS = Signals(1.0, (PV,), (PV,), (), (MV,))
MIDDLE = 50.0


@dataclass(frozen=True)
class OperatedLoop:
    """One loop: a plant of lags behind a dead time, its PI controller, and what moves it.

    ``gain`` in degC/%, of a level in degC/% a row; ``lags`` and ``wander`` in rows. ``kc`` is the size of the
    controller's gain [%/degC], ``ti`` its integral time [rows]. Every ``hold`` rows (0: never) the set point moves by
    up to ``sp`` either way; ``dither`` [%] is added to the MV at random, held for ``dither_rows``. ``load`` [%] is the
    standard deviation of a slow load at the MV.
    """

    gain: float
    lags: tuple[float, ...] = (10.0,)
    dead: int = 1
    level: bool = False
    kc: float = 1.0
    ti: float = 15.0
    hold: int = 0
    sp: float = 8.0
    load: float = 4.0
    wander: float = 60.0
    noise: float = 0.1
    dither: float = 0.0
    dither_rows: int = 12

    def rows(self, n: int, seed: int) -> tuple[Array, Array, Array]:
        """(PV, MV held over [k, k + 1), set point), (n,) each."""
        rng = np.random.default_rng(seed)
        noise, load = rng.normal(0, self.noise, n), self.load * _wandering(n, self.wander, rng)
        sp = MIDDLE + (_levels(n, self.hold, self.sp, rng) if self.hold else np.zeros(n))
        extra = _levels(n, self.dither_rows, self.dither, rng) if self.dither else np.zeros(n)
        y, u, plant, way = np.empty(n), np.empty(n), self._plant(), np.sign(self.gain)
        integral = 0.0
        for k in range(n):
            y[k] = MIDDLE + plant.y + noise[k]
            error = way * (sp[k] - y[k])
            asked = integral + self.kc * error + self.kc / self.ti * error
            u[k] = np.clip(MIDDLE + asked + extra[k], MV.low, MV.high)
            integral = np.clip(integral + self.kc / self.ti * error, -MIDDLE, MIDDLE)
            plant.push(float(u[k] - MIDDLE + load[k]))
        return y, u, sp

    def answer(self, u: Array) -> Array:
        """The plant alone, without noise: y (n,) at each row, from rest, under distances u (n,) of the MV."""
        plant, y = self._plant(), np.empty(len(u))
        for k, v in enumerate(u):
            y[k] = plant.y
            plant.push(float(v))
        return y

    def _plant(self) -> _Lags:
        return _Lags(self.gain, self.lags, self.dead, self.level)

    def record(self, n: int = 2_400, seed: int = 0, late: bool = False) -> Record:
        """The rows as a record; ``late``: the MV of a row is the one that acted before it."""
        y, u, _ = self.rows(n, seed)
        if late:
            u = np.r_[MIDDLE, u[:-1]]
        return Record.of(SIGNALS, y[:, None], u[:, None])


class _Lags:
    """Lags behind a dead time, about their rest."""

    def __init__(self, gain: float, lags: tuple[float, ...], dead: int, level: bool) -> None:
        self.gain, self.level = gain, level
        self.shares = [1 - float(np.exp(-1 / lag)) for lag in lags]
        self.x, self.late, self.y = [0.0] * len(lags), [0.0] * dead, 0.0

    def push(self, u: float) -> None:
        """One row further under the input u."""
        self.late.append(u)
        v = self.late.pop(0)
        for i, share in enumerate(self.shares):
            self.x[i] += share * (v - self.x[i])
            v = self.x[i]
        self.y = self.y + self.gain * v if self.level else self.gain * v


def _wandering(n: int, rows: float, rng: np.random.Generator) -> Array:
    """Slow motion (n,) of standard deviation 1 that forgets itself within some rows."""
    keep = np.exp(-1 / rows)
    w, out = rng.normal(0, np.sqrt(1 - keep**2), n), np.empty(n)
    state = rng.normal()
    for k in range(n):
        state = keep * state + w[k]
        out[k] = state
    return out


def _levels(n: int, hold: int, size: float, rng: np.random.Generator) -> Array:
    """Random levels (n,) within +-size, held for half of ``hold`` to one and a half times as long."""
    out, k = np.empty(n), 0
    while k < n:
        rows = int(rng.integers(hold // 2, hold + hold // 2 + 1))
        out[k : k + rows], k = rng.uniform(-size, size), k + rows
    return out


LOOPS = {
    "oscillates, set point at rest": OperatedLoop(2.0, dead=3, kc=2.0, ti=10.0),
    "the same, reversed": OperatedLoop(-2.0, dead=3, kc=1.6, ti=8.0),
    "calm, set point at rest": OperatedLoop(2.0, dead=3, kc=0.5, ti=10.0),
    "oscillates, few set points": OperatedLoop(2.0, dead=3, kc=1.6, ti=10.0, hold=600, sp=4.0),
    "the same, reversed, nearly unstable": OperatedLoop(-2.0, dead=3, kc=1.9, ti=10.0, hold=600, sp=4.0),
    "calm, many set points": OperatedLoop(-2.0, dead=3, kc=0.5, ti=10.0, hold=100),
    "oscillates, set points": OperatedLoop(2.0, dead=3, kc=1.6, ti=10.0, hold=200),
    "dead time, set points": OperatedLoop(2.0, dead=15, kc=0.25, ti=10.0, hold=200),
    "dead time, set point at rest": OperatedLoop(-2.0, dead=15, kc=0.25, ti=10.0),
    "level, set points": OperatedLoop(-0.1, (3.0,), 2, level=True, kc=1.0, ti=40.0, hold=200),
    "level, set point at rest": OperatedLoop(0.1, (3.0,), 2, level=True, kc=1.0, ti=40.0),
    "small steps by hand": OperatedLoop(2.0, dead=3, kc=0.5, ti=10.0, dither=2.0),
    "two lags, set points": OperatedLoop(-1.0, (30.0, 15.0), 2, kc=1.5, ti=30.0, hold=300),
    "fast, set point at rest": OperatedLoop(1.0, (1.0,), 0, kc=0.3, ti=2.0),
    "fast, set points": OperatedLoop(1.0, (1.0,), 0, kc=0.3, ti=2.0, hold=60),
    "large loads, few set points": OperatedLoop(-1.5, (20.0,), 4, kc=1.0, ti=20.0, hold=400, sp=5.0, load=8.0),
    "small loads, many set points": OperatedLoop(1.2, (15.0, 5.0), 2, kc=0.8, ti=15.0, hold=60, load=0.3),
    "the same, of the other sign": OperatedLoop(-1.2, (15.0, 5.0), 2, kc=0.8, ti=15.0, hold=60, load=0.3),
    "level, small loads": OperatedLoop(0.1, (3.0,), 2, level=True, kc=0.8, ti=60.0, hold=80, load=0.3),
    "steps by hand, small loads": OperatedLoop(-2.0, dead=3, kc=0.5, ti=10.0, dither=6.0, load=0.5),
}


def show(seed: int) -> None:
    """A row a loop."""
    from loopwright.pipeline.evaluation.proof import statements  # here, because torch takes seconds to load
    from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
    from loopwright.pipeline.models.part import Source

    print("| record | true gain | fit | sign found | one-step predictions | verdict | proven |")
    print("|---" * 7 + "|")
    for name, loop in LOOPS.items():
        learnt = IdentifiedPart(minutes=0.5, units=()).learn(Source(loop.record(2_400, seed), SIGNALS))
        found = learnt.metrics["proof"]["answers"]["y"]["u"]
        fit = learnt.metrics["outputs"]["y"]["fit_percent"]
        sets = {"": {"parts": {"identified": {"kind": "identified", "per_seed": {"0": learnt.metrics}}}}}
        proven = all(row.holds for row in statements(sets))
        sign = "right" if found["model"] * loop.gain > 0 else "wrong"
        direct = f"{found['direct']:.2g} ± {found['sd']:.1g}"
        row = (name, f"{loop.gain:+g}", f"{fit:.0f} %", sign, direct, found["verdict"], "yes" if proven else "no")
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    show(int(sys.argv[1]))
