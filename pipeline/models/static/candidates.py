"""A model at one state for several candidates of its MV."""

from __future__ import annotations

import torch
from torch import Tensor

from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.static.mlp import MLP


def candidates(model: Model, x: Tensor, u: Tensor) -> Tensor:
    """Predictions (..., K) of a model over [x, u] at one state x (..., n) for candidates u (..., K)."""
    if isinstance(model, MLP):
        return model.sections(x, u.unsqueeze(-1)).squeeze(-1)
    states = x.unsqueeze(-2).expand(*u.shape, x.shape[-1])
    y: Tensor = model(torch.cat([states, u.unsqueeze(-1)], dim=-1))
    return y.squeeze(-1)
