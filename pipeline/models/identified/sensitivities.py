"""Exact sensitivities of free runs, summed to the equations of a Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pipeline.models.identified.dynamics import Dynamics, Stretch
from pipeline.plants.simulator import Array

CHUNK = 512  # rows whose sensitivities are held at a time


@dataclass(slots=True, eq=False)
class Equations:
    """Sums of a Gauss-Newton step: those of the parameters, and of each stretch's own initial state.

    With J = dy_hat/dtheta and X = dy_hat/dx0: H = J'J, g = J'r, and of each stretch (J'X, X'X, X'r).
    """

    h: Array  # (P, P)
    g: Array  # (P,)
    of_starts: list[tuple[Array, Array, Array]] = field(default_factory=list)

    def solve(self, damping: float, start_damping: float) -> tuple[Array, list[Array]]:
        """The step of the parameters (P,) and of each initial state (n_x,).

        (H + mu I) is reduced by the initial states, of which each touches its own stretch only.
        """
        h, g = self.h + damping * np.eye(len(self.h)), self.g.copy()
        solved = []
        for cross, own, right in self.of_starts:
            factor = linalg.cho_factor(own + start_damping * np.eye(len(own)))
            back, mean = linalg.cho_solve(factor, cross.T), linalg.cho_solve(factor, right)
            solved.append((back, mean))
            h = h - cross @ back
            g = g - cross @ mean
        step = linalg.solve(h, g, assume_a="pos") if len(g) else g
        return step, [mean - back @ step for back, mean in solved]


def sensitivity_sums(
    model: Dynamics, starts: Sequence[Array], data: Sequence[Stretch], free: NDArray[np.bool_], correction: float
) -> Equations | None:
    """The Gauss-Newton sums of the free runs over ``data`` from ``starts``; None where one explodes.

    The sensitivities S = dx/dtheta follow the recursion

        S(k+1) = dF/dx S'(k) + dF/dtheta(x'(k), v(k)),   S' = S but for the outputs: (1 - correction) S[:n_y]

    and those of the initial state the same without the last term.
    """
    n_free, n_x = int(free.sum()), model.n_x
    sums = Equations(np.zeros((n_free, n_free)), np.zeros(n_free))
    columns = np.concatenate([free, np.ones(n_x, dtype=bool)])
    for start, stretch in zip(starts, data, strict=True):
        run = model.free_run(start, stretch, correction)
        if run is None:
            return None
        predicted, from_states = run
        n_y = stretch.y.shape[1]
        own = np.zeros((n_free + n_x, n_free + n_x))
        right = np.zeros(n_free + n_x)
        s = np.concatenate([np.zeros((n_x, n_free)), np.eye(n_x)], axis=1)
        for first in range(0, len(stretch), CHUNK):
            rows = slice(first, first + CHUNK)
            x, v = from_states[rows], stretch.v[rows]
            history = np.concatenate([s[None], _recursion(model, s, x, v, columns, n_y, correction)])
            s = history[-1]
            jac = np.ascontiguousarray(history[:-1, :n_y]).reshape(-1, n_free + n_x)
            own += jac.T @ jac
            right += jac.T @ (stretch.y[rows] - predicted[rows, :n_y]).ravel()
        if not np.all(np.isfinite(own)):
            return None
        sums.h += own[:n_free, :n_free]
        sums.g += right[:n_free]
        sums.of_starts.append((own[:n_free, n_free:], own[n_free:, n_free:], right[n_free:]))
    return sums


def _recursion(
    model: Dynamics, s: Array, x: Array, v: Array, columns: NDArray[np.bool_], n_y: int, correction: float
) -> Array:
    """Sensitivities (m, n_x, P + n_x) after each of m rows, from s before the first."""
    direct = _direct(model, x, v)
    if not columns.all():
        direct = np.ascontiguousarray(direct[:, :, columns])
    slope = model.slopes(x, v)[0]
    if slope.ndim == 2:
        slope = np.broadcast_to(slope, (len(x), *slope.shape))
    if correction:
        slope = slope.copy()
        slope[:, :, :n_y] *= 1 - correction
    with np.errstate(over="ignore", invalid="ignore"):
        for row, f in zip(direct, slope, strict=True):
            row += f @ s
            s = row
    return direct


def _direct(model: Dynamics, x: Array, v: Array) -> Array:
    """dF/d[theta, x0] (m, n_x, P + n_x) at states x (m, n_x) under inputs v (m, n_v), the states held."""
    n_x, n_v, n_h, m = model.n_x, model.n_v, model.n_hidden, len(x)
    sizes = [n_x * n_x, n_x * n_v, n_x, n_h * (n_x + n_v), n_h, n_x * n_h]
    of_a, of_b, of_c, of_w1, of_b1, of_w2 = np.concatenate([[0], np.cumsum(sizes)])[:-1]
    direct = np.zeros((m, n_x, sum(sizes) + n_x))
    for i in range(n_x):
        direct[:, i, of_a + i * n_x : of_a + (i + 1) * n_x] = x
        direct[:, i, of_b + i * n_v : of_b + (i + 1) * n_v] = v
        direct[:, i, of_c + i] = 1.0
    if n_h:
        z = np.concatenate([x, v], axis=1)
        t = np.tanh(z @ model.w1.T + model.b1)
        through = model.w2 * (1 - t * t)[:, None, :]  # (m, n_x, n_h)
        direct[:, :, of_w1:of_b1] = (through[..., None] * z[:, None, None, :]).reshape(m, n_x, -1)
        direct[:, :, of_b1:of_w2] = through
        for i in range(n_x):
            direct[:, i, of_w2 + i * n_h : of_w2 + (i + 1) * n_h] = t
    return direct
