"""NNARX: a network over past process variables and past manipulated variables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pipeline.errors import ModelError
from pipeline.models.lagged.lagged import LaggedModel
from pipeline.models.static.mlp import MLP

Array = NDArray[np.float64]


class NNARX(LaggedModel):
    """One-step predictor of one PV from lags, y(t) = NN(phi(t)), phi as in LaggedModel. Training goes through ``net``.

    Source: [chen2004, section on the NNARX model].

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
        super().__init__(n_y, n_u, n_mv, delay)
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
