"""The case's own kind of model: the paper's identification example."""

from __future__ import annotations

from loopwright.pipeline.cases.ph_neutralization.identification_example import IdentificationExamplePart
from loopwright.pipeline.models.part import Part

MODELS: dict[str, type[Part]] = {"identification_example": IdentificationExamplePart}  # whose model is an NNARX
