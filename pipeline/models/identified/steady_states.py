"""Rests of an identified model, its state there as a linear map of outputs and inputs, and whether it is stable."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from loopwright.pipeline.dynamics.steady_state import (
    HELD_PERIODS,
    MOST_REST_PERIODS,
    STANDS_STILL,
    STILL_SCALED,
    STILL_WITHIN,
    run_to_rest,
)
from loopwright.pipeline.historian.settling import MOST_PERIODS
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.plants.simulator import Array

INTEGRATES = 0.999
"""Pole of a model beyond which it counts as one that integrates."""

DIRECTION_STEP, DIRECTION_PERIODS = 1e-3, 300
"""Step of an input, scaled, and the periods after it, in which a model that integrates shows which way it goes."""

SOUGHT_RESTS = 200
"""Rows whose rests are sought, which the map is fitted to."""

LOADED_DEVIATION = 0.25
"""Deviation of the outputs, scaled, that loads add to the rests."""


def slowest_pole(model: Dynamics) -> float:
    """The largest magnitude of a pole of a linear model."""
    return float(np.abs(np.linalg.eigvals(model.a)).max())


def settle(
    model: Dynamics, v: Array, start: Array | None = None, periods: int = MOST_REST_PERIODS
) -> tuple[Array, Array]:
    """(states (n, n_x), whether each stands still (n,)) after a free run under constant inputs v (n, n_v)."""
    x = np.zeros((len(v), model.n_x)) if start is None else np.array(start)
    looks = -(-periods // HELD_PERIODS)
    x, moved = run_to_rest(lambda at: model.hold(at, v, HELD_PERIODS), x, looks, STILL_SCALED)
    still = (moved < STANDS_STILL) & (np.abs(x).max(axis=1) < STILL_WITHIN)
    return x, still


def hidden_rest(model: Dynamics, y: Array, v: Array, start: Array) -> Array:
    """States (n, n_x) with outputs y (n, n_y) whose other rows stand still under v (n, n_v), by Newton's method.

    The outputs are held by a load on their own rows. Directions in which the hidden states stand still anywhere
    stay as they are in ``start`` (n, n_x).
    """
    n_y = y.shape[1]
    x = np.concatenate([y, start[:, n_y:]], axis=1)
    if n_y == model.n_x:
        return x
    eye = np.eye(model.n_x - n_y)
    inverse = np.linalg.pinv(eye - model.a[None, n_y:, n_y:], rcond=1e-3)
    for _ in range(8):
        gap = (model.advance(x, v) - x)[:, n_y:]
        if model.n_hidden:  # else the slope is the same everywhere
            slope = np.broadcast_to(model.slopes(x, v)[0], (len(x), model.n_x, model.n_x))[:, n_y:, n_y:]
            inverse = np.linalg.pinv(eye - slope, rcond=1e-3)
        step = np.einsum("nij,nj->ni", np.broadcast_to(inverse, (len(x), *eye.shape)), gap)
        x[:, n_y:] += np.clip(step, -2, 2)
    return x


def rest_map(model: Dynamics, y: Array, v: Array, seed: int) -> tuple[Array, Array]:
    """(map (n_x, n_y + n_v + 1), covariance of its error (n_x, n_x)): x of a rest from [y, v, 1], scaled.

    Least squares over rests at inputs drawn from the rows v (N, n_v): where the model settles by itself, at its
    outputs and at outputs that loads have moved; where it does not (an integrator), at outputs of the rows y (N, n_y).
    Zero, with the covariance of the data, where the model rests nowhere.
    """
    rng = np.random.default_rng(seed)
    rows = rng.integers(len(y), size=SOUGHT_RESTS)
    n_y, chosen = y.shape[1], v[rows]
    x, still = settle(model, chosen)
    moved = LOADED_DEVIATION * rng.normal(size=(SOUGHT_RESTS, n_y)) * (rng.random((SOUGHT_RESTS, 1)) < 0.7)
    at = np.where(still[:, None], x[:, :n_y] + moved, y[rows])
    found = hidden_rest(model, at, chosen, np.where(still[:, None], x, 0.0))
    good = np.all(np.isfinite(found), axis=1) & (np.abs(found).max(axis=1) < 50)
    if not good.any():  # it rests nowhere: a rest may be anywhere among the data, whose variance is 1
        return np.zeros((model.n_x, n_y + v.shape[1] + 1)), np.eye(model.n_x)
    design = np.column_stack([at, chosen, np.ones(SOUGHT_RESTS)])[good]
    weak = 1e-6 * len(design) * np.eye(design.shape[1])
    table = np.linalg.solve(design.T @ design + weak, design.T @ found[good]).T
    error = found[good] - design @ table.T
    covariance = error.T @ error / max(len(error), 1)
    return table, (covariance + covariance.T) / 2


@lru_cache(maxsize=128)
def central_map(model: Dynamics, data: ScaledRecord) -> Array:
    """The map (n_x, n_y + n_v + 1) of ``rest_map`` over the rows of ``data``, for figures of the model.

    Several figures of a model begin with it, so it is made once for each model and record.
    """
    table, _ = rest_map(model, data.y, data.v, 0)
    table.flags.writeable = False
    return table


def steady_gain(model: Dynamics, x: Array, v: Array) -> tuple[Array, Array]:
    """(gains dy/dv (..., n_x, n_v) at rests x (..., n_x) under v (..., n_v), spectral radius there (...,)).

    (I - dF/dx)^-1 dF/dv; only rows of the outputs are of use outside. Not finite at an integrator.
    """
    slope, push = model.slopes(x, v)
    slope = np.broadcast_to(slope, (*x.shape, model.n_x))
    push = np.broadcast_to(push, (*x.shape, model.n_v))
    radius = np.abs(np.linalg.eigvals(slope)).max(axis=-1)
    gap = np.eye(model.n_x) - slope
    singular = np.linalg.cond(gap) > 1e6
    safe = np.where(singular[..., None, None], np.eye(model.n_x), gap)
    gain = np.linalg.solve(safe, push)
    return np.where(singular[..., None, None], np.inf, gain), radius


def middle_rest(model: Dynamics, data: ScaledRecord) -> Array:
    """The state (n_x,) in which the model rests under the median inputs of the data, or is near to it."""
    middle = np.median(data.v, axis=0)
    start = central_map(model, data) @ np.concatenate([np.zeros(data.y.shape[1]), middle, [1.0]])
    x, still = settle(model, middle[None], start[None])
    return x[0] if still[0] else start


def central_gain(model: Dynamics, data: ScaledRecord) -> tuple[Array, bool]:
    """(steady gain (n_y, n_v) under the median inputs of the data, scaled; whether the model integrates there).

    Where it does, what a step of each input has moved after ``DIRECTION_PERIODS`` periods stands in place of the gain.
    """
    n_y, middle, x = data.y.shape[1], np.median(data.v, axis=0), middle_rest(model, data)
    gain, radius = steady_gain(model, x[None], middle[None])
    if radius[0] <= INTEGRATES and np.all(np.isfinite(gain)):
        return gain[0, :n_y], False
    inputs = np.concatenate([middle + DIRECTION_STEP * np.eye(len(middle)), middle[None]])
    ends, _ = model.hold(np.tile(x, (len(inputs), 1)), inputs, DIRECTION_PERIODS)
    return np.asarray((ends[:-1] - ends[-1])[:, :n_y].T / DIRECTION_STEP), True


# --------------------------------------------------------------------- stability over the range that the record visits
POLE_ROWS = 2000
"""Most visited rows at which the local poles are taken."""

STABILITY_RESTS = 60
"""Constant inputs under which it must settle."""

SLOWEST = 0.2 / MOST_PERIODS
"""Distance of the growth a period from 1 of an integrator: as far as a law looks ahead, a fifth is gained or lost."""


def stability_figures(model: Dynamics, states: Sequence[Array], inputs: Sequence[Array]) -> dict[str, Any]:
    """Local and global stability over visited rows: states (n, n_x) under inputs (n, n_v), stretch by stretch.

    ``largest_pole`` and ``median_pole`` of dF/dx over these rows and ``unstable_share``, those beyond 1: a pole
    beyond 1 in passing does no harm. ``growth`` is the mean factor a period by which two nearby runs part along the
    record (the largest Lyapunov exponent's), ``settles`` the share of the record's inputs under which, held constant,
    the model comes to rest. ``stable`` and ``verdict`` judge by the last two, for an integrator by growth alone.
    """
    x, v = np.concatenate(list(states)), np.concatenate(list(inputs))
    places = np.linspace(0, len(x) - 1, min(POLE_ROWS, len(x))).astype(np.int64)
    slopes = np.broadcast_to(model.slopes(x[places], v[places])[0], (len(places), model.n_x, model.n_x))
    radius = np.abs(np.linalg.eigvals(slopes)).max(axis=1)
    growth = _growth(model, states, inputs)
    rows = np.linspace(0, len(v) - 1, STABILITY_RESTS).astype(np.int64)
    settles = float(settle(model, v[rows])[1].mean())
    integrates = abs(growth - 1) < SLOWEST and settles < 1
    stable = integrates or (growth < 1 and settles == 1)
    if integrates:
        words = "integrates: differences between two runs hardly fade or grow as far as a law looks ahead"
    elif stable:
        words = "stable: it settles under every constant input of the record, and nearby runs approach each other"
    elif growth > 1:
        words = f"unstable: nearby runs part by a factor of {growth:.4g} a period along the record"
    else:
        words = f"doubtful: under {1 - settles:.0%} of the record's inputs, held constant, it does not come to rest"
    return {
        "stable": bool(stable),
        "verdict": words,
        "largest_pole": float(radius.max()),
        "median_pole": float(np.median(radius)),
        "unstable_share": float(np.mean(radius > 1)),
        "growth": growth,
        "settles": settles,
    }


def _growth(model: Dynamics, states: Sequence[Array], inputs: Sequence[Array]) -> float:
    """Exp of the mean logarithm of the factor by which a small difference grows a period along the stretches."""
    total, rows = 0.0, 0
    for x, v in zip(states, inputs, strict=True):
        tangent = np.ones(model.n_x) / np.sqrt(model.n_x)
        slopes = np.broadcast_to(model.slopes(x, v)[0], (len(x), model.n_x, model.n_x))
        for slope in slopes:
            tangent = slope @ tangent
            size = float(np.linalg.norm(tangent))
            if not 0 < size < np.inf:
                return 0.0 if size == 0 else float("inf")
            total += np.log(size)
            tangent /= size
        rows += len(x)
    return float(np.exp(total / max(rows, 1)))
