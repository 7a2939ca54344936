"""State-space network: a plant whose whole state is measured, one period later."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from pipeline.errors import ModelError
from pipeline.models.base import Model
from pipeline.models.static.mlp import MLP, Array


class StateSpace(Model):
    """One-step predictor of a plant whose whole state is measured.

        x(k+1) = x(k) + NN(x(k), u(k))

    with x the process variables, u the manipulated ones held over [k, k+1). It needs no lags, so a free
    run forgets its start as the plant does. ``forward`` maps [x, u] (..., n_pv + n_mv) to x one period
    later (..., n_pv). Training goes through ``net``.

    Parameters
    ----------
    n_pv, n_mv
        Numbers of process variables and of manipulated variables.
    hidden
        Width of each hidden layer.

    Raises
    ------
    ModelError
        ``n_pv`` or ``n_mv`` below 1, or no hidden unit.
    """

    kind: ClassVar[str] = "state_space"

    def __init__(self, n_pv: int, n_mv: int = 1, hidden: Sequence[int] = (20,)) -> None:
        super().__init__()
        if min(n_pv, n_mv) < 1:
            raise ModelError(f"a state-space network has n_pv={n_pv}, n_mv={n_mv}; each must be at least 1")
        self.n_pv, self.n_mv = n_pv, n_mv
        self.net = MLP(n_pv + n_mv, n_pv, hidden, tuple(range(n_pv)))

    def config(self) -> dict[str, Any]:
        """JSON-ready arguments of the constructor."""
        return {"n_pv": self.n_pv, "n_mv": self.n_mv, "hidden": list(self.net.hidden)}

    @classmethod
    def scaled_to(cls, x: Array, y: Array, *, hidden: Sequence[int] = (20,)) -> Self:
        """An untrained model scaled to rows [x(k), u(k)] (N, n_pv + n_mv) and x(k+1) (N, n_pv).

        Raises ModelError for a column that does not vary.
        """
        n_pv = y.shape[1]
        model = cls(n_pv, x.shape[1] - n_pv, hidden)
        model.net = MLP.scaled_to(x, y, hidden=hidden, residual=tuple(range(n_pv)))
        return model

    def forward(self, x: Tensor) -> Tensor:
        """PVs one period later, shape (..., n_pv), for [PVs, MVs], shape (..., n_pv + n_mv)."""
        y: Tensor = self.net(x)
        return y

    def simulate(self, start: Tensor, mv: Tensor) -> Tensor:
        """Free run from measured PVs ``start`` (..., n_pv) under MVs (..., k, n_mv): the next PVs (..., k, n_pv)."""
        states = [start]
        for u in mv.unbind(-2):
            states.append(self(torch.cat([states[-1], u], dim=-1)))
        return torch.stack(states[1:], dim=-2)
