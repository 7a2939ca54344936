"""Cases by name: adding one is a file in this folder and a line here."""

from __future__ import annotations

from pipeline.cases.base import NOISE_SUFFIX, Case, Scenario
from pipeline.cases.batch_reactor import BatchReactorCase
from pipeline.cases.henson_seborg_cstr import HensonSeborgCstrCase
from pipeline.cases.jacketed_batch_reactor import JacketedBatchReactorCase
from pipeline.cases.ph_neutralization import PhNeutralizationCase
from pipeline.cases.ph_neutralization_15s import PhNeutralization15sCase
from pipeline.cases.reversible_cstr import ReversibleCstrCase
from pipeline.cases.thiosulfate_cstr import ThiosulfateCstrCase

CASES: dict[str, Case] = {
    ThiosulfateCstrCase.name: ThiosulfateCstrCase(),
    PhNeutralizationCase.name: PhNeutralizationCase(),
    PhNeutralization15sCase.name: PhNeutralization15sCase(),
    BatchReactorCase.name: BatchReactorCase(),
    HensonSeborgCstrCase.name: HensonSeborgCstrCase(),
    JacketedBatchReactorCase.name: JacketedBatchReactorCase(),
    ReversibleCstrCase.name: ReversibleCstrCase(),
}

__all__ = ["CASES", "NOISE_SUFFIX", "Case", "Scenario"]
