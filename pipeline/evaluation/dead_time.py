"""The dead time of a plant: after how many samples its controlled variables first answer a move of an MV."""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.serving.manifest import Signal

MOVE = 0.1  # of an MV's range
SEEN = 1e-6  # of a controlled variable's range: less is rounding
LONGEST = 200  # samples


def dead_times(plant: Simulator) -> list[int | None]:
    """For each controlled variable the first sample k >= 1 at which it answers a move at sample 0; None within LONGEST.

    The plant is simulated from its start with and without a move of each MV, and the quickest MV counts. A plant
    without dead time answers at k = 1.
    """
    found: list[int | None] = [None] * len(plant.sp_signals)
    for i, signal in enumerate(plant.mv_signals):
        x, mv = plant.start
        moved = np.array(mv, dtype=np.float64)
        moved[i] = _elsewhere(signal, float(mv[i]))
        found = [_sooner(a, b) for a, b in zip(found, _answers(plant, x, mv, moved), strict=True)]
    return found


def _answers(plant: Simulator, x: Array, mv: Array, moved: Array) -> list[int | None]:
    n, step, p = len(plant.sp_signals), plant.stepper(), plant.parameters()
    span = np.array([s.high - s.low for s in plant.pv_signals[:n]])
    found: list[int | None] = [None] * n
    still, other = np.array(x, dtype=np.float64), np.array(x, dtype=np.float64)
    for k in range(1, LONGEST + 1):
        still, other = step(still, mv, plant.dv_nominal, p), step(other, moved, plant.dv_nominal, p)
        off = np.abs(plant.measure(other)[:n] - plant.measure(still)[:n]) / span
        found = [k if a is None and d > SEEN else a for a, d in zip(found, off.tolist(), strict=True)]
        if None not in found:
            break
    return found


def _elsewhere(signal: Signal, value: float) -> float:
    """Another value of the MV: toward the end that is further off, or another allowed one."""
    if signal.values is not None:
        return next((v for v in signal.values if v != value), value)
    move = MOVE * (signal.high - signal.low)
    return value + move if value <= signal.middle else value - move


def _sooner(a: int | None, b: int | None) -> int | None:
    return b if a is None else a if b is None else min(a, b)
