"""From evidence and verdicts to validation.json, with the gate that decides about champions."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.validation import (
    Analysis,
    GateRecord,
    GateResult,
    LawResult,
    PaperResult,
    Row,
    Titles,
    Validation,
)
from pipeline.evaluation.verdicts import Judged
from pipeline.pictures.words import law_name
from pipeline.report.verdict_words import statement, table_row
from pipeline.simulation.scenario import NOISE_SUFFIX

DEFAULT = "mae"  # the metric that the digests of gates leave out


def validation(evidence: Evidence, judged: Judged) -> Validation:
    """What programs are told of a case."""
    case = evidence.case
    scenarios: dict[str, dict[str, Row]] = {}
    for name in (n + end for end in ("", NOISE_SUFFIX) for n in evidence.scenarios):
        rows = {law: _row(evidence, law, name) for law in evidence.laws if evidence.figure(law, name) is not None}
        if rows:
            scenarios[name] = rows
    return Validation(
        case=case.name,
        metric=case.metric,
        best=evidence.best,
        main=evidence.main_test,
        scenarios=scenarios,
        bounds=evidence.bounds,
        gate=_gate(evidence),
        laws={law: _law(evidence, law) for law in evidence.laws},
        titles=Titles(
            case=case.title,
            metric=case.criterion.long,
            metric_short=case.criterion.short,
            figures={metric.name: metric.label(case.cv_unit) for metric in case.own_metrics},
            laws={name: law.title for name, law in evidence.laws.items()},
            scenarios=evidence.scenarios,
        ),
        requirements=tuple(statement(v, evidence) for v in judged.acceptance),
        claims=tuple(statement(v, evidence) for v in judged.statements),
        paper=tuple(
            PaperResult(table.number, row.label, row.metric, row.paper, row.ours, row.verdict, row.holds)
            for table, verdicts in judged.tables
            for row in (table_row(v, evidence) for v in verdicts)
        ),
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


def _law(evidence: Evidence, law: str) -> LawResult:
    found = evidence.laws[law]
    return LawResult(
        seeds=found.seeds,
        lock_ups=found.lock_ups,
        step_us=found.step_us,
        locked_up=found.locked_up,
        as_printed=found.as_printed,
        analysis={
            form or "base": Analysis(said.get("figures") or {}, tuple(said.get("notes") or ()))
            for form, said in found.analyses.items()
        },
    )


def _gate(evidence: Evidence) -> GateRecord:
    case = evidence.case
    return GateRecord(
        id=gate_id(evidence),
        weights=case.gate,
        baseline=case.baseline,
        baseline_name=law_name(case.baseline),
        floor=evidence.noise,
        floors=evidence.floors,
        laws={
            law: GateResult(
                evidence.score(law),
                found.lock_ups,
                {s: r for s in case.gate if (r := evidence.gate_ratio(law, s)) is not None},
            )
            for law, found in evidence.laws.items()
        },
    )


def gate_id(evidence: Evidence) -> str:
    """Digest of what the gate measures: scores of different ids may not be compared."""
    case, tests = evidence.case, evidence.tests
    what: dict[str, Any] = {
        s: [w, evidence.bound(s), [t.digest() for t in tests.get(s.removesuffix(NOISE_SUFFIX), ())]]
        for s, w in case.gate.items()
    }
    what["floor"] = evidence.noise
    if case.metric != DEFAULT:
        what["metric"] = case.metric
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]
