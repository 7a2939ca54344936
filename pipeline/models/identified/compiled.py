"""Loops over the rows of a record, compiled: each row needs the one before, so that no array operation spans them."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

from loopwright.pipeline.plants.simulator import Array

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function, compiled by numba at its first call and kept on disk for later ones.

    numba is imported then: it takes a second, which no other command should wait for.
    """
    machine_code: list[Callable[P, R]] = []

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not machine_code:
            from numba import njit

            machine_code.append(njit(cache=True)(function))
        return machine_code[0](*args, **kwargs)

    return call


@compiled
def run_rows(
    matrix: Array,
    w2: Array,
    drive: Array,
    y: Array,
    correction: float,
    gain: Array,
    x: Array,
    limit: float,
    before: Array,
    after: Array,
) -> bool:
    """A free run, written into ``before`` and ``after`` (n, n_x); False where a state exceeds ``limit``.

        z(k) = matrix x'(k) + drive(k),   x(k+1) = z[:n_x] + W2 tanh(z[n_x:])

    ``matrix`` (n_x + n_h, n_x), ``drive`` (n, n_x + n_h). x' is x, its outputs corrected by ``correction`` (y - x), all
    states by ``gain`` (y - x) where there is a gain (n_x, n_y), else (n_x, 0).
    """
    n_x = matrix.shape[1]
    n_h = matrix.shape[0] - n_x
    n_y = y.shape[1]
    x = x.copy()
    hidden, corrects = np.empty(n_h), gain.shape[1] > 0
    for k in range(len(drive)):
        for i in range(n_x):
            if not abs(x[i]) < limit:
                return False
            before[k, i] = x[i]
        if correction != 0.0:
            for i in range(n_y):
                x[i] += correction * (y[k, i] - x[i])
        if corrects:
            for i in range(n_x):
                for j in range(n_y):
                    x[i] += gain[i, j] * (y[k, j] - before[k, j])
        for i in range(n_x):
            after[k, i] = x[i]
        for h in range(n_h):
            total = drive[k, n_x + h]
            for j in range(n_x):
                total += matrix[n_x + h, j] * after[k, j]
            hidden[h] = np.tanh(total)
        for i in range(n_x):
            total = drive[k, i]
            for j in range(n_x):
                total += matrix[i, j] * after[k, j]
            for h in range(n_h):
                total += w2[i, h] * hidden[h]
            x[i] = total
    return True


@compiled
def propagate(
    a: Array,
    w1: Array,
    w2: Array,
    z: Array,
    t: Array,
    keep: float,
    gain: Array,
    e: Array,
    parameters: bool,
    s: Array,
    jac: Array,
) -> None:
    """Sensitivities of the outputs in m rows, written into ``jac`` (m, n_y, P + n_x); ``s`` (n_x, P + n_x) goes on.

        S(k+1) = dF/dx S'(k) + dF/dtheta(k),   S' = S but for the outputs: keep S[:n_y]

    With a ``gain`` L (n_x, n_y) and the innovations ``e`` (m, n_y), S' = S - L S[:n_y] + dL/dtheta e; else (n_x, 0).

    ``z`` (m, n_x + n_v) holds the states and inputs of the rows, ``t`` (m, n_h) the tanh units there. The columns are
    the parameters in the order of ``Dynamics.vector`` (none without ``parameters``), then the initial state.
    """
    n_x, n_h, n_z = len(a), w1.shape[0], z.shape[1]
    n_v, width, n_y = n_z - n_x, s.shape[1], jac.shape[1]
    of_b = n_x * n_x
    of_c = of_b + n_x * n_v
    of_w1 = of_c + n_x
    of_b1 = of_w1 + n_h * n_z
    of_w2 = of_b1 + n_h
    of_gain = of_w2 + n_x * n_h
    slope, ahead = np.empty((n_x, n_x)), np.empty((n_x, width))
    for k in range(len(z)):
        for i in range(n_y):
            for c in range(width):
                jac[k, i, c] = s[i, c]
        for j in range(gain.shape[1]):
            for i in range(n_x):
                for c in range(width):
                    s[i, c] -= gain[i, j] * jac[k, j, c]
                if parameters:
                    s[i, of_gain + i * n_y + j] += e[k, j]
        for i in range(n_x):
            for j in range(n_x):
                total = a[i, j]
                for h in range(n_h):
                    total += w2[i, h] * (1 - t[k, h] * t[k, h]) * w1[h, j]
                slope[i, j] = total * keep if j < n_y else total
        for i in range(n_x):
            for c in range(width):
                ahead[i, c] = 0.0
            for j in range(n_x):
                factor = slope[i, j]
                for c in range(width):
                    ahead[i, c] += factor * s[j, c]
            if parameters:
                for j in range(n_x):
                    ahead[i, i * n_x + j] += z[k, j]
                for j in range(n_v):
                    ahead[i, of_b + i * n_v + j] += z[k, n_x + j]
                ahead[i, of_c + i] += 1.0
                for h in range(n_h):
                    through = w2[i, h] * (1 - t[k, h] * t[k, h])
                    for j in range(n_z):
                        ahead[i, of_w1 + h * n_z + j] += through * z[k, j]
                    ahead[i, of_b1 + h] += through
                    ahead[i, of_w2 + i * n_h + h] += t[k, h]
        for i in range(n_x):
            for c in range(width):
                s[i, c] = ahead[i, c]


@compiled
def hold_inputs(
    a: Array, w1: Array, w2: Array, drive: Array, lift: Array, periods: int, x: Array, moved: Array
) -> None:
    """Runs of n models side by side under constant inputs: ``x`` (n, n_x) goes on by ``periods``.

    ``drive`` (n, n_x) is B v + c, ``lift`` (n, n_h) W1 v + b1; ``moved`` (n,) receives the largest change of a state
    in the last period.
    """
    n_x, n_h = len(a), w1.shape[0]
    ahead, hidden = np.empty(n_x), np.empty(n_h)
    for run in range(len(x)):
        for _ in range(periods):
            for h in range(n_h):
                total = lift[run, h]
                for j in range(n_x):
                    total += w1[h, j] * x[run, j]
                hidden[h] = np.tanh(total)
            moved[run] = 0.0
            for i in range(n_x):
                total = drive[run, i]
                for j in range(n_x):
                    total += a[i, j] * x[run, j]
                for h in range(n_h):
                    total += w2[i, h] * hidden[h]
                ahead[i] = total
            for i in range(n_x):
                change = abs(ahead[i] - x[run, i])
                moved[run] = max(moved[run], change) if change == change else np.inf
                x[run, i] = ahead[i]
