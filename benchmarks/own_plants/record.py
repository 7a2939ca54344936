"""The record of a plant: an operator's steps, an operator who holds a level, or set points under a PI controller."""

from __future__ import annotations

import numpy as np
from plant import OwnPlant

from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record


def record_of(plant: OwnPlant, rows: int, seed: int = 0) -> Record:
    """Rows of measured outputs under random moves, with measurement noise; the same seed gives the same rows."""
    rng = np.random.default_rng(seed)
    n_mv = len(plant.mv_signals)
    course = np.tile(plant.parameters(), (rows, 1))
    for name, values in plant.drift(rows, rng).items():
        course[:, plant.parameter_names().index(name)] = values
    moves = np.column_stack([_holds(plant, rows, rng) for _ in range(n_mv)])  # 0 to 1
    step, (x, mv0) = plant.stepper(), plant.start
    noise = plant.noise_std * rng.standard_normal((rows, len(plant.pv_signals)))
    pv, mv = np.empty_like(noise), np.empty((rows, n_mv))
    hand = {"steps": _Steps, "operator": _Operator, "closed loop": _ClosedLoop}[plant.hand](plant, mv0)
    for k in range(rows):
        pv[k] = plant.measure(x) + noise[k]
        mv[k] = hand(pv[k], moves[k])
        x = step(x, mv[k], plant.dv_nominal, course[k])
    return Record.of(plant.signals, pv, mv)


def _holds(plant: OwnPlant, rows: int, rng: np.random.Generator) -> Array:
    """Random levels (rows,) within 0 and 1, held for a random time each."""
    levels: list[float] = []
    while len(levels) < rows:
        levels += [rng.uniform()] * int(rng.integers(plant.moves[0], plant.moves[1] + 1))
    return np.array(levels[:rows])


class _Steps:
    """Steps over the MVs' span."""

    def __init__(self, plant: OwnPlant, mv0: Array) -> None:
        self.span = plant.span

    def __call__(self, pv: Array, level: Array) -> Array:
        return self.span[0] + (self.span[1] - self.span[0]) * level


class _Operator:
    """A look at the PV every so often: the valve goes to where it holds, and as far off as the PV is from a wish."""

    def __init__(self, plant: OwnPlant, mv0: Array) -> None:
        sp = plant.sp_signals[0]
        self.low, self.span, self.mv0, self.mv, self.level = sp.low, sp.high - sp.low, mv0, mv0, np.array([np.nan])

    def __call__(self, pv: Array, level: Array) -> Array:
        if level != self.level:
            self.level = level
            wish = self.low + self.span * level
            self.mv = np.clip(self.mv0 + 0.5 * (wish - pv) + 10 * (np.modf(1e3 * level)[0] - 0.5), 0, 100)
        return self.mv


class _ClosedLoop:
    """A PI controller with random set points."""

    def __init__(self, plant: OwnPlant, mv0: Array) -> None:
        sp = plant.sp_signals[0]
        self.low, self.span, self.mv, self.last = sp.low, sp.high - sp.low, mv0, 0.0

    def __call__(self, pv: Array, level: Array) -> Array:
        error = float(level[0]) - (float(pv[0]) - self.low) / self.span
        self.mv = np.clip(self.mv + 40 * (error - self.last + error / 12), 0, 100)
        self.last = error
        return self.mv
