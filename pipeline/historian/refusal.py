"""Why a screened record is not used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from loopwright.pipeline.historian.few_levels import on_off
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.historian.tags import Tag, commanded_range
from loopwright.pipeline.metrics import Array
from loopwright.serving.manifest import Signal

LEAST_SHARED = 0.05  # of the commanded or the visited range, the smaller one: what both must share


@dataclass(frozen=True, slots=True)
class Refusal:
    """Faults of a record, and the remedies."""

    why: str
    step_test: bool = False  # a step test gives a better one
    anyway: bool = False  # a person may use it all the same


def refusal(found: Screened, tags: Sequence[Tag], anyway: bool) -> Refusal | None:
    """Why the record is not used; None where it is."""
    record, verdict = found.record, found.report.verdict
    for signal, values in zip(record.mv_signals, record.mv.T, strict=True):
        if float(values.max() - values.min()) <= 1e-9 * (signal.high - signal.low):
            return Refusal(f"{signal.name} is {values[0]:g} {signal.unit} in every row", step_test=True)
        if words := unvisited(signal, values, tags):
            return Refusal(words)
    if (switched := on_off(record, tags)) and not anyway:
        return Refusal(switched[0], anyway=True)
    if verdict.rows < verdict.parameters:
        return Refusal(f"{verdict.reasons[0]}; with fewer rows than parameters --anyway does not help")
    if verdict.carries == "no" and not anyway:
        return Refusal(verdict.reasons[0], step_test=True, anyway=True)
    return None


def unvisited(signal: Signal, values: Array, tags: Sequence[Tag]) -> str:
    """Why an MV cannot be commanded as wished: its record (n,) hardly went there; empty where it can."""
    low, high = commanded_range(signal, tags)
    least, most = float(values.min()), float(values.max())
    if min(most, high) - max(least, low) >= LEAST_SHARED * min(most - least, high - low):
        return ""
    return (
        f"{signal.name} may be commanded from {low:g} to {high:g} {signal.unit}, but moved only from {least:g} to "
        f"{most:g} in the record, so nothing is known of the plant there; widen command_low or command_high, or add a "
        "record of that range"
    )
