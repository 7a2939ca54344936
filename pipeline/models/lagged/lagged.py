"""Shared parts of predictors from lags: their regressor, their training data, and running free."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.training.objectives import Windows, free_run
from loopwright.pipeline.models.training.regressors import Pairs, nnarx_pairs
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record


class LaggedModel(Model):
    """One-step predictor of one PV, y(t) = f(phi(t)).

        phi(t) = [y(t-1), .., y(t-n_y), u(t-d), .., u(t-d-n_u+1)]

    with the lags of the first MV before those of the next, as ``regressors.nnarx_pairs`` gives
    them. ``forward`` maps phi (..., n_y + n_u n_mv) to y (..., 1), in engineering units.

    ``n_y`` and ``n_u`` are the numbers of past PVs and past MVs, ``n_mv`` that of manipulated variables, ``delay``
    the periods d from a move to its first effect. Raises ModelError where one of them is below 1.
    """

    def __init__(self, n_y: int, n_u: int, n_mv: int = 1, delay: int = 1) -> None:
        super().__init__()
        if min(n_y, n_u, n_mv, delay) < 1:
            name = self.kind.upper()
            raise ModelError(f"{name} has n_y={n_y}, n_u={n_u}, n_mv={n_mv}, delay={delay}; each must be at least 1")
        self.n_y, self.n_u, self.n_mv, self.delay = n_y, n_u, n_mv, delay

    def pairs(self, record: Record, target: int = 0) -> Pairs:
        """Pairs (phi(t), y(t)) of a record, y the PV ``target``; raises RecordError."""
        return nnarx_pairs(record, self.n_y, self.n_u, target, self.delay)

    def windows(self, record: Record, steps: int, target: int = 0, *, every: int = 1, least_back: int = 0) -> Windows:
        """``Windows.of`` the record for this model's lags; raises RecordError."""
        return Windows.of(
            record, self.n_y, self.n_u, steps, target=target, delay=self.delay, every=every, least_back=least_back
        )

    def simulate(self, past: Tensor, u: Tensor) -> Tensor:
        """Free run (..., k) from measured PVs ``past`` (..., n_y) under MVs ``u`` (..., n_u - 1 + k, n_mv)."""
        return free_run(self, past, u, self.n_u)

    @torch.no_grad()
    def free_run(self, cut: Windows) -> Array:
        """The free run over windows, shape (N, k)."""
        return np.asarray(self.simulate(torch.from_numpy(cut.past), torch.from_numpy(cut.u)).numpy())


def mvs_of(x: Array, n_y: int, n_u: int) -> int:
    """Number of MVs in regressors x (N, n_y + n_u n_mv); ModelError where the lags do not explain the width."""
    n_mv, rest = divmod(x.shape[1] - n_y, n_u)
    if rest:
        raise ModelError(f"{x.shape[1]} regressor columns are not n_y + n_u n_mv with n_y={n_y}, n_u={n_u}")
    return n_mv
