"""What is known of a case beyond its figures; a case without a file here gets plain words."""

from __future__ import annotations

from pipeline.report.claims import (
    batch_reactor,
    henson_seborg_cstr,
    jacketed_batch_reactor,
    ph_neutralization,
    reversible_cstr,
    thiosulfate_cstr,
)
from pipeline.report.verdicts import Claims, plain_reason

CLAIMS: dict[str, Claims] = {
    "thiosulfate_cstr": thiosulfate_cstr.CLAIMS,
    "ph_neutralization": ph_neutralization.CLAIMS,
    "batch_reactor": batch_reactor.CLAIMS,
    "henson_seborg_cstr": henson_seborg_cstr.CLAIMS,
    "jacketed_batch_reactor": jacketed_batch_reactor.CLAIMS,
    "reversible_cstr": reversible_cstr.CLAIMS,
}
PLAIN = Claims(plain_reason)

__all__ = ["CLAIMS", "PLAIN", "Claims"]
