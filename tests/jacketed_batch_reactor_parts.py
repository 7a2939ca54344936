"""The quick model set of the jacketed batch reactor: the printed fuzzy model, which needs no data."""

from __future__ import annotations

from pipeline.models import Model
from pipeline.models.hybrid_fuzzy import HybridFuzzy
from pipeline.plants import Plant
from pipeline.plants.fuzzy_batch_reactor import CENTRES, FuzzyBatchReactor

LAWS = ("fuzzy_feedforward", "fuzzy_feedforward_pi", "fuzzy_feedforward_observer")


def parts(plant: Plant) -> dict[str, Model]:
    """The paper's own matrices, whatever the plant's parameters."""
    printed = FuzzyBatchReactor()
    return {"printed": HybridFuzzy([float(c) for c in CENTRES], printed.consequents(), printed.core)}
