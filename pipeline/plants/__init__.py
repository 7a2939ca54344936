"""Plants by name: adding one is a file in this folder and a line here."""

from __future__ import annotations

from pipeline.plants.base import Linearization, Plant
from pipeline.plants.batch_reactor import BatchReactor
from pipeline.plants.fuzzy_batch_reactor import FuzzyBatchReactor
from pipeline.plants.henson_seborg_cstr import HensonSeborgCstr
from pipeline.plants.jacketed_batch_reactor import JacketedBatchReactor
from pipeline.plants.ph_neutralization import PhNeutralization, PhNeutralization15s
from pipeline.plants.reversible_cstr import ReversibleCstr
from pipeline.plants.thiosulfate_cstr import ThiosulfateCstr

PLANTS: dict[str, type[Plant]] = {
    ThiosulfateCstr.name: ThiosulfateCstr,
    PhNeutralization.name: PhNeutralization,
    PhNeutralization15s.name: PhNeutralization15s,
    BatchReactor.name: BatchReactor,
    HensonSeborgCstr.name: HensonSeborgCstr,
    JacketedBatchReactor.name: JacketedBatchReactor,
    FuzzyBatchReactor.name: FuzzyBatchReactor,
    ReversibleCstr.name: ReversibleCstr,
}

__all__ = ["PLANTS", "Linearization", "Plant"]
