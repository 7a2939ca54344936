"""The networks of the observer laws, learnt in design from free runs of an identified model."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.inverse.self_chosen import LANES, SEED, Choice, branches
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.fit import LevenbergMarquardt
from loopwright.pipeline.models.training.objectives import Samples
from loopwright.pipeline.plants.signals import Signals
from loopwright.pipeline.plants.simulator import Array

HIDDEN, ITERATIONS, TRAIN = (10,), 60, 0.8
PARTITIONS = 10  # of the inverse


def learnt_parts(model: Identified, signals: Signals, choice: Choice) -> dict[str, Model]:
    """The parts ``forward``, ``observer`` and ``inverse``: of the CV over h, of the observed PV over one.

        forward(x(k), u) = y(k + h),   observer(x(k), u) = T(k + 1),   inverse(x, forward(x, u)) = u

    The MV wanders over its range, see ``branches``; measured disturbances stay at the centre of the record. Raises
    LawError where too few samples lie within the ranges of the PVs.
    """
    rows, ahead, following = _rows(model, signals, choice.horizon)
    target = following[:, choice.observed : choice.observed + 1]
    forward = _network(rows, ahead, residual=0)
    observer = _network(rows, target, residual=choice.observed)
    return {"forward": forward, "observer": observer, "inverse": _inverse(forward, rows)}


@torch.no_grad()
def _rows(model: Identified, signals: Signals, h: int) -> tuple[Array, Array, Array]:
    """[pv(k), mv(k)] (N, n_pv + 1), the CV after h periods (N, 1), and the PVs after one (N, n_pv)."""
    mv, n = signals.mv[0], model.n_y
    middle, half = (mv.low + mv.high) / 2, (mv.high - mv.low) / 2
    low, high = (np.array([getattr(s, end) for s in signals.pv]) for end in ("low", "high"))
    nominal = model.v_center[model.n_mv :].expand(LANES, -1)

    def inputs(u: Array) -> Tensor:
        return torch.cat([torch.from_numpy(middle + half * u)[:, None], nominal], dim=-1)

    def advance(x: Array, u: Array) -> Array:
        after: Array = model(torch.cat([torch.from_numpy(x), inputs(u)], dim=-1)).numpy()
        return after

    levels = np.random.default_rng(SEED).uniform(low, high, (LANES, n))
    runs = branches(advance, model.at_rest(torch.from_numpy(levels), inputs(np.zeros(LANES))).numpy(), h)
    pv, following, ahead = (model.measured(torch.from_numpy(x)).numpy() for x in (runs.x, runs.following, runs.ahead))
    rows = np.column_stack([pv, middle + half * runs.u])
    good = np.isfinite(ahead).all(axis=1) & np.all((pv >= low) & (pv <= high), axis=1)
    if good.sum() < LANES:
        raise LawError(
            f"{good.sum()} of {good.size} rows of the identified model's free runs lie within the ranges of the PVs; "
            "widen the ranges to what the plant visits, or choose law 'predictive'"
        )
    return rows[good], ahead[good, :1], following[good]


def _network(rows: Array, target: Array, residual: int) -> MLP:
    """A network of the change of one PV, the last lanes held out for stopping."""
    cut = round(TRAIN * len(rows))
    model = MLP.scaled_to(rows, target, hidden=HIDDEN, residual=(residual,))
    train, held = Samples(rows[:cut], target[:cut]), Samples(rows[cut:], target[cut:])
    LevenbergMarquardt(iterations=ITERATIONS).fit(model, train, held, seed=SEED)
    return model.eval()


def _inverse(forward: Model, rows: Array) -> Model:
    """A radial basis function network [pv, w] -> mv, of w = forward(pv, mv) over the rows."""
    from loopwright.pipeline.models.static.fuzzy_means import (
        FuzzyMeansRBF,  # scikit-learn is slow to import, few need it
    )

    with torch.no_grad():
        w = forward(torch.from_numpy(rows)).numpy()
    return FuzzyMeansRBF(PARTITIONS).fit(np.hstack([rows[:, :-1], w]), rows[:, -1:]).to_torch()
