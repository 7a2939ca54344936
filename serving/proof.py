"""Whether a controller was proven in closed loop, as far as the evidence in its own file says."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import isfinite
from typing import Any

from loopwright.serving.errors import NotProvenError
from loopwright.serving.manifest import Manifest


class Proof(Enum):
    """The verdict on the evidence of a file."""

    PROVEN = "proven"
    NONE = "no evidence"  # straight out of `design`, or of another maker
    LOCKED_UP = "locked up"
    MODEL = "model not proven"  # its tests ran on models that the plant's record does not prove


@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement, and why in words; ``why`` is empty for a controller that is proven."""

    proof: Proof
    why: str = ""

    @property
    def words(self) -> str:
        """To go on a sentence: ``not proven: ...``; empty for a controller that is proven."""
        return f"not proven: {self.why}" if self.why else ""


def judged(manifest: Manifest) -> Verdict:
    """The verdict on a controller.

    Proven is one whose file holds figures of closed loops, and says that none locked up; where they ran on models of a
    plant's record, nothing may speak against these models. Figures that missed a requirement are the report's matter.
    """
    evidence: dict[str, Any] = manifest.evidence
    lock_ups, grounds = evidence.get("lock_ups"), evidence.get("on")
    counted = type(lock_ups) is int and lock_ups >= 0
    if not (counted and (lock_ups or _has_figures(evidence.get("scenarios")))):
        return Verdict(Proof.NONE, "its file holds no evidence of closed loops")
    if lock_ups:
        return Verdict(Proof.LOCKED_UP, f"it locked up in {lock_ups} closed loop{'s' if lock_ups > 1 else ''}")
    unproven = grounds.get("unproven") if isinstance(grounds, dict) else None
    if unproven:
        reasons = unproven if isinstance(unproven, list) else [unproven]
        return Verdict(Proof.MODEL, "; ".join(str(reason).removeprefix("not proven: ") for reason in reasons))
    return Verdict(Proof.PROVEN)


def _has_figures(scenarios: Any) -> bool:
    """Whether a closed loop has a figure at all."""
    rows = scenarios.values() if isinstance(scenarios, dict) else ()
    figures = [figure for row in rows if isinstance(row, dict) for figure in row.values()]
    return any(type(figure) in (int, float) and isfinite(figure) for figure in figures)


def require_accepted(manifest: Manifest, accepted: bool) -> Verdict:
    """The verdict on a controller that is to write in AUTO. NotProvenError where it is not, and nobody accepts it."""
    verdict = judged(manifest)
    if verdict.why and not accepted:
        words = (
            f"{manifest.law} is {verdict.words}; AUTO needs your word for it: accept_unproven = true in loop.toml, or "
            "--accept-unproven at `loopwright loop mode` and `loop swap`"
        )
        raise NotProvenError(words, f"{manifest.law}: {verdict.why}")
    return verdict
