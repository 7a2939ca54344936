"""A few moves of each MV that cover a horizon: their lengths, and what they cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.simulator import Array


@dataclass(frozen=True, slots=True)
class Moves:
    """Moves z_1 .. z_J of each MV over a horizon of N samples, short at first and then ever longer.

    Move j starts at sample ``starts[j]``. It holds its value until the next one starts, or with ``ramps`` the MV
    runs straight from one value to the next, as an actuator of limited speed does. A plan (..., J n_mv) has the
    first move of all MVs in front, then the second: it is in the order of time.
    """

    horizon: int
    starts: tuple[int, ...]
    n_mv: int
    ramps: bool

    @classmethod
    def over(cls, horizon: int, moves: int, n_mv: int, *, ramps: bool = False) -> Moves:
        """Moves whose lengths grow geometrically from 1 to fill the horizon; LawError if they do not fit in."""
        if not 1 <= moves <= horizon:
            raise LawError(f"{moves} moves do not fit in a horizon of {horizon} samples; give 1 to {horizon} moves")
        low, high = 1.0, float(horizon)
        for _ in range(60):  # the ratio of the lengths, whose sum grows with it
            ratio = 0.5 * (low + high)
            low, high = (ratio, high) if sum(ratio**j for j in range(moves)) < horizon else (low, ratio)
        starts = [0]
        for j in range(1, moves):
            starts.append(max(starts[-1] + 1, round(sum(low**i for i in range(j)))))
        return cls(horizon, tuple(starts), n_mv, ramps)

    @property
    def count(self) -> int:
        """Number of entries of a plan, J n_mv."""
        return len(self.starts) * self.n_mv

    @property
    def profile(self) -> Array:
        """Share (N, J) of each move in an MV at each sample of the horizon."""
        at = np.arange(self.horizon, dtype=np.float64)
        if self.ramps:
            each = np.eye(len(self.starts))
            return np.stack([np.interp(at, self.starts, row) for row in each], axis=1)
        ends = np.array([*self.starts[1:], self.horizon])
        return ((at[:, None] >= np.array(self.starts)) & (at[:, None] < ends)).astype(np.float64)

    @property
    def lengths(self) -> Array:
        """Samples (J n_mv,) between the start of a move and that of the move before; 1 for the first."""
        return np.repeat(np.diff(self.starts, prepend=self.starts[0] - 1), self.n_mv).astype(np.float64)

    @property
    def shift(self) -> Array:
        """Matrix (J n_mv, J n_mv) S of a plan one sample later: plan @ S."""
        later = np.minimum(np.array(self.starts) + 1, self.horizon - 1)
        return self._each_mv(self.profile[later].T)

    @property
    def before(self) -> Array:
        """Matrix (J n_mv, J n_mv) from a plan to the move before each move; 0 before the first."""
        return self._each_mv(np.eye(len(self.starts), k=1))

    @property
    def curvature(self) -> Array:
        """Matrix D'D (J n_mv, J n_mv) of the sum of squared changes from move to move, the first from 0."""
        d = np.eye(self.count) - self.before
        return d @ d.T

    @property
    def first(self) -> Array:
        """Matrix (n_mv, J n_mv) that puts a value of each MV in the place of its first move."""
        return np.eye(self.n_mv, self.count)

    def _each_mv(self, matrix: Array) -> Array:
        return np.asarray(np.kron(matrix, np.eye(self.n_mv)), dtype=np.float64)

    def courses(self, plan: Tensor) -> Tensor:
        """The MVs (..., N, n_mv) of a plan (..., J n_mv)."""
        each = plan.reshape(*plan.shape[:-1], len(self.starts), self.n_mv)
        return torch.from_numpy(self.profile) @ each
