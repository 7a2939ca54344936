"""Lagged start: an ARX of few lags as a state space, whose states are past outputs and past inputs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.plants.simulator import Array


def lagged_start(data: ScaledRecord, y_lags: int, v_lags: int) -> Dynamics:
    """The least-squares ARX in companion form.

        y(k+1) = sum_{i < y_lags} A_i y(k-i) + sum_{j < v_lags} B_j v(k-j) + c
        x(k) = [y(k), .., y(k - y_lags + 1), v(k-1), .., v(k - v_lags + 1)]

    With tanh units in its output rows this is an NNARX; a fit with correction 1 trains it one step ahead, and one
    that frees all rows goes on from there. Raises ModelError where the data do not determine the coefficients.
    """
    n_y, n_v = data.y.shape[1], data.v.shape[1]
    back = max(y_lags, v_lags) - 1
    k = np.concatenate([np.arange(i + back, j - 1) for i, j in data.bounds() if j - i > back + 1] or [np.zeros(0, int)])
    past_y = [data.y[k - i] for i in range(y_lags)]
    past_v = [data.v[k - i] for i in range(1, v_lags)]
    phi = np.column_stack([*past_y, *past_v, data.v[k], np.ones(len(k))])
    if len(k) < 2 * phi.shape[1]:
        raise ModelError(f"{len(k)} rows are too few for {phi.shape[1]} coefficients; record more samples")
    theta = np.linalg.lstsq(phi, data.y[k + 1], rcond=1e-10)[0].T  # (n_y, n_x + n_v + 1)
    n_x = y_lags * n_y + (v_lags - 1) * n_v
    a, b, c = np.zeros((n_x, n_x)), np.zeros((n_x, n_v)), np.zeros(n_x)
    a[:n_y], b[:n_y], c[:n_y] = theta[:, :n_x], theta[:, n_x:-1], theta[:, -1]
    older = y_lags * n_y
    a[n_y:older, : older - n_y] = np.eye(older - n_y)
    if v_lags > 1:
        b[older : older + n_v] = np.eye(n_v)
        a[older + n_v :, older : n_x - n_v] = np.eye(n_x - n_v - older)
    return Dynamics.linear(a, b, c)


def output_rows(model: Dynamics, n_y: int) -> NDArray[np.bool_]:
    """Mask (P,) of the parameters of an NNARX in companion form: the output rows, and the whole input side."""
    rows = np.arange(model.n_x) < n_y
    return model.mask(a=rows[:, None], b=rows[:, None], c=rows, w1=True, b1=True, w2=rows[:, None])


def with_units(model: Dynamics, states: Array, v: Array, n_hidden: int, seed: int) -> Dynamics:
    """A linear model with ``n_hidden`` tanh units that do nothing yet: W1 drawn, W2 zero.

    W1 is drawn in the space of [x, v] whitened over visited rows, states (N, n_x) under v (N, n_v); deviations
    below 2 % of the largest count as that, so that directions without data draw no steep units.
    """
    rng = np.random.default_rng(seed)
    z = np.hstack([states, v])
    middle = z.mean(axis=0)
    _, spread, rows = np.linalg.svd(z - middle, full_matrices=False)
    spread = np.maximum(spread, 0.02 * spread[0]) / np.sqrt(len(z))
    n_z = z.shape[1]
    directions = rng.normal(size=(n_hidden, n_z))
    directions *= rng.uniform(0.3, 1.5, (n_hidden, 1)) / np.linalg.norm(directions, axis=1, keepdims=True)
    w1 = (directions / spread) @ rows
    b1 = rng.uniform(-1, 1, n_hidden) - w1 @ middle
    return Dynamics(model.a, model.b, model.c, w1, b1, np.zeros((model.n_x, n_hidden)))
