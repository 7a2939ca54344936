"""What predictors from lags share: their regressor, and running free."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.errors import ModelError
from pipeline.models.base import Model
from pipeline.models.training.objectives import Windows
from pipeline.records.record import Record

Array = NDArray[np.float64]


class LaggedModel(Model):
    """One-step predictor of one PV, y(t) = f(phi(t)).

        phi(t) = [y(t-1), .., y(t-n_y), u(t-d), .., u(t-d-n_u+1)]

    with the lags of the first MV before those of the next, as ``regressors.nnarx_pairs`` gives
    them. ``forward`` maps phi (..., n_y + n_u n_mv) to y (..., 1).

    Parameters
    ----------
    n_y, n_u
        Numbers of past PVs and past MVs.
    n_mv
        Number of manipulated variables.
    delay
        Periods from a move to its first effect, d >= 1.

    Raises
    ------
    ModelError
        A lag, the delay or ``n_mv`` below 1.
    """

    def __init__(self, n_y: int, n_u: int, n_mv: int = 1, delay: int = 1) -> None:
        super().__init__()
        if min(n_y, n_u, n_mv, delay) < 1:
            name = self.kind.upper()
            raise ModelError(f"{name} has n_y={n_y}, n_u={n_u}, n_mv={n_mv}, delay={delay}; each must be at least 1")
        self.n_y, self.n_u, self.n_mv, self.delay = n_y, n_u, n_mv, delay

    @abstractmethod
    def config(self) -> dict[str, Any]:
        """JSON-ready arguments of the constructor."""

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """y(t), shape (..., 1), for phi(t), shape (..., n_y + n_u n_mv)."""

    def simulate(self, past: Tensor, u: Tensor) -> Tensor:
        """Free run: predictions (..., k) fed back in place of measurements.

        ``past`` (..., n_y) holds the last measured PVs, oldest first; ``u`` (..., n_u - 1 + k, n_mv)
        the MVs that the k predictions use, oldest first: its last row is u(t - d) of the last one.
        """
        ys = list(past.unbind(-1))
        for step in range(u.shape[-2] - self.n_u + 1):
            recent = u[..., step : step + self.n_u, :].flip(-2).transpose(-1, -2).flatten(-2)
            phi = torch.cat([torch.stack(ys[-1 : -1 - self.n_y : -1], dim=-1), recent], dim=-1)
            ys.append(self(phi)[..., 0])
        return torch.stack(ys[self.n_y :], dim=-1)

    def windows(self, record: Record, steps: int, target: int = 0) -> Windows:
        """The record cut into windows of ``steps`` samples for this model's lags; raises RecordError."""
        return Windows.of(record, self.n_y, self.n_u, steps, target=target, delay=self.delay)

    @torch.no_grad()
    def k_step(self, record: Record, steps: int, target: int = 0) -> tuple[Array, Array]:
        """(predicted, measured) PV ``steps`` samples ahead over a record, each (N,); raises RecordError."""
        cut = self.windows(record, steps, target)
        ahead = self.simulate(torch.from_numpy(cut.past), torch.from_numpy(cut.u))[:, -1]
        return ahead.numpy(), cut.future[:, -1]
