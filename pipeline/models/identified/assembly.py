"""From fitted arrays to the model: dead times become states that remember inputs, scales and noise come inside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.steady_states import central_map, rest_map
from loopwright.pipeline.plants.simulator import Array

ANSWERS = 0.1
"""Share of the fastest change of an output in a step response below which it has not answered yet."""


def remembering(model: Dynamics, delays: Sequence[int]) -> Dynamics:
    """The model whose input j acts ``delays[j]`` periods later: x = [x of the model, past inputs, newest first]."""
    n, n_v, total = model.n_x, model.n_v, int(sum(delays))
    a, b, c = np.zeros((n + total, n + total)), np.zeros((n + total, n_v)), np.zeros(n + total)
    w1, w2 = np.zeros((model.n_hidden, n + total + n_v)), np.zeros((n + total, model.n_hidden))
    a[:n, :n], c[:n], w1[:, :n], w2[:n] = model.a, model.c, model.w1[:, :n], model.w2
    at = n
    for j, d in enumerate(delays):
        if not d:
            b[:n, j], w1[:, n + total + j] = model.b[:, j], model.w1[:, n + j]
            continue
        b[at, j] = 1.0
        a[at + 1 : at + d, at : at + d - 1] = np.eye(d - 1)
        a[:n, at + d - 1], w1[:, at + d - 1] = model.b[:, j], model.w1[:, n + j]
        at += d
    return Dynamics(a, b, c, w1, model.b1, w2)


def noise_of(residuals: Sequence[Array]) -> Array:
    """Standard deviation (n_y,) of the measurement noise from free-run residuals (n, n_y) of each stretch.

    min(sd of the differenced residual / sqrt 2, sd of the residual): what the model misses is mostly slow.
    """
    differenced = np.concatenate([np.diff(r, axis=0) for r in residuals]).std(axis=0) / np.sqrt(2)
    return np.asarray(np.minimum(differenced, np.concatenate(list(residuals)).std(axis=0)))


def assembled(
    model: Dynamics,
    delays: Sequence[int],
    scales: Scales,
    data: ScaledRecord,
    known: Mapping[str, Array],
    n_mv: int,
    seed: int,
) -> Identified:
    """The finished model of fitted ``model`` under inputs late by ``delays`` (n_v,).

    ``known`` are its scaled ``noise`` (n_y,), the noise's ``colour``, the ``load_moves`` (n, n_y) of the record, the
    ``dv_noise`` and ``dv_change`` of its measured disturbances, and what the record leaves open: ``gain_sd``,
    ``pace_sd``, ``dead_sd``.
    """
    whole, n_y, n_v = remembering(model, delays), data.y.shape[1], data.v.shape[1]
    table, covariance = rest_map(model, data.y, data.v, seed)
    n, total = model.n_x, whole.n_x
    rest, rest_cov = np.zeros((total, n_y + n_v + 1)), np.zeros((total, total))
    rest[:n], rest_cov[:n, :n] = table, covariance
    rest[n:, n_y : n_y + n_v] = np.repeat(np.eye(n_v), delays, axis=0)
    config = {"n_y": n_y, "n_mv": n_mv, "n_dv": n_v - n_mv, "n_x": total, "n_hidden": model.n_hidden}
    config["recorded"] = len(known["load_moves"])
    arrays = {
        **{name: getattr(whole, name) for name in ("a", "b", "c", "w1", "b1", "w2")},
        **{name: getattr(scales, name) for name in ("y_center", "y_scale", "v_center", "v_scale")},
        **known,
        "rest": rest,
        "rest_cov": rest_cov,
        "dead": dead_periods(model, data)[:n_mv] + np.asarray(delays[:n_mv], dtype=np.float64),
    }
    return Identified.from_arrays(config, arrays)


def dead_periods(model: Dynamics, data: ScaledRecord, length: int = 60) -> Array:
    """Fewest periods (n_v,) without an answer at any output to a small step of each input, at the centre of the data.

    An answer is a change within one period of more than a tenth of the fastest one over ``length`` periods.
    """
    middle = np.median(data.v, axis=0)
    start = central_map(model, data) @ np.concatenate([np.zeros(data.y.shape[1]), middle, [1.0]])
    size = 0.5 * data.v.std(axis=0)
    response = step_responses(model, start, middle, size, length)[..., : data.y.shape[1]]
    change = np.abs(np.diff(response, axis=1, prepend=0.0))
    answers = change > ANSWERS * change.max(axis=1, keepdims=True)
    return np.asarray(answers.any(axis=2).argmax(axis=1), dtype=np.float64)


def step_responses(model: Dynamics, x: Array, v: Array, size: Array, length: int) -> Array:
    """Changes (n_v, length, n_x) of the free run from x (n_x,) under v (n_v,) by steps of ``size`` (n_v,)."""
    n_v = len(v)
    inputs = np.concatenate([v + np.diag(size), v[None]])
    states = np.tile(x, (n_v + 1, 1))
    found = np.empty((n_v, length, len(x)))
    for k in range(length):
        states = model.advance(states, inputs)
        found[:, k] = states[:-1] - states[-1]
    return found
