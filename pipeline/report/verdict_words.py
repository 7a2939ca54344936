"""Verdicts in words: what was asked, what was measured, and what a person reads of a figure of the paper."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.validation import Statement
from pipeline.evaluation.verdicts import ABSOLUTE, RELATIVE, Met, Reproduction, Verdict
from pipeline.pictures.words import law_label, number

FINE = 5  # digits shown of a figure that has to be near
RULE = (
    f"A figure reproduces when it lies within {100 * RELATIVE:g} % of the paper's or within {ABSOLUTE:g} of it "
    "(in its own unit), or within what its row names. Ours are medians over the data seeds, whose models were each "
    "learnt from another record."
)
BOUNDS = {"nmpc": "perfect NMPC", "offline": "offline optimum"}


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row of one of the paper's tables beside ours, as a page shows it."""

    label: str
    metric: str
    paper: float | None
    ours: float | None
    low: float | None
    high: float | None
    independent: float | None
    verdict: str
    holds: bool | None
    digits: int  # to be shown of its numbers


def table_row(found: Reproduction, evidence: Evidence) -> TableRow:
    """A figure of the paper's tables with its verdict in words."""
    row, digits = found.figure, 3 if found.figure.within is None else FINE
    if found.holds is None:
        what = "this setting was not validated" if row.scenario else f"no such figure of {row.law}"
        verdict = f"not measured: {what}"
    elif found.holds:
        verdict = "reproduces" + ("" if row.within is None else f" within {row.within:.2g}")
    else:
        verdict = f"does not, because {found.reason}"
        if found.as_independent and row.independent is not None:
            verdict += f"; an independent implementation found {number(row.independent, max(digits, 4))} too"
    return TableRow(
        label=row.label,
        metric=evidence.case.label(row.metric),
        paper=row.paper if row.printed else None,
        ours=found.ours,
        low=found.low,
        high=found.high,
        independent=row.independent,
        verdict=verdict,
        holds=found.holds,
        digits=digits,
    )


def statement(verdict: Verdict | Met, evidence: Evidence) -> Statement:
    """A requirement or a claim as a page shows it."""
    if isinstance(verdict, Verdict):
        holds = None if verdict.holds is None else bool(verdict.holds)
        return Statement(verdict.what, verdict.limit, verdict.measured, holds, verdict.because)
    return Statement(_who(verdict), _limit(verdict, evidence), _measured(verdict, evidence), verdict.holds)


def _who(verdict: Met) -> str:
    """Who is meant: a law with its setting, or the best controller by name; and in which test."""
    need = verdict.need
    who = law_label(need.law, need.setting) if need.law else f"best controller ({verdict.law or 'none'})"
    return f"{who}, {need.scenario}"


def _limit(verdict: Met, evidence: Evidence) -> str:
    """What was asked; the limit of a ratio is its factor times the bound's figure."""
    need, unit = verdict.need, _unit(verdict, evidence)
    short = verdict.metric.short
    if need.times is None:
        limit = f"{short} ≤ {number(need.high, 6)}{unit}"
    else:
        limit = f"{short} ≤ {need.high:g} × {BOUNDS.get(need.times, need.times)}"
        if verdict.high is not None:
            limit += f" = {number(verdict.high, 4)}{unit}"
    return f"{number(need.low, 6)} ≤ {limit}" if need.low else limit


def _measured(verdict: Met, evidence: Evidence) -> str:
    if verdict.high is None:
        return "the bound is missing"
    if verdict.measured is None:
        return "not measured"
    measured = f"{number(verdict.measured, 4)}{_unit(verdict, evidence)}"
    if verdict.need.times is not None and verdict.high:
        measured += f" ({verdict.measured / verdict.high * verdict.need.high:.3f} ×)"
    return measured


def _unit(verdict: Met, evidence: Evidence) -> str:
    unit = verdict.metric.unit_of(evidence.case.cv_unit)
    return f" {unit}" if unit else ""
