"""The arrays of an identified model while it is being fitted: free run and slopes, in numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.models.identified.compiled import hold_inputs, run_rows
from loopwright.pipeline.plants.identified import StateEquation
from loopwright.pipeline.plants.simulator import Array

EXPLODED = 1e4
"""Scaled state beyond which a free run is given up."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Neighbouring rows of one run, scaled: outputs y (n, n_y) and the inputs v (n, n_v) that act in these rows."""

    y: Array
    v: Array

    def __len__(self) -> int:
        return len(self.y)


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
            kept = run_rows(matrix, w2, drive, y, correction, gain, x, EXPLODED, before, after)
            return (before, after) if kept else None

        return run
