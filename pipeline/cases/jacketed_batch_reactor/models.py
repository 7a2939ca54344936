"""The case's own kind of model: the paper's printed matrices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_plant import CENTRES, FuzzyBatchReactor
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.hybrid_fuzzy import HybridFuzzy
from loopwright.pipeline.models.hybrid_fuzzy_part import figures
from loopwright.pipeline.models.part import Learnt, Part, Source


@dataclass(frozen=True, kw_only=True)
class PrintedFuzzyPart(Part):
    """The hybrid fuzzy model with the paper's own matrices; a record serves its figures alone.

    ``train_fraction`` of the record is left to the identified models beside it, ``free_run`` is the length
    of the free runs whose error is reported [samples].
    """

    model: ClassVar[type[Model]] = HybridFuzzy
    train_fraction: float = 0.7
    free_run: int = 360

    def learn(self, source: Source) -> Learnt:
        """The printed model; without a record only what its coefficients say."""
        model = printed_model()
        return Learnt(model, figures(model, source, self.train_fraction, self.free_run))


def printed_model() -> HybridFuzzy:
    """The paper's own matrices."""
    printed = FuzzyBatchReactor()
    return HybridFuzzy([float(c) for c in CENTRES], printed.consequents(), printed.core)


MODELS: dict[str, type[Part]] = {"printed_fuzzy": PrintedFuzzyPart}  # whose model is a HybridFuzzy
