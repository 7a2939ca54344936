"""Models of lagged inputs and outputs: linear (ARX) and a network (NNARX)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.metrics import fit_percent, r2, rmse
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.part import Learnt, Part, Source, predict
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.objectives import FreeRunWindows, free_run
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

    def windows(
        self, record: Record, steps: int, target: int = 0, *, every: int = 1, least_back: int = 0
    ) -> FreeRunWindows:
        """``FreeRunWindows.of`` the record for this model's lags; raises RecordError."""
        return FreeRunWindows.of(
            record, self.n_y, self.n_u, steps, target=target, delay=self.delay, every=every, least_back=least_back
        )

    def simulate(self, past: Tensor, u: Tensor) -> Tensor:
        """Free run (..., k) from measured PVs ``past`` (..., n_y) under MVs ``u`` (..., n_u - 1 + k, n_mv)."""
        return free_run(self, past, u, self.n_u)

    @torch.no_grad()
    def free_run(self, cut: FreeRunWindows) -> Array:
        """The free run over windows, shape (N, k)."""
        return np.asarray(self.simulate(torch.from_numpy(cut.past), torch.from_numpy(cut.u)).numpy())


def mvs_of(x: Array, n_y: int, n_u: int) -> int:
    """Number of MVs in regressors x (N, n_y + n_u n_mv); ModelError where the lags do not explain the width."""
    n_mv, rest = divmod(x.shape[1] - n_y, n_u)
    if rest:
        raise ModelError(f"{x.shape[1]} regressor columns are not n_y + n_u n_mv with n_y={n_y}, n_u={n_u}")
    return n_mv


class ARX(LaggedModel):
    """y(t) = c - a_1 y(t-1) - .. - a_ny y(t-n_y) + b_1 u(t-d) + .. + b_nu u(t-d-n_u+1), for each MV u.

    ``forward`` maps phi(t), as in LaggedModel, to y(t) = phi(t)' weight + bias.

    Source: [chen2004, eqs. 10-13] (the form of its linearized and its recursive model).
    """

    kind: ClassVar[str] = "arx"
    weight: Tensor  # (n_y + n_u n_mv,) [-a, b]
    bias: Tensor  # (1,) c

    def __init__(self, n_y: int, n_u: int, n_mv: int = 1, delay: int = 1) -> None:
        super().__init__(n_y, n_u, n_mv, delay)
        self.reserve(weight=(n_y + n_u * n_mv,), bias=(1,))

    @classmethod
    def fit(cls, x: Array, y: Array, *, n_y: int, n_u: int, delay: int = 1) -> Self:
        """Least squares over regressors x (N, n_y + n_u n_mv) and targets y (N, 1).

        Raises ModelError where the lags do not explain the width, or the data leave a coefficient
        undetermined: fewer rows than coefficients, or columns that depend on each other.
        """
        arguments = {"n_y": n_y, "n_u": n_u, "n_mv": mvs_of(x, n_y, n_u), "delay": delay}
        middle, scale = x.mean(axis=0), x.std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        # Standardized, so that the rank is judged alike for flows of hundreds and for pH.
        design = np.column_stack([(x - middle) / scale, np.ones(len(x))])
        solution, _, rank, _ = np.linalg.lstsq(design, y[:, 0], rcond=None)
        if rank < design.shape[1]:
            raise ModelError(
                f"the data determine {rank} of {design.shape[1]} ARX coefficients (n_y={n_y}, n_u={n_u}); "
                "ask for fewer lags or record richer moves"
            )
        weight = solution[:-1] / scale
        return cls.from_arrays(arguments, {"weight": weight, "bias": solution[-1:] - middle @ weight})

    def forward(self, x: Tensor) -> Tensor:
        """y(t), shape (..., 1), for phi(t), shape (..., n_y + n_u n_mv)."""
        # Product and sum: onnxruntime fuses a transposed constant before a vector wrongly.
        return (x * self.weight).sum(-1, keepdim=True) + self.bias


@dataclass(frozen=True, kw_only=True)
class ArxPart(Part):
    """An ARX predictor of ``target`` (None: the controlled variable) by least squares.

    ``n_y``, ``n_u``, ``delay`` the lags; ``steps`` the length of the free run whose error is reported.
    ``train_fraction`` of the record trains, the rest validates.
    """

    model: ClassVar[type[LaggedModel]] = ARX
    n_y: int = 2
    n_u: int = 2
    delay: int = 1
    target: str | None = None
    steps: int = 10
    train_fraction: float = 0.7

    def learn(self, source: Source) -> Learnt:
        """Fit; the figures are of one step and of a free run, over the rows that did not train."""
        record, target = source.data(self.model.kind), source.pv_index(self.target)
        pairs = nnarx_pairs(record, self.n_y, self.n_u, target, self.delay)
        train, validation = pairs.split(self.train_fraction, "time")
        model = ARX.fit(train.x, train.y, n_y=self.n_y, n_u=self.n_u, delay=self.delay)
        predicted = predict(model, validation.x)
        cut = model.windows(record, self.steps, target)
        late = slice(round(self.train_fraction * len(cut)), None)
        metrics = {
            "rmse": rmse(validation.y, predicted),
            "r2": r2(validation.y, predicted),
            "fit_percent": fit_percent(validation.y, predicted),
            "free_run_rmse": rmse(cut.future[late, -1], model.free_run(cut)[late, -1]),
            "n_train": len(train),
            "weight": model.weight.tolist(),
            "bias": float(model.bias),
        }
        return Learnt(model, metrics)


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
