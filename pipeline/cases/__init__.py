"""Cases by name: adding one is a file in this folder and a line here."""

from __future__ import annotations

from pipeline.cases.base import NOISE_SUFFIX, Case, Scenario
from pipeline.cases.thiosulfate_cstr import ThiosulfateCstrCase

CASES: dict[str, Case] = {
    ThiosulfateCstrCase.name: ThiosulfateCstrCase(),
}

__all__ = ["CASES", "NOISE_SUFFIX", "Case", "Scenario"]
