"""Models by kind: adding one is a file in a family's folder (model and Part) and a line here. No law stands here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.hybrid_fuzzy_part import HybridFuzzyPart
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.lagged.lagged import ArxPart
from loopwright.pipeline.models.lagged.nnarx_part import NnarxPart
from loopwright.pipeline.models.local_models import LinearizedPart
from loopwright.pipeline.models.local_models_part import LocalModelsPart
from loopwright.pipeline.models.part import Learnt, Part, Source
from loopwright.pipeline.models.state_space import StateSpacePart
from loopwright.pipeline.models.static.leverage_domain import DomainPart
from loopwright.pipeline.models.static.sweep import RbfPart
from loopwright.pipeline.models.training.network_parts import MlpPart

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


def load_model(path: Path) -> Model:
    """The model in ``path``, whatever its kind; raises ModelError for a foreign or damaged file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["__model__"]))
            arrays = {k: file[k] for k in file.files if k != "__model__"}
        return MODELS[header["kind"]].model.from_arrays(header["config"], arrays)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ModelError(
            f"{path} is not a model that this pipeline wrote ({error}); run the fit stage again"
        ) from error
