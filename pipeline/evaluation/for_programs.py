"""validation.json: the figures of a case for programs, with the gate that decides about champions."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.verdicts import Judged, Verdict
from pipeline.pictures.words import LONG, SHORT, law_name
from pipeline.simulation.scenario import NOISE_SUFFIX


def validation(evidence: Evidence, judged: Judged) -> dict[str, Any]:
    """Figures by scenario and law, bounds, gate, verdicts and titles; ``metric`` is the one that laws are compared by.

    ``gate.floor`` is the standard deviation of the noise, ``gate.floors`` what it makes of each
    scenario in the case's metric; ``main`` is the test that weighs most. ``laws`` holds what was
    found of a law apart from its tests. ``requirements``, ``claims`` and ``paper`` (the figures of
    the paper's tables) are verdicts: ``holds`` is null where nothing was measured.
    """
    case = evidence.case
    scenarios: dict[str, dict[str, Any]] = {}
    for name in (n + end for end in ("", NOISE_SUFFIX) for n in evidence.scenarios):
        rows = {law: _row(evidence, law, name) for law in evidence.laws if evidence.figure(law, name) is not None}
        if rows:
            scenarios[name] = rows
    return {
        "case": case.name,
        "metric": case.metric,
        "best": evidence.best,
        "scenarios": scenarios,
        "bounds": {name: {k: dict(v) for k, v in kinds.items()} for name, kinds in evidence.bounds.items()},
        "gate": {
            "id": gate_id(evidence),
            "weights": dict(case.gate),
            "baseline": case.baseline,
            "baseline_name": law_name(case.baseline),
            "floor": evidence.noise,
            "floors": evidence.floors,
            "laws": {
                law: {
                    "score": evidence.score(law),
                    "lock_ups": found.lock_ups,
                    "ratios": {s: r for s in case.gate if (r := evidence.gate_ratio(law, s)) is not None},
                }
                for law, found in evidence.laws.items()
            },
        },
        "main": evidence.main_test,
        "laws": {law: _law(evidence, law) for law in evidence.laws},
        "requirements": [_verdict(v) for v in judged.acceptance],
        "claims": [_verdict(v) for v in judged.statements],
        "paper": [
            {
                "table": table.number,
                "label": row.label,
                "metric": row.metric,
                "paper": row.paper,
                "ours": row.ours,
                "verdict": row.verdict,
                "holds": row.holds,
            }
            for table, rows in judged.tables
            for row in rows
        ],
        "titles": {
            "case": case.title,
            "metric": LONG[case.metric],
            "metric_short": SHORT[case.metric],
            "figures": dict(case.metric_words),
            "laws": {name: law.title for name, law in evidence.laws.items()},
            "scenarios": evidence.scenarios,
        },
    }


def _row(evidence: Evidence, law: str, scenario: str) -> dict[str, Any]:
    row: dict[str, Any] = {metric: evidence.figure(law, scenario, metric) for metric in evidence.metrics}
    row = {metric: value for metric, value in row.items() if value is not None}
    row["seeds"] = evidence.laws[law].seeds
    for how in ("min", "max"):
        row[f"{evidence.case.metric}_{how}"] = evidence.figure(law, scenario, None, None, how)
    return row


def _law(evidence: Evidence, law: str) -> dict[str, Any]:
    found = evidence.laws[law]
    analysis = {form or "base": dict(said) for form, said in found.analyses.items()}
    row = {"seeds": found.seeds, "lock_ups": found.lock_ups, "step_us": found.step_us}
    return {**row, "analysis": analysis} if analysis else row


def _verdict(verdict: Verdict) -> dict[str, Any]:
    """A requirement, whose ``limit`` is what was asked, or a claim, which has none."""
    return {
        "what": verdict.what,
        "limit": verdict.limit,
        "measured": verdict.measured,
        "holds": None if verdict.holds is None else bool(verdict.holds),
        "because": verdict.because,
    }


def gate_id(evidence: Evidence) -> str:
    """Digest of what the gate measures: scores of different ids may not be compared."""
    case, tests = evidence.case, evidence.tests
    what: dict[str, Any] = {
        s: [w, evidence.bound(s), [t.digest() for t in tests.get(s.removesuffix(NOISE_SUFFIX), ())]]
        for s, w in case.gate.items()
    }
    what["floor"] = evidence.noise
    if case.metric != "mae":
        what["metric"] = case.metric
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]
