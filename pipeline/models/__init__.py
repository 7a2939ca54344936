"""Models by kind: adding one is a file in a family's folder (model and Part) and a line here. No law stands here."""

from __future__ import annotations

from pipeline.models.base import Model, load_model
from pipeline.models.fuzzy.hybrid_fuzzy_part import HybridFuzzyPart
from pipeline.models.identified.identified_part import IdentifiedPart
from pipeline.models.lagged.arx import ArxPart
from pipeline.models.lagged.nnarx_part import NnarxPart
from pipeline.models.local.linearized import LinearizedPart
from pipeline.models.local.local_models_part import LocalModelsPart
from pipeline.models.part import Learnt, Part, Source
from pipeline.models.state_space.state_space import StateSpacePart
from pipeline.models.static.leverage_domain import DomainPart
from pipeline.models.static.rbf_part import RbfPart
from pipeline.models.training.network_parts import MlpPart

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
    IdentifiedPart.model.kind: IdentifiedPart,
}

__all__ = ["MODELS", "Learnt", "Model", "Part", "Source", "load_model"]
