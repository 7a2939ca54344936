"""Verdicts in words: the paper's figures, the requirements and the claims, compared with the measured figures."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.pipeline.evaluation.case import Curve, PaperFigure, PaperTable, Requirement
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.validation import Statement
from loopwright.pipeline.evaluation.verdicts import ABSOLUTE, RELATIVE, Claims, Reason, close, plain_reason
from loopwright.pipeline.pictures.drawing import curve_label, number
from loopwright.pipeline.report.own_acceptance import own_acceptance

FINE = 5  # digits shown of a figure that has to be near
RULE = (
    f"A figure reproduces if it differs from the paper's by at most {100 * RELATIVE:g} %, by at most {ABSOLUTE:g} in "
    "its unit, or by at most the tolerance in its row. Our figures are medians over the data seeds; the models of each "
    "seed are trained on a record of their own."
)
BOUNDS = {"nmpc": "perfect-model NMPC", "offline": "offline optimum"}


@dataclass(frozen=True, slots=True)
class TableRow:
    """A figure of the paper's tables beside ours, the median, least and largest over the data seeds."""

    label: str
    metric: str
    paper: float
    ours: float | None
    low: float | None
    high: float | None
    verdict: str
    holds: bool | None
    digits: int  # to be shown of its numbers


@dataclass(frozen=True, slots=True)
class Judged:
    """A case compared with its paper: the paper's tables, the requirements, and the paper's statements."""

    tables: tuple[tuple[PaperTable, tuple[TableRow, ...]], ...]
    acceptance: tuple[Statement, ...]
    statements: tuple[Statement, ...]


def judge(evidence: Evidence, claims: Claims) -> Judged:
    """All verdicts of a case; each check runs once."""
    # The case's reasons are about the paper's record, not about a user's own.
    reason = plain_reason if evidence.own_data else claims.reason
    tables = tuple((t, tuple(table_row(row, evidence, reason) for row in t.rows)) for t in evidence.case.tables)
    statements = tuple(check.statement(evidence) for check in claims.statements)
    return Judged(tables, tuple(acceptance(evidence, claims)), statements)


def table_row(row: PaperFigure, evidence: Evidence, reason: Reason) -> TableRow:
    """One row of a paper's table, judged."""
    ours, low, high = (
        evidence.figure(row.law, row.scenario, row.metric, row.setting, how) for how in ("median", "min", "max")
    )
    if ours is None:
        holds = None
        what = "this setting was not validated" if row.scenario else f"no such figure of {row.law}"
        verdict = f"not measured: {what}"
    elif holds := close(ours, row.paper, row.within):
        verdict = "reproduces" + ("" if row.within is None else f" within {row.within:.2g}")
    else:
        verdict = f"does not, because {reason(row, ours, evidence)}"
    metric, digits = evidence.case.label(row.metric), 3 if row.within is None else FINE
    return TableRow(row.label, metric, row.paper, ours, low, high, verdict, holds, digits)


def acceptance(evidence: Evidence, claims: Claims) -> list[Statement]:
    """The whole acceptance list: the case's requirements, the common ones, and the case's own checks.

    The common ones of an own plant are ``own_acceptance``.
    """
    best = evidence.laws[evidence.best] if evidence.best else None
    seeds = 1 if evidence.own_data else evidence.case.data_seeds  # a user's data are one record
    locked = ", ".join(f"{name} {law.lock_ups}" for name, law in evidence.laws.items())
    common = [
        Statement(
            "best controller, data seeds",
            f"≥ {seeds}",
            "every law locks up" if best is None else str(best.seeds),
            best is not None and best.seeds >= seeds,
        ),
        Statement(
            "best controller, lock-ups over all seeds and scenarios",
            "0",
            "every law locks up" if best is None else str(best.lock_ups),
            best is not None and best.lock_ups == 0,
            f"lock-ups of all laws: {locked}",
        ),
    ]
    if evidence.case.on_models:
        common = own_acceptance(evidence)
    rows = [requirement(need, evidence) for need in evidence.case.requirements]
    return [*rows, *common, *(check.statement(evidence) for check in claims.acceptance)]


def requirement(need: Requirement, evidence: Evidence) -> Statement:
    """One row of the acceptance list; the limit of a ratio is its factor times the bound's figure.

    Without a measured figure or without the bound, ``holds`` is None.
    """
    metric, law = evidence.case.metrics[need.metric], need.law or evidence.best
    unit = f" {found}" if (found := metric.unit_of(evidence.case.cv_unit)) else ""
    who = curve_label(evidence, Curve(need.law, need.setting)) if need.law else f"best controller ({law or 'none'})"
    high: float | None = need.high
    if need.times is None:
        limit = f"{metric.short} ≤ {number(need.high, 6)}{unit}"
    else:
        bound = evidence.bound(need.scenario, need.metric, need.times)
        high = None if bound is None else need.high * bound
        limit = f"{metric.short} ≤ {need.high:g} × {BOUNDS.get(need.times, need.times)}"
        limit += "" if high is None else f" = {number(high, 4)}{unit}"
    if need.low:
        limit = f"{number(need.low, 6)} ≤ {limit}"
    value = None if law is None else evidence.figure(law, need.scenario, need.metric, need.setting)
    what, holds = f"{who}, {need.scenario}", None
    if high is None:
        measured = "the bound is missing"
    elif value is None:
        measured = "not measured"
    else:
        measured, holds = f"{number(value, 4)}{unit}", need.low <= value <= high
        if need.times is not None and high:
            measured += f" ({value / high * need.high:.3f} ×)"
    return Statement(what, limit, measured, holds)
