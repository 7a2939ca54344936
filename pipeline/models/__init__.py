"""Models by kind: adding one is a file in this folder and a line here."""

from __future__ import annotations

from pipeline.models.base import Model, load_model
from pipeline.models.leverage_domain import LeverageDomain
from pipeline.models.linearized import Linearized
from pipeline.models.mlp import MLP
from pipeline.models.nnarx import NNARX
from pipeline.models.rbf import RBF

MODELS: dict[str, type[Model]] = {
    RBF.kind: RBF,
    LeverageDomain.kind: LeverageDomain,
    MLP.kind: MLP,
    NNARX.kind: NNARX,
    Linearized.kind: Linearized,
}

__all__ = ["MODELS", "Model", "load_model"]
