"""The promotion gate: what a version must show before an alias moves to it.

The report stage writes into validation.json, for each law of a case, its gate score: the weighted
mean over the gate's scenarios of its error over that of the perfect-model NMPC, in the case's metric
(mean absolute or squared), both at least what the measurement noise would hide, so lower is better
and 1 is the bound. On a person's own simulator, which has no NMPC, the error of the case's baseline
takes its place, and without one the error that noise can hide. ``Gate.id`` is a digest of scenarios,
weights and the errors that are divided by: scores of different ids
were measured on different tests and are never compared.

Aliases:

``candidate``
    the newest version of a controller.
``best``
    the best version of a controller that passed the gate. It moves only to a version that did not
    lock up in any run, whose score is below that of the case's baseline in the same validation, and
    below that of the present best version. The baseline has only its own former version to beat.
    On an own plant the record must prove the models that it was tested on, ``Gate.unproven``, and where the
    loop is known that the plant was run by before, no test may have a larger error than under that, ``Gate.worse``.
    An own plant whose baseline was not designed or locked up has none to beat; ``Gate.no_baseline``
    says why.
``champion``
    one in a case: the best version with the lowest score among the case's controllers, or the one
    that a person promoted. A controller whose closed loop swings to the end of a test without
    noise stands behind all that do not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from loopwright.pipeline.evaluation.law_evidence import lock_up_text, without_noise
from loopwright.pipeline.evaluation.validation import GateResult, Validation


@dataclass(frozen=True, slots=True)
class Gate:
    """The gate's figures of one law, from the case's validation.json."""

    law: str
    id: str = ""
    score: float | None = None
    baseline: float | None = None  # the baseline's score on the same test
    lock_ups: int | None = None
    ratios: Mapping[str, float] = field(default_factory=dict)
    baseline_law: str = ""  # as the case names it
    baseline_name: str = ""
    locked_up: str = ""  # on which tests, of which data seeds
    no_baseline: str = ""  # why an own plant has no baseline to beat
    reference: str = "the bound"  # what the score is a multiple of
    times: str = "× NMPC"  # the same, short
    unproven: tuple[str, ...] = ()  # why the record of an own plant does not prove the models of the tests
    doubt: str = ""  # why a model of the record of an own plant is doubtful, by its screening
    swings: str = ""  # tests without noise, of which data seeds, in which a closed loop swings to the end
    worse: tuple[str, ...] = ()  # tests with a larger error than under the loop that the plant was run by before
    withheld: str = ""  # why it is not shipped, a clause after its name

    @classmethod
    def of(cls, validation: Validation | None, law: str) -> Self:
        """The figures of ``law``; scores are None where the validation, or the whole of it, is missing."""
        if validation is None:
            return cls(law)
        gate, absent = validation.gate, GateResult(None, None, {})
        own, baseline = gate.laws.get(law, absent), gate.laws.get(gate.baseline, absent)
        result = validation.laws.get(law)
        locked_up = "" if result is None else lock_up_text(result.locked_up)
        return cls(
            law,
            gate.id,
            own.score,
            baseline.score,
            own.lock_ups,
            own.ratios,
            gate.baseline,
            gate.baseline_name,
            locked_up,
            gate.no_baseline,
            gate.reference,
            gate.times,
            () if validation.grounds is None else validation.grounds.unproven,
            "" if validation.grounds is None else validation.grounds.doubt,
            "" if result is None else lock_up_text(without_noise(result.swings)),
            own.worse,
            "" if result is None else result.withheld,
        )

    def tags(self) -> dict[str, str]:
        """The gate as tags of a model version."""
        rows: dict[str, Any] = {
            "gate_id": self.id,
            "gate_score": self.score,
            "gate_baseline": self.baseline_law or None,
            "gate_baseline_score": self.baseline,
            "gate_no_baseline": self.no_baseline or None,
            "gate_relative_to": None if self.reference == "the bound" else self.times,
            "unproven": "; ".join(self.unproven) or None,
            "data": self.doubt or None,
            "lock_ups": self.lock_ups,
            "locked_up": self.locked_up or None,
            "swings": self.swings or None,
            "worse_than_old_loop": ", ".join(self.worse) or None,
            **{f"gate_{scenario}": ratio for scenario, ratio in self.ratios.items()},
        }
        return {k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in rows.items() if v is not None}

    def refusal(self) -> str | None:
        """Why no version with these figures passes the gate, whichever is the best so far; None if one does."""
        if self.score is None or self.lock_ups is None:
            return "its validation has no gate score"
        if self.lock_ups:
            return f"it locked up in {self.lock_ups} of its closed loops"
        if self.withheld:
            return f"it {self.withheld}"
        if self.unproven:
            return "; ".join(self.unproven)
        if self.worse:
            return f"its error is larger than under the old loop in {', '.join(self.worse)}"
        if self.law == self.baseline_law or self.no_baseline:
            return None
        if self.baseline is None:
            return f"no {self.baseline_name} was validated beside it"
        if self.score >= self.baseline:
            return f"its gate score {self.score:.4g} does not beat the {self.baseline_name}'s {self.baseline:.4g}"
        return None

    def refusal_against(self, best: Mapping[str, str]) -> str | None:
        """Why the version that has these tags stays the best one; None if this one takes its place."""
        if best.get("gate_id") != self.id:
            return "the best version was measured on another gate; compare them and promote by hand"
        if self.swings and not best.get("swings"):
            return f"it swings to the end in {self.swings}, and the best version in no test"
        if best.get("swings") and not self.swings and self.score is not None:
            return None
        held = float(best.get("gate_score", "inf"))
        if self.score is None or self.score >= held:
            return f"its gate score {self.score} does not beat the best version's {held:.4g}"
        return None


@dataclass(frozen=True, slots=True)
class Rank:
    """Where a law stands among the laws of its case: by the gate, then swinging to no end, then the lowest score."""

    place: int
    of: int
    refusal: str | None

    @classmethod
    def of_laws(cls, validation: Validation | None) -> dict[str, Self]:
        """The rank of every law that has a score."""
        gates = [Gate.of(validation, law) for law in (validation.gate.laws if validation else ())]
        scored = [g for g in gates if g.score is not None]
        scored.sort(key=lambda g: (g.refusal() is not None, bool(g.swings), g.score, g.law))
        return {g.law: cls(place, len(scored), g.refusal()) for place, g in enumerate(scored, 1)}
