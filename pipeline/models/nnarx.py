"""NNARX: a network over past process variables and past manipulated variables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.errors import ModelError
from pipeline.models.base import Model
from pipeline.models.mlp import MLP
from pipeline.models.objectives import Windows
from pipeline.record import Record

Array = NDArray[np.float64]


class NNARX(Model):
    """One-step predictor of one PV from lags, y(t) = NN(phi(t)).

        phi(t) = [y(t-1), .., y(t-n_y), u(t-d), .., u(t-d-n_u+1)]

    with the lags of the first MV before those of the next, as ``regressors.nnarx_pairs`` gives
    them. ``forward`` maps phi (..., n_y + n_u n_mv) to y (..., 1). Training goes through ``net``.

    Source: seed 002_4e35f3d541bda8ae.txt, section on the NNARX model.

    Parameters
    ----------
    n_y, n_u
        Numbers of past PVs and past MVs.
    n_mv
        Number of manipulated variables.
    delay
        Periods from a move to its first effect, d >= 1.
    hidden
        Width of each hidden layer.
    residual
        Whether the network predicts y(t) - y(t-1).

    Raises
    ------
    ModelError
        A lag, the delay or ``n_mv`` below 1.
    """

    kind: ClassVar[str] = "nnarx"

    def __init__(
        self,
        n_y: int,
        n_u: int,
        n_mv: int = 1,
        delay: int = 1,
        hidden: Sequence[int] = (10,),
        residual: bool = False,
    ) -> None:
        super().__init__()
        if min(n_y, n_u, n_mv, delay) < 1:
            raise ModelError(f"NNARX has n_y={n_y}, n_u={n_u}, n_mv={n_mv}, delay={delay}; each must be at least 1")
        self.n_y, self.n_u, self.n_mv, self.delay = n_y, n_u, n_mv, delay
        self.net = MLP(n_y + n_u * n_mv, 1, hidden, (0,) if residual else ())

    def config(self) -> dict[str, Any]:
        """JSON-ready arguments of the constructor."""
        return {
            "n_y": self.n_y,
            "n_u": self.n_u,
            "n_mv": self.n_mv,
            "delay": self.delay,
            "hidden": list(self.net.hidden),
            "residual": bool(self.net.residual),
        }

    @classmethod
    def scaled_to(
        cls,
        x: Array,
        y: Array,
        *,
        n_y: int,
        n_u: int,
        delay: int = 1,
        hidden: Sequence[int] = (10,),
        residual: bool = False,
    ) -> Self:
        """An untrained model scaled to regressors x (N, n_y + n_u n_mv) and targets y (N, 1).

        Raises ModelError for a column that does not vary, or a width that the lags do not explain.
        """
        n_mv, rest = divmod(x.shape[1] - n_y, n_u)
        if rest:
            raise ModelError(f"{x.shape[1]} regressor columns are not n_y + n_u n_mv with n_y={n_y}, n_u={n_u}")
        model = cls(n_y, n_u, n_mv, delay, hidden, residual)
        model.net = MLP.scaled_to(x, y, hidden=hidden, residual=(0,) if residual else ())
        return model

    def forward(self, x: Tensor) -> Tensor:
        """y(t), shape (..., 1), for phi(t), shape (..., n_y + n_u n_mv)."""
        y: Tensor = self.net(x)
        return y

    def simulate(self, past: Tensor, u: Tensor) -> Tensor:
        """Free run: predictions (..., k) fed back in place of measurements.

        ``past`` (..., n_y) holds the last measured PVs, oldest first; ``u`` (..., n_u - 1 + k, n_mv)
        the MVs that the k predictions use, oldest first: its last row is u(t - d) of the last one.
        """
        ys = list(past.unbind(-1))
        for step in range(u.shape[-2] - self.n_u + 1):
            recent = u[..., step : step + self.n_u, :].flip(-2).transpose(-1, -2).flatten(-2)
            phi = torch.cat([torch.stack(ys[-1 : -1 - self.n_y : -1], dim=-1), recent], dim=-1)
            ys.append(self.net(phi)[..., 0])
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
