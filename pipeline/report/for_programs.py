"""From evidence and verdicts to validation.json, with the gate that decides about champions."""

from __future__ import annotations

from typing import Any

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import LawEvidence, Row
from loopwright.pipeline.evaluation.validation import GateRecord, GateResult, LawResult, PaperResult, Titles, Validation
from loopwright.pipeline.files import digest
from loopwright.pipeline.pictures.drawing import law_name
from loopwright.pipeline.report.verdicts import Judged
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

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
            figures={metric.name: metric.label(case.cv_unit) for metric in case.own_metrics},
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
