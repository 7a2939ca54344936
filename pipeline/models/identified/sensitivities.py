"""Exact sensitivities of free runs, summed to the equations of a Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.linalg import lapack

from loopwright.pipeline.models.identified.compiled import propagate
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.plants.simulator import Array

CHUNK = 256  # rows whose sensitivities are held at a time


@dataclass(slots=True, eq=False)
class Equations:
    """Sums of a Gauss-Newton step: those of the parameters, and of each stretch's own initial state.

    With J = dy_hat/dtheta and X = dy_hat/dx0: H = J'J, g = J'r, and of each stretch (J'X, X'X, X'r).
    """

    h: Array  # (P, P)
    g: Array  # (P,)
    of_starts: list[tuple[Array, Array, Array]] = field(default_factory=list)
    of_blocks: list[Array] = field(default_factory=list)  # (J'r, X'r) of each CHUNK rows

    def solve(self, damping: float, start_damping: float) -> tuple[Array, list[Array]]:
        """The step of the parameters (P,) and of each initial state (n_x,).

        (H + mu I) is reduced by the initial states, of which each touches its own stretch only. The sums are finite,
        see ``sensitivity_sums``: looking at each again takes as long as solving.
        """
        h, g = self.h + damping * np.eye(len(self.h)), self.g.copy()
        solved = []
        for cross, own, right in self.of_starts:
            # LAPACK itself: with a hundred short runs, scipy's checks take longer than the sums that they look at.
            factor, failed = lapack.dpotrf(own + start_damping * np.eye(len(own)), clean=False)
            if failed:
                raise linalg.LinAlgError("the sums of an initial state are not positive definite")
            mean = lapack.dpotrs(factor, right)[0]
            if not len(g):
                solved.append((cross.T, mean))
                continue
            back = lapack.dpotrs(factor, cross.T)[0]
            solved.append((back, mean))
            h = h - cross @ back
            g = g - cross @ mean
        step = linalg.solve(h, g, assume_a="pos", check_finite=False) if len(g) else g
        return step, [mean - back @ step for back, mean in solved]


def sensitivity_sums(
    model: Dynamics, starts: Sequence[Array], data: Sequence[Stretch], free: NDArray[np.bool_], correction: float
) -> Equations | None:
    """The Gauss-Newton sums of the free runs over ``data`` from ``starts``; None where one explodes.

    The sensitivities S = dx/dtheta follow the recursion

        S(k+1) = dF/dx S'(k) + dF/dtheta(x'(k), v(k)),   S' = S but for the outputs: (1 - correction) S[:n_y]

    and those of the initial state the same without the last term; with a filter's gain L, S' = S - L S[:n_y] + dL e.
    """
    n_free, n_x = int(free.sum()), model.n_x
    sums = Equations(np.zeros((n_free, n_free)), np.zeros(n_free))
    columns = np.concatenate([free, np.ones(n_x, dtype=bool)])
    # Another layout in memory would be compiled anew, which takes seconds.
    a, w1, w2 = (np.ascontiguousarray(matrix) for matrix in (model.a, model.w1, model.w2))
    gain, free_run = np.ascontiguousarray(model.filter_gain), model.runner(correction)
    for start, stretch in zip(starts, data, strict=True):
        run = free_run(start, stretch)
        if run is None:
            return None
        predicted, from_states = run
        n_y = stretch.y.shape[1]
        own = np.zeros((n_free + n_x, n_free + n_x))
        blocks: list[Array] = []
        width = (len(free) if n_free else 0) + n_x
        s = np.zeros((n_x, width))
        s[:, -n_x:] = np.eye(n_x)
        for first in range(0, len(stretch), CHUNK):
            rows = slice(first, first + CHUNK)
            z = np.concatenate([from_states[rows], stretch.v[rows]], axis=1)
            history = np.empty((len(z), n_y, width))
            t = np.tanh(z @ model.w1.T + model.b1)
            missed = stretch.y[rows] - predicted[rows, :n_y]
            propagate(a, w1, w2, z, t, 1 - correction, gain, missed, n_free > 0, s, history)
            jac = history.reshape(-1, width)
            if 0 < n_free < len(free):
                jac = jac[:, columns]
            with np.errstate(over="ignore", invalid="ignore"):
                own += jac.T @ jac
                blocks.append(jac.T @ missed.ravel())
        if not np.all(np.isfinite(own)):
            return None
        right = np.sum(blocks, axis=0) if len(blocks) > 1 else blocks[0]
        sums.h += own[:n_free, :n_free]
        sums.g += right[:n_free]
        sums.of_blocks.extend(blocks)
        sums.of_starts.append((own[:n_free, n_free:], own[n_free:, n_free:], right[n_free:]))
    return sums
