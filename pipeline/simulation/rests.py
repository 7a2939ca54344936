"""Where a sampled plant can be held: its rests under given MVs, and the balance of outputs that never settle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.steady_state import REST_LOOK, RESTING, STILL_STATE, run_to_rest
from loopwright.pipeline.dynamics.step_response import NEVER_SETTLES, late_slope
from loopwright.pipeline.plants.simulator import Array, Simulator

BROKEN = 1e9  # a state beyond it belongs to a plant that runs away
CHANGE = 1e-6  # of a state or of an MV's range: for slopes
REST_ITERATIONS = 12  # iterations
BALANCED = 1e-6  # largest residual of a balance that was found
LOCAL_GAIN_STEP = 0.02  # of an MV's range: for local gains
WEAK_SLOPE = 1e-7  # of the largest slope: a direction in which nothing is decided


def courses(plant: Simulator, x0: Array, mvs: Array, n: int, p: Array | None = None) -> Array:
    """PVs (runs, n + 1, n_pv) from one state x0 (n_x,) under constant mvs (runs, n_mv) and parameters p (n_p,).

    A run that leaves all bounds stays at its last finite state: it never settles, which is what is asked.
    """
    advance = plant.many(len(mvs), p)
    x = np.tile(x0, (len(mvs), 1))
    found = [plant.measured(x)]
    for _ in range(n):
        x = _bounded(x, advance(x, mvs))
        found.append(plant.measured(x))
    return np.stack(found, axis=1)


def settled(plant: Simulator, x0: Array, mvs: Array, p: Array | None = None) -> Array:
    """States (runs, n_x) after at most ``RESTING`` periods from x0 (n_x,) under constant mvs (runs, n_mv)."""
    advance = plant.many(len(mvs), p)

    def hold(x: Array) -> tuple[Array, Array]:
        before = x
        for _ in range(REST_LOOK):
            before, x = x, _bounded(x, advance(x, mvs))
        return x, np.abs(x - before)

    return run_to_rest(hold, np.tile(x0, (len(mvs), 1)), RESTING // REST_LOOK, STILL_STATE, relative=True)[0]


def answered(plant: Simulator, x0: Array, mvs: Array, n: int, p: Array | None = None) -> tuple[Array, Array]:
    """PVs (runs, n_pv) ``n`` periods after a move from x0 to constant mvs (runs, n_mv), and in the end.

    ``n`` are the periods over which the answer is known: a plant that settles has no farther to go, and a model that
    runs away from its record has.
    """
    return courses(plant, x0, mvs, n, p)[:, -1], plant.measured(settled(plant, x0, mvs, p))


def _bounded(before: Array, after: Array) -> Array:
    good = np.all(np.abs(after) < BROKEN, axis=-1, keepdims=True)
    return after if good.all() else np.where(good, after, before)


def local_gains(plant: Simulator, mv: int, places: Array, middle: Array, n_cv: int) -> tuple[Array, NDArray[np.bool_]]:
    """(gains dCV/dMV (n, n_cv), whether each is a rate) of one MV at its ``places`` (n,), the others at ``middle``.

    Central differences of rests. Where a CV does not settle under the two MVs of a difference, its gain is the rate at
    which they part, in CV a period.
    """
    size = LOCAL_GAIN_STEP * (plant.mv_signals[mv].high - plant.mv_signals[mv].low)
    pairs = np.tile(middle, (2, len(places), 1))
    pairs[0, :, mv], pairs[1, :, mv] = places + size, places - size
    y = courses(plant, plant.start[0], pairs.reshape(-1, len(middle)), RESTING)[..., :n_cv]
    apart = (y[: len(places)] - y[len(places) :]) / (2 * size)  # (places, samples, n_cv)
    late = late_slope(np.moveaxis(apart, 1, -1), RESTING // 4 - 1)
    moving = np.abs(late) * RESTING > NEVER_SETTLES * np.abs(apart[:, -1])
    return np.where(moving, late, apart[:, -1]), moving


def balanced(
    plant: Simulator, x: Array, mv: Array, levels: Array, which: Sequence[int], p: Array | None = None
) -> tuple[Array, Array, float]:
    """A rest at which the PVs ``which`` have ``levels`` (len(which),), near a state x (n_x,) and mv (n_mv,).

        x = F(x, mv),   y[which] = levels

    An output that never settles rests at any level, but only under MVs that balance it; these are moved as little as
    Newton's method needs. Returns (x, mv, largest residual in units of the PVs and states). The residual is not small
    where no MV balances the outputs; the MVs may leave their ranges.
    """
    low, high = (np.array([getattr(s, end) for s in plant.mv_signals]) for end in ("low", "high"))
    n_x, span, index = len(x), high - low, list(which)
    x, mv = np.array(x, dtype=np.float64), np.array(mv, dtype=np.float64)
    many = plant.many(n_x + len(mv) + 1, p)
    away = np.inf
    for _ in range(REST_ITERATIONS):
        size = np.concatenate([CHANGE * np.maximum(np.abs(x), 1.0), CHANGE * span])
        z = np.concatenate([x, mv]) + np.vstack([np.zeros(n_x + len(mv)), np.diag(size)])
        gap = np.column_stack([many(z[:, :n_x], z[:, n_x:]) - z[:, :n_x], plant.measured(z[:, :n_x])[:, index]])
        gap[:, n_x:] -= levels
        away = float(np.max(np.abs(gap[0])))
        if not np.isfinite(away) or away < 1e-10:
            break
        slope = ((gap[1:] - gap[0]) / size[:, None]).T
        # MVs count by their range, so that of all balances the nearest one is taken.
        weight = np.concatenate([np.ones(n_x), span])
        step = np.linalg.lstsq(slope * weight, -gap[0], rcond=WEAK_SLOPE)[0] * weight
        x, mv = x + step[:n_x], mv + step[n_x:]
    return x, mv, away


def inside(values: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """The rows (n,) of values (n, m) that lie within [low, high] (m,) in every column."""
    return np.asarray(np.all((values >= low) & (values <= high), axis=-1))
