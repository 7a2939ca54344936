"""One-step prediction side by side: an NNARX, its linearization one sample ago, and recursive linear models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.lagged.instantaneous import linearize
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.lagged.recursive_arx import RecursiveLeastSquares
from loopwright.pipeline.models.training.regressors import nnarx_pairs
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

ESTIMATE_FORGETTING = (0.8, 0.5)  # factors of the recursive estimates
VARIANCE = 100.0
"""Variance of a recursive model's parameters at the start: an open mind, for regressors of the order of one."""


@dataclass(frozen=True, slots=True)
class OneStep:
    """Predictions of each model beside the measurements that they predict, over the same samples."""

    time_s: Array  # (N,)
    measured: Array  # (N,) [unit of the PV]
    predicted: Mapping[str, Array]  # model -> (N,)

    def sse(self) -> dict[str, float]:
        """Sum of squared prediction errors of each model [unit of the PV, squared]."""
        return {name: float(((self.measured - p) ** 2).sum()) for name, p in self.predicted.items()}

    def curves(self) -> dict[str, Array]:
        """Arrays by name, as a picture wants them: time_s, measured, and one for each model."""
        return {"time_s": self.time_s, "measured": self.measured, **self.predicted}


def compare_one_step(
    model: NNARX,
    record: Record,
    *,
    target: int = 0,
    forgetting: Sequence[float] = ESTIMATE_FORGETTING,
    n_y: int | None = None,
    n_u: int | None = None,
    scaled: bool = True,
) -> OneStep:
    """Predict every sample of one run from the samples before it, by four kinds of model.

    With phi(t) the regressor of y(t), known at t - 1, and NN the network:

        nnarx         NN(phi(t))
        linearized    NN(phi(t-1)) + dNN/dphi(phi(t-1)) (phi(t) - phi(t-1))
        recursive_f   [phi(t), 1]' theta(t-1),  theta by least squares with forgetting factor f

    so the linearized model is the one that was right a sample ago, taken one sample further: its
    error is what a controller meets that tunes itself by it. The recursive models learn along the
    run from nothing. All are compared over the same samples.

    ``record`` holds one run, y is its PV ``target``. ``forgetting`` are the factors f of the recursive models and
    ``n_y``, ``n_u`` their lags, None for the network's; they take phi and y in the network's scaling where
    ``scaled``, otherwise in engineering units. Raises ModelError for a record of several runs, RecordError for one
    that is too short for the lags.

    Source: [chen2004, eqs. 9-11, figure 3 and Table 1]; the bias of eq. 12 has
    a wrong sign there, and here the linear model goes through the network's own value.
    """
    if (record.run != record.run[0]).any():
        raise ModelError("the one-step comparison follows one run, and this record holds several; pick one of them")
    own = model.pairs(record, target)
    phi = torch.from_numpy(own.x)
    linear = linearize(model, phi)
    ahead = linear.predict(torch.roll(phi, -1, dims=0) - phi)[:-1, 0].numpy()
    found = {"nnarx": (own.row, linear.value[:, 0].numpy()), "linearized": (own.row[1:], ahead)}
    n_y, n_u = n_y or model.n_y, n_u or model.n_u
    pairs = nnarx_pairs(record, n_y, n_u, target, model.delay)
    center, scale = np.zeros(pairs.x.shape[1]), np.ones(pairs.x.shape[1])
    if scaled:
        center, scale = _scaling(model, n_y, n_u)
    x, y = (pairs.x - center) / scale, (pairs.y[:, 0] - center[0]) / scale[0]
    for factor in forgetting:
        found[f"recursive_{factor:g}"] = (pairs.row, center[0] + scale[0] * _recursive(x, y, factor))
    first = max(int(row[0]) for row, _ in found.values())
    rows = np.arange(first, int(own.row[-1]) + 1)
    predicted = {name: values[row >= first] for name, (row, values) in found.items()}
    return OneStep(record.time_s[rows + 1], record.pv[rows + 1, target], predicted)


def _scaling(model: NNARX, n_y: int, n_u: int) -> tuple[Array, Array]:
    """The network's centre and scale of y and of each MV, repeated over other lags, (n_y + n_u n_mv,) each."""
    columns = np.r_[np.zeros(n_y, np.int64), np.repeat(model.n_y + model.n_u * np.arange(model.n_mv), n_u)]
    return model.net.x_center.numpy()[columns], model.net.x_scale.numpy()[columns]


def _recursive(x: Array, y: Array, forgetting: float) -> Array:
    """Predictions (N,) of y (N,) by [x, 1]' theta, x (N, n), each made before its row is learnt."""
    phi = torch.from_numpy(np.column_stack([x, np.ones(len(x))]))
    rls = RecursiveLeastSquares(forgetting)
    theta, root = torch.zeros(phi.shape[1], dtype=torch.float64), rls.start(phi.shape[1], VARIANCE)
    return np.asarray(rls.run(phi, torch.from_numpy(y), theta, root)[0].numpy())
