"""An engineer's knowledge of the plant, as requirements: beside the model of its record, and as a question."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loopwright.pipeline.evaluation.model_evidence import Metrics, identified_part
from loopwright.pipeline.evaluation.validation import Statement

TIMES = 3.0
"""Answer that a record allows over the model's, up to which the model has the size that it needs."""

WHY = {
    "agrees": "the record by itself is certain of it",
    "open": "the record leaves it open and does not contradict it: it holds by the engineer's word",
    "model": "the model contradicts it, and the record is not certain: its tests run on a model that is doubtful here",
    "unused": "no model has this variable as an output, so that it is not used",
}


def known_rows(models: Mapping[str, Metrics]) -> list[Statement]:
    """A row for each statement of an engineer. ``models``: model set -> its metrics.json."""
    rows = []
    for of in _statements(identified_part(models).get("proof") or {}):
        used = "gain" in of
        measured = f"model {of['gain']:.3g} ± {of['spread']:.2g}" if used else "not compared"
        if used and of["direct"] is not None:
            measured += f"; one-step predictions, on the way there, {of['direct']:.3g} ± {of['sd']:.2g}"
        rows.append(
            Statement(
                f"what is known of the answer of {of['pv']} to {of['input']}",
                of["says"],
                measured,
                of["verdict"] in {"agrees", "open"} if used else None,
                of.get("question") or WHY[of["verdict"]],
            )
        )
    return rows


def question(models: Mapping[str, Metrics]) -> str:
    """The question on statements that the record is certain to contradict, to go on a sentence; empty without any."""
    asked = [of["question"] for of in _statements(identified_part(models).get("proof") or {}) if "question" in of]
    return f"not proven: {'; '.join(asked)}" if asked else ""


def known_of(proof: Mapping[str, Any], pv: str, mv: str) -> Mapping[str, Any]:
    """The statement on a pair that says a sign; empty where there is none."""
    return next((of for of in _statements(proof) if (of["pv"], of["input"]) == (pv, mv) and of["way"]), {})


def decides(known: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    """Whether a statement decides what the record leaves open of an answer (``Answer`` as a mapping).

    A sign alone is not enough for a controller: the model's size must be known too. Either somebody says the gain, and
    the model has it; or one-step predictions allow, to a standard deviation, no more than ``TIMES`` of the model's.
    """
    if not known or found["verdict"] != "uncertain" or known["way"] * found["model"] <= 0:
        return False
    if known["verdict"] in {"model", "contradicted"}:
        return False
    told = found["direct"] is not None and known["way"] * found["direct"] + found["sd"] <= TIMES * abs(found["model"])
    return bool(known["size"] or told)


def _statements(proof: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return list(proof.get("known") or ())
