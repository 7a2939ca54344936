"""Many plants of one kind side by side, each with its own parameters and measured disturbances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.identified import IdentifiedPlant, StateEquation
from loopwright.pipeline.plants.simulator import Array, Simulator

AdvanceRows = Callable[[Array, Array, Array, Array], Array]
"""``advance(x (n, n_x), mv (n, n_mv), dv (n, n_dv), p (n, n_p)) -> x (n, n_x)`` one period later."""


def advance_rows(plant: Simulator, n: int) -> AdvanceRows:
    """``plant.step`` of ``n`` rows. A row's numbers do not depend on the other rows, nor on how many there are."""
    if isinstance(plant, EquationPlant):
        return _equations(plant, n)
    if isinstance(plant, IdentifiedPlant):
        return lambda x, mv, dv, p: _identified(plant, x, mv, dv, p)

    def one_by_one(x: Array, mv: Array, dv: Array, p: Array) -> Array:
        return np.array([plant.step(*row) for row in zip(x, mv, dv, p, strict=True)], dtype=np.float64)

    return one_by_one


def _equations(plant: EquationPlant, n: int) -> AdvanceRows:
    batch = plant.transition.map(n)

    def advance(x: Array, mv: Array, dv: Array, p: Array) -> Array:
        return np.array(batch(x.T, mv.T, dv.T, p.T)).T

    return advance


def _identified(plant: IdentifiedPlant, x: Array, mv: Array, dv: Array, p: Array) -> Array:
    """``IdentifiedPlant.step`` with parameters of each row."""
    f, m, n, most = plant.arrays, plant.n_mv, len(plant.arrays.a), plant.most_dead_time
    v0 = plant.start_inputs[:m]
    gain, tau, dead, load = p[:, :m], p[:, m : m + 1], p[:, m + 1], p[:, m + 2 :]
    v = (np.concatenate([mv, dv], axis=1) - f.v_center) / f.v_scale
    held = np.concatenate([v[:, :m], x[:, n:]], axis=1)
    whole = np.minimum(dead.astype(np.int64), most)
    part = (np.minimum(dead, most) - whole)[:, None]
    newest, after = whole[:, None] * m + np.arange(m), np.minimum(whole + 1, most)[:, None] * m + np.arange(m)
    acting = (1 - part) * np.take_along_axis(held, newest, axis=1) + part * np.take_along_axis(held, after, axis=1)
    inputs = np.concatenate([v0 + gain * (acting - v0), v[:, m:]], axis=1)
    now = x[:, :n]
    ahead = _advanced(f, now, inputs)
    slow = now + (ahead - now) / np.maximum(tau, 1.0)
    second = _advanced(f, np.where(plant.remembers, now, ahead), inputs)
    fast = ahead + (1 / np.minimum(tau, 1.0) - 1) * (second - ahead)
    ahead = np.where(plant.remembers | (tau == 1.0), ahead, np.where(tau > 1.0, slow, fast))
    ahead[:, : load.shape[1]] += load / f.y_scale
    return np.concatenate([ahead, held[:, : most * m]], axis=1)


def _advanced(f: StateEquation, x: Array, v: Array) -> Array:
    """``f.advance`` whose sums have one order: a library's product rounds a row by how many rows there are."""
    z = np.concatenate([x, v], axis=1)
    found = _product(z, np.concatenate([f.a, f.b], axis=1)) + f.c
    return found + _product(np.tanh(_product(z, f.w1) + f.b1), f.w2) if len(f.w1) else found


def _product(x: Array, weights: Array) -> Array:
    """``x @ weights.T``, summed from the first column on."""
    total = np.zeros((len(x), len(weights)))
    for j in range(x.shape[1]):
        total += x[:, j, None] * weights[:, j]
    return total
