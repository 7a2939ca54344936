"""Predictive laws over identified models, and closed loops over plants that are models themselves. Not a test."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from identified_models import made_signals
from torch import Tensor

from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified

NONE = torch.zeros(0, dtype=torch.float64)


def law_of(model: Identified, **params: Any) -> Predictive:
    """The law with these parameters over signals that fit the model."""
    return Predictive(made_signals(model.n_y, model.n_mv, model.n_dv), model, Predictive.Params(**params)).eval()


def row(*values: float) -> Tensor:
    """A vector of numbers."""
    return torch.tensor(values, dtype=torch.float64)


def closed(
    law: Predictive,
    plant: Identified,
    sp: np.ndarray,
    *,
    load: np.ndarray | None = None,
    dv: np.ndarray | None = None,
    noise: float = 0.0,
    seed: int = 0,
    mv: Tensor | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """PVs and MVs (n, .) of a loop over a plant that starts at rest at zero, and the law's info."""
    n, rng = len(sp), np.random.default_rng(seed)
    x, state = torch.zeros(plant.n_x, dtype=torch.float64), torch.zeros(law.n_state, dtype=torch.float64)
    applied = torch.zeros(plant.n_mv, dtype=torch.float64) if mv is None else mv
    ys, mvs, infos = [], [], []
    with torch.no_grad():
        for k in range(n):
            y = plant.measured(x)
            disturbance = NONE if dv is None else row(dv[k])
            seen = y + noise * torch.from_numpy(rng.normal(size=plant.n_y))
            applied, state, info = law(torch.from_numpy(sp[k]), seen, disturbance, applied, state)
            ys.append(y.numpy())
            mvs.append(applied.numpy())
            infos.append(info.numpy())
            x = plant(torch.cat([x, applied, disturbance]))
            if load is not None:
                x[: plant.n_y] += torch.from_numpy(np.atleast_1d(load[k]))
    return np.array(ys), np.array(mvs), np.array(infos)
