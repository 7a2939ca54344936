"""NNARX: a network over past process variables and past manipulated variables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Self

from torch import Tensor

from loopwright.pipeline.models.lagged.lagged import LaggedModel, mvs_of
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.plants.simulator import Array


class NNARX(LaggedModel):
    """One-step predictor of one PV from lags, y(t) = NN(phi(t)). Training goes through ``net``.

    phi, its lags and the errors are those of LaggedModel. ``hidden`` are the widths of the hidden layers; with
    ``residual`` the network predicts y(t) - y(t-1).

    Source: [chen2004, section on the NNARX model].
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
        super().__init__(n_y, n_u, n_mv, delay)
        self.hidden, self.residual = tuple(hidden), residual
        self.net = MLP(n_y + n_u * n_mv, 1, hidden, (0,) if residual else ())

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
        model = cls(n_y, n_u, mvs_of(x, n_y, n_u), delay, hidden, residual)
        model.net = MLP.scaled_to(x, y, hidden=hidden, residual=model.net.residual)
        return model

    def forward(self, x: Tensor) -> Tensor:
        """y(t), shape (..., 1), for phi(t), shape (..., n_y + n_u n_mv)."""
        y: Tensor = self.net(x)
        return y
