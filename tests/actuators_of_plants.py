"""A plant that is a model, whose actuators go local, stick, lag and are read back badly. Not a test."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from loopwright.serving import Sample


class ActuatedPlant:
    """Two outputs of a law's own model.

    ``local`` (n_mv,) are MVs that the plant has, and that ``by_plant`` moves; ``stuck`` those that do not move.
    ``tells``: whether the plant says which are local. ``offset`` (n_mv,) is read back beside where they stand, and
    ``blind`` (n_mv,) those of which nothing sound is.
    """

    def __init__(self, model: Any, noise: float = 0.0, seed: int = 0) -> None:
        self.model, self.noise, self.rng = model, noise, np.random.default_rng(seed)
        self.x = torch.zeros(model.n_x, dtype=torch.float64)
        self.mv, n = np.zeros(model.n_mv), model.n_mv
        self.local, self.stuck, self.blind = (np.zeros(n, dtype=bool) for _ in range(3))
        self.tells, self.offset = True, np.zeros(n)

    def sample(self) -> Sample:
        """What is read at a scan."""
        pv = self.model.measured(self.x).numpy() + self.noise * self.rng.normal(size=self.model.n_y)
        read = np.where(self.blind, np.nan, self.mv + self.offset)
        return Sample(pv, read, local=tuple("in local" if on and self.tells else "" for on in self.local))

    def write(self, mv: np.ndarray) -> None:
        """A command, and a period."""
        self.mv = np.where(self.local | self.stuck, self.mv, mv)
        with torch.no_grad():
            self.x = self.model(torch.cat([self.x, torch.from_numpy(self.mv)]))

    def by_plant(self, i: int, value: float) -> None:
        """The plant's own operator moves an MV that it has."""
        self.mv[i] = value
