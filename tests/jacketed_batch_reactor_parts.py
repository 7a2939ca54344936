"""The quick model set of the jacketed batch reactor: the printed fuzzy model, which needs no data."""

from __future__ import annotations

from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_plant import CENTRES, FuzzyBatchReactor
from loopwright.pipeline.models import Model
from loopwright.pipeline.models.hybrid_fuzzy import HybridFuzzy
from loopwright.pipeline.plants.equations import EquationPlant

LAWS = ("fuzzy_feedforward", "fuzzy_feedforward_pi", "fuzzy_feedforward_observer")


def parts(plant: EquationPlant) -> dict[str, Model]:
    """The paper's own matrices, whatever the plant's parameters."""
    printed = FuzzyBatchReactor()
    return {"printed": HybridFuzzy([float(c) for c in CENTRES], printed.consequents(), printed.core)}
