"""Why ``loopwright new`` does not add a plant that it has screened."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.commands.new_commands import unvisited
from pipeline.historian.screening import Screened
from pipeline.historian.tags import Tag


def refusal(found: Screened, tags: Sequence[Tag], anyway: bool) -> str:
    """Why the plant is not added; empty where it is."""
    record, verdict = found.record, found.report.verdict
    for signal, values in zip(record.mv_signals, record.mv.T, strict=True):
        if float(values.max() - values.min()) <= 1e-9 * (signal.high - signal.low):
            return f"{signal.name} is {values[0]:g} {signal.unit} in every row; run the step test in step_test.csv"
        if words := unvisited(signal, values, tags):
            return words
    if verdict.rows < verdict.parameters:
        return f"{verdict.reasons[0]}; with fewer rows than parameters --anyway does not help"
    if verdict.carries == "no" and not anyway:
        return f"{verdict.reasons[0]}; run the step test in step_test.csv, or give --anyway"
    return ""
