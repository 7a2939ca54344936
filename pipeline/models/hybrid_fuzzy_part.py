"""How a hybrid fuzzy model is learnt: as printed, or from a record by least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from pipeline.errors import ModelError
from pipeline.models.base import Model
from pipeline.models.hybrid_fuzzy import HybridFuzzy
from pipeline.models.parts import Learnt, Part, Regions
from pipeline.plants.base import Plant
from pipeline.plants.fuzzy_batch_reactor import CENTRES, FuzzyBatchReactor
from pipeline.record import Record


@dataclass(frozen=True, kw_only=True)
class HybridFuzzyPart(Part):
    """A hybrid fuzzy model: ``identification`` printed (needs no data), or tied, global or local from a record."""

    model: ClassVar[type[Model]] = HybridFuzzy
    identification: Literal["printed", "tied", "global", "local"]

    def learn(self, record: Record | None, plant: Plant, regions: Regions, seed: int) -> Learnt:
        """The model and its figures."""
        if self.identification == "printed":
            return Learnt(printed_model(), {})
        raise ModelError("not yet")


def printed_model() -> HybridFuzzy:
    """The paper's own matrices."""
    printed = FuzzyBatchReactor()
    return HybridFuzzy(CENTRES, printed.consequents(), printed.core)
