"""The arrays of an identified model while it is being fitted: free run and slopes, in numpy and in compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import wraps
from typing import ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.plants.identified import StateEquation
from loopwright.pipeline.plants.simulator import Array

# -------------------------------------------- loops over the rows of a record, compiled: each row needs the one before
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
    seen: NDArray[np.bool_],
    x: Array,
    limit: float,
    before: Array,
    after: Array,
) -> bool:
    """A free run, written into ``before`` and ``after`` (n, n_x); False where a state exceeds ``limit``.

        z(k) = matrix x'(k) + drive(k),   x(k+1) = z[:n_x] + W2 tanh(z[n_x:])

    ``matrix`` (n_x + n_h, n_x), ``drive`` (n, n_x + n_h). x' is x, its outputs corrected by ``correction`` (y - x), all
    states by ``gain`` (y - x) where there is a gain (n_x, n_y), else (n_x, 0). Outputs that are not ``seen`` (n, n_y)
    in a row correct nothing.
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
                if seen[k, i]:
                    x[i] += correction * (y[k, i] - x[i])
        if corrects:
            for i in range(n_x):
                for j in range(n_y):
                    if seen[k, j]:
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
    seen: NDArray[np.bool_],
    parameters: bool,
    s: Array,
    jac: Array,
) -> None:
    """Sensitivities of the outputs in m rows, written into ``jac`` (m, n_y, P + n_x); ``s`` (n_x, P + n_x) goes on.

        S(k+1) = dF/dx S'(k) + dF/dtheta(k),   S' = S but for the outputs: keep S[:n_y]

    With a ``gain`` L (n_x, n_y) and the innovations ``e`` (m, n_y), S' = S - L S[:n_y] + dL/dtheta e; else (n_x, 0).
    Outputs that are not ``seen`` (m, n_y) in a row correct nothing there.

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
            if not seen[k, j]:
                continue
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
                slope[i, j] = total * keep if j < n_y and seen[k, j] else total
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


# ----------------------------------------------------------------------------------------------------------- the model
EXPLODED_STATE = 1e4
"""Scaled state beyond which a free run is given up."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Neighbouring rows of one run, scaled: outputs y (n, n_y) and the inputs v (n, n_v) that act in these rows.

    ``fresh`` (n, n_y) says which outputs are new readings; None: all are. Only these count in an error.
    """

    y: Array
    v: Array
    fresh: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.y)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Outputs (n, n_y) that are new readings."""
        return np.ones(self.y.shape, dtype=np.bool_) if self.fresh is None else np.ascontiguousarray(self.fresh)

    @property
    def count(self) -> int:
        """Number of new readings."""
        return self.y.size if self.fresh is None else int(np.count_nonzero(self.fresh))

    def errors(self, predicted: Array) -> Array:
        """Errors y - predicted (n, n_y), NaN where an output is no new reading."""
        left = self.y - predicted
        return left if self.fresh is None else np.where(self.fresh, left, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Dynamics(StateEquation):
    """The state equation with y = x[:n_y], while it is being fitted; the fields are its parameters."""

    @classmethod
    def linear(cls, a: Array, b: Array, c: Array | None = None) -> Self:
        """The model without a hidden unit."""
        n_x, n_v = b.shape
        bias = np.zeros(n_x) if c is None else c
        return cls(a, b, bias, np.zeros((0, n_x + n_v)), np.zeros(0), np.zeros((n_x, 0)))

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.a)

    @property
    def n_v(self) -> int:
        """Number of inputs."""
        return int(self.b.shape[1])

    @property
    def n_hidden(self) -> int:
        """Number of tanh units."""
        return len(self.b1)

    @property
    def plant(self) -> Dynamics:
        """The plant alone, without loads of a model of its noise."""
        return self

    @property
    def filter_gain(self) -> Array:
        """Gain (n_x, n_y) by which a run corrects its states; (n_x, 0): a free run."""
        return np.zeros((self.n_x, 0))

    # ------------------------------------------------------------------ parameters as one vector
    def vector(self) -> Array:
        """All parameters (P,), field by field, row by row."""
        return np.concatenate([getattr(self, f.name).ravel() for f in fields(self)])

    def with_vector(self, theta: Array) -> Self:
        """The same structure with the parameters theta (P,)."""
        parts, start = {}, 0
        for f in fields(self):
            shape = getattr(self, f.name).shape
            size = int(np.prod(shape))
            parts[f.name] = theta[start : start + size].reshape(shape)
            start += size
        return replace(self, **parts)

    def mask(self, **free: bool | NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The entries of ``vector`` that are free (P,): each field by name, as a whole or as a mask of its shape."""
        parts = []
        for f in fields(self):
            value = getattr(self, f.name)
            parts.append(np.broadcast_to(np.asarray(free.get(f.name, False), dtype=bool), value.shape).ravel())
        return np.concatenate(parts)

    def free(self) -> NDArray[np.bool_]:
        """Mask (P,) of the parameters that a fit changes."""
        return np.ones(len(self.vector()), dtype=np.bool_)

    # ------------------------------------------------------------------ running
    def slopes(self, x: Array, v: Array) -> tuple[Array, Array]:
        """(dx+/dx (..., n_x, n_x), dx+/dv (..., n_x, n_v)) at states (..., n_x) under inputs (..., n_v)."""
        t = np.tanh(np.concatenate([x, v], axis=-1) @ self.w1.T + self.b1)
        through = (self.w2 * (1 - t * t)[..., None, :]) @ self.w1
        return self.a + through[..., : self.n_x], self.b + through[..., self.n_x :]

    def hold(self, x: Array, v: Array, periods: int) -> tuple[Array, Array]:
        """(states (n, n_x), largest change of each in the last period (n,)) after ``periods`` of constant inputs.

        From states x (n, n_x) under v (n, n_v); not finite where a run explodes.
        """
        ahead, moved = np.array(x, dtype=np.float64), np.zeros(len(x))
        drive, lift = v @ self.b.T + self.c, v @ self.w1[:, self.n_x :].T + self.b1
        w1 = np.ascontiguousarray(self.w1[:, : self.n_x])
        a, w2 = np.ascontiguousarray(self.a), np.ascontiguousarray(self.w2)
        hold_inputs(a, w1, w2, drive, lift, periods, ahead, moved)
        return ahead, moved

    def free_run(self, start: Array, data: Stretch, correction: float = 0.0) -> tuple[Array, Array] | None:
        """(predicted states (n, n_x), states that the next prediction starts from (n, n_x)); None where it explodes.

            x(k+1) = F(x'(k), v(k)),   x' = x but for the outputs:   x'[:n_y] = x[:n_y] + correction (y - x[:n_y])

        With ``correction`` 0 the two are the same, and y is not used; with 1 the outputs are predicted one step ahead.
        """
        return self.runner(correction)(start, data)

    def runner(self, correction: float = 0.0) -> Callable[[Array, Stretch], tuple[Array, Array] | None]:
        """``free_run`` of (start, data), for many of them: what they share is made once."""
        n_x = self.n_x
        matrix = np.ascontiguousarray(np.concatenate([self.a, self.w1[:, :n_x]]))
        w2, gain = np.ascontiguousarray(self.w2), np.ascontiguousarray(self.filter_gain)
        b, w1 = self.b.T, self.w1[:, n_x:].T

        def run(start: Array, data: Stretch) -> tuple[Array, Array] | None:
            drive = np.concatenate([data.v @ b + self.c, data.v @ w1 + self.b1], axis=1)
            before, after = np.empty((len(data), n_x)), np.empty((len(data), n_x))
            y, x = np.ascontiguousarray(data.y), np.asarray(start, dtype=np.float64)
            kept = run_rows(matrix, w2, drive, y, correction, gain, data.seen, x, EXPLODED_STATE, before, after)
            return (before, after) if kept else None

        return run
