"""Verdicts in words and for programs: figures of the paper, requirements and claims beside the measured figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from loopwright.pipeline.evaluation.case import Curve, PaperFigure, PaperTable, Requirement
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import LawEvidence, Row
from loopwright.pipeline.evaluation.metric import TRAVEL
from loopwright.pipeline.evaluation.validation import (
    CheckedStatement,
    GateRecord,
    GateResult,
    LawResult,
    PaperResult,
    Titles,
    Validation,
)
from loopwright.pipeline.evaluation.verdicts import ABSOLUTE, RELATIVE, Claims, Reason, close, plain_reason
from loopwright.pipeline.files import digest
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.pictures.words import curve_label, law_name
from loopwright.pipeline.report.operated_tables import operated_rows
from loopwright.pipeline.report.own_acceptance import own_acceptance
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

NEAR_DIGITS = 5  # digits shown of a figure that has to be near
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
    acceptance: tuple[CheckedStatement, ...]
    statements: tuple[CheckedStatement, ...]


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
    metric, digits = evidence.case.label(row.metric), 3 if row.within is None else NEAR_DIGITS
    return TableRow(row.label, metric, row.paper, ours, low, high, verdict, holds, digits)


def acceptance(evidence: Evidence, claims: Claims) -> list[CheckedStatement]:
    """The whole acceptance list: the case's requirements, the common ones, and the case's own checks.

    The common ones of an own plant are ``own_acceptance``.
    """
    best = evidence.laws[evidence.best] if evidence.best else None
    seeds = 1 if evidence.own_data else evidence.case.data_seeds  # a user's data are one record
    locked = ", ".join(f"{name} {law.lock_ups}" for name, law in evidence.laws.items())
    common = [
        CheckedStatement(
            "best controller, data seeds",
            f"≥ {seeds}",
            "every law locks up" if best is None else str(best.seeds),
            best is not None and best.seeds >= seeds,
        ),
        CheckedStatement(
            "best controller, lock-ups over all seeds and scenarios",
            "0",
            "every law locks up" if best is None else str(best.lock_ups),
            best is not None and best.lock_ups == 0,
            f"lock-ups of all laws: {locked}",
        ),
    ]
    if evidence.case.on_models:
        common = own_acceptance(evidence)
    common += operated_rows(evidence)
    rows = [requirement(need, evidence) for need in evidence.case.requirements]
    return [*rows, *common, *(check.statement(evidence) for check in claims.acceptance)]


def requirement(need: Requirement, evidence: Evidence) -> CheckedStatement:
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
    return CheckedStatement(what, limit, measured, holds)


DEFAULT = "mae"  # the metric that the digests of gates leave out


def validation(evidence: Evidence, judged: Judged) -> Validation:
    """The figures and verdicts of a case, for programs."""
    case = evidence.case
    tests = (n + end for end in ("", NOISE_SUFFIX) for n in evidence.scenarios)
    measured = {name: [law for law in evidence.laws if evidence.figure(law, name) is not None] for name in tests}
    scenarios = {n: {law: _row(evidence, law, n) for law in laws} for n, laws in measured.items() if laws}
    return Validation(
        case=case.name,
        metric=case.metric,
        best=evidence.best,
        main=evidence.main_test,
        scenarios=scenarios,
        bounds=evidence.bounds,
        gate=_gate(evidence),
        laws={name: _law(law, case.on_models) for name, law in evidence.laws.items()},
        titles=Titles(
            case=case.title,
            metric=case.criterion.long,
            metric_short=case.criterion.short,
            figures={metric.name: metric.label(case.cv_unit) for metric in (case.metrics[TRAVEL], *case.own_metrics)},
            laws={name: law.title for name, law in evidence.laws.items()},
            scenarios=evidence.scenarios,
            unit=case.unit,
        ),
        requirements=judged.acceptance,
        claims=judged.statements,
        paper=tuple(
            PaperResult(table.number, row.label, row.metric, row.paper, row.ours, row.verdict, row.holds)
            for table, rows in judged.tables
            for row in rows
        ),
        on_models=case.on_models,
        old_loop=case.old_loop,
        grounds=evidence.grounds,
    )


def _row(evidence: Evidence, law: str, scenario: str) -> Row:
    known = {metric: evidence.figure(law, scenario, metric) for metric in evidence.metrics}
    row = {metric: value for metric, value in known.items() if value is not None}
    row["seeds"] = evidence.laws[law].seeds
    for how in ("min", "max"):
        value = evidence.figure(law, scenario, None, None, how)
        if value is not None:
            row[f"{evidence.case.metric}_{how}"] = value
    return row


def _law(evidence: LawEvidence, on_models: bool) -> LawResult:
    own = evidence.metrics
    return LawResult(
        evidence.seeds,
        own.lock_ups,
        evidence.step_us,
        own.locked_up,
        own.as_printed,
        evidence.analyses,
        own.swings,
        evidence.why_withheld if on_models else "",
        own.cold_start,
        own.operated,
    )


def _gate(evidence: Evidence) -> GateRecord:
    case = evidence.case
    return GateRecord(
        id=gate_id(evidence),
        weights=case.weights,
        baseline=case.baseline,
        baseline_name=law_name(case.baseline),
        floor=evidence.noise,
        floors=evidence.floors,
        laws={
            law: GateResult(
                evidence.score(law),
                found.lock_ups,
                {s: r for s in case.weights if (r := evidence.gate_ratio(law, s)) is not None},
                evidence.worse_than_before(law),
            )
            for law, found in evidence.laws.items()
        },
        relative_to=evidence.relative_to,
        no_baseline=evidence.no_baseline,
    )


def gate_id(evidence: Evidence) -> str:
    """Digest of what the gate measures: scores of different ids may not be compared."""
    case, tests = evidence.case, evidence.tests
    what: dict[str, Any] = {
        s: [w, evidence.reference(s), [t.digest() for t in tests.get(s.removesuffix(NOISE_SUFFIX), ())]]
        for s, w in case.weights.items()
    }
    what["floor"] = evidence.noise
    if case.metric != DEFAULT:
        what["metric"] = case.metric
    return digest(what)[:12]
