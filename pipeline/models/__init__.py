"""Models by kind: adding one is a file in this folder (the model and its Part) and a line here."""

from __future__ import annotations

from pipeline.models.arx import ArxPart
from pipeline.models.base import Model, load_model
from pipeline.models.hybrid_fuzzy_part import HybridFuzzyPart
from pipeline.models.identification_example import IdentificationExamplePart
from pipeline.models.leverage_domain import DomainPart
from pipeline.models.linearized import LinearizedPart
from pipeline.models.local_models_part import LocalModelsPart
from pipeline.models.network_parts import MlpPart
from pipeline.models.nnarx_part import NnarxPart
from pipeline.models.parts import Learnt, Part
from pipeline.models.rbf_part import RbfPart
from pipeline.models.state_space_part import StateSpacePart

MODELS: dict[str, type[Part]] = {
    RbfPart.model.kind: RbfPart,
    MlpPart.model.kind: MlpPart,
    NnarxPart.model.kind: NnarxPart,
    StateSpacePart.model.kind: StateSpacePart,
    ArxPart.model.kind: ArxPart,
    DomainPart.model.kind: DomainPart,
    LinearizedPart.model.kind: LinearizedPart,
    LocalModelsPart.model.kind: LocalModelsPart,
    HybridFuzzyPart.model.kind: HybridFuzzyPart,
    "identification_example": IdentificationExamplePart,  # whose model is an NNARX
}

__all__ = ["MODELS", "Learnt", "Model", "Part", "load_model"]
