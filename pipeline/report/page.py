"""From evidence to report.html, report.md and validation.json."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.law_evidence import lock_up_text
from pipeline.evaluation.metric import NO_UNIT
from pipeline.evaluation.model_evidence import candidates, model_rows
from pipeline.evaluation.validation import FILE
from pipeline.evaluation.verdicts import Claims, Judged, judge
from pipeline.optimal.bounds import bounded
from pipeline.pictures.words import law_name, number, ratio, scenario_name
from pipeline.report.figures import draw_all, main_words
from pipeline.report.for_programs import validation
from pipeline.report.templating import REGISTRY_URL, render, write_pages
from pipeline.report.verdict_words import RULE, statement, table_row
from pipeline.simulation.scenario import NOISE_SUFFIX

MOST_HEADLINES = 5


def write_report(evidence: Evidence, claims: Claims, models: Path, out: Path) -> list[Path]:
    """Write validation.json, figures/, report.html and report.md into ``out``; returns their paths."""
    out.mkdir(parents=True, exist_ok=True)
    judged = judge(evidence, claims)
    pictures = draw_all(evidence, out / "figures", models, claims.pictures)
    content = context(evidence, claims, judged, pictures)
    pages = {name: render(f"{name}.j2", content) for name in ("report.html", "report.md")}
    written = write_pages(out, {FILE: validation(evidence, judged).to_json(), **pages})
    return [*written, *(out / "figures" / name for name in pictures)]


def context(evidence: Evidence, claims: Claims, judged: Judged, pictures: Mapping[str, str]) -> dict[str, Any]:
    """Everything that the templates show."""
    case, own = evidence.case, [f"{picture.name}.png" for picture in claims.pictures]
    models = [row for name, model in evidence.models.items() for row in model_rows(name, model)]

    def of_kind(start: str) -> dict[str, str]:
        return {k: v for k, v in pictures.items() if k.startswith(start) and k not in own}

    return {
        "case": case,
        "evidence": evidence,
        "metric": case.criterion,
        "noise": "true output, noisy measurement"
        + (f", mean of {draws} draws" if (draws := case.noise_draws) > 1 else ""),
        "floor": _floor(evidence),
        "best": (best := evidence.laws.get(evidence.best or "")),
        "seeds": "" if best is None else _seeds(best.seeds),
        "headline": headline(evidence),
        "pictures": of_kind("figure_"),
        "own_pictures": {k: v for k, v in pictures.items() if k in own},
        "loops": of_kind("closed_loop_"),
        "sweeps": of_kind("sweep_") | of_kind("candidates_"),
        "overview": pictures.get("closed_loop.png"),
        "main_test": main_words(evidence)[0],
        "tables": [(table, [table_row(row, evidence) for row in rows]) for table, rows in judged.tables],
        "rule": RULE,
        "acceptance": [statement(v, evidence) for v in judged.acceptance],
        "met": sum(v.holds is True for v in judged.acceptance),
        "statements": [statement(v, evidence) for v in judged.statements],
        "locked": [_locked(evidence, law) for law, own in evidence.laws.items() if own.lock_ups],
        "laws": [_law(evidence, law) for law in evidence.laws],
        "scenarios": _rows(evidence),
        "further": _further(evidence),
        "analyses": _analyses(evidence),
        "bound_notes": _bound_notes(evidence),
        "bounded": any(evidence.bound(name) is not None for name in evidence.scenarios),
        "models": models,
        "free_run": any(row["free_run"] is not None for row in models),
        "candidates": [table for name, model in evidence.models.items() for table in candidates(name, model)],
        "step_ms": evidence.bound(evidence.main_test, "step_ms_p50"),
        "registry": REGISTRY_URL,
    }


def _bound_notes(evidence: Evidence) -> list[str]:
    """What a reader of the bounds must know: tests that have none, and optima that no search improved on."""
    bounds = evidence.bounds
    lacking = {
        kind: [
            n for n, tests in evidence.tests.items() if bounded(evidence.case, tests) and kind not in bounds.get(n, {})
        ]
        for kind in ("nmpc", "offline")
    }
    words = {"nmpc": "The perfect-model NMPC", "offline": "The offline optimum"}
    notes = [f"{words[kind]} was not computed for: {', '.join(names)}." for kind, names in lacking.items() if names]
    taken = [n for n, of in bounds.items() if of.get("offline", {}).get("from_nmpc")]
    if taken:
        notes.append(
            f"No plan better than the NMPC was found, whose figures stand for the optimum: {', '.join(taken)}."
        )
    return notes if bounds else []


def _seeds(count: int) -> str:
    return "one data seed" if count == 1 else f"{count} data seeds, each with models of its own"


def _floor(evidence: Evidence) -> str:
    """What the gate takes for perfect, in words."""
    floor = evidence.case.criterion.floor
    return "" if floor is None else floor.text.format(noise=evidence.noise)


def headline(evidence: Evidence) -> list[tuple[str, str]]:
    """The figures that stand at the top: value and what it is.

    The best controller beside the bound on the test that weighs most, then on each test of the
    case's requirements for it, and beside the case's baseline.
    """
    best, case = evidence.best, evidence.case
    if best is None:
        return []
    bounds = {"nmpc": "perfect-model NMPC", "offline": "offline optimum"}
    needs = [n for n in case.requirements if n.law in (None, best) and not n.low and not n.setting]
    asked = [(evidence.main_test, "nmpc"), *((n.scenario, n.times or "nmpc") for n in needs if n.metric == case.metric)]
    name_of = partial(scenario_name, recipe=case.recipe, own=case.test_words)
    rows = []
    for name, kind in dict.fromkeys(asked):
        value = evidence.ratio(best, name, kind)
        if value is not None:
            rows.append(
                (
                    ratio(value),
                    f"× {case.criterion.short} of the {bounds.get(kind, kind)} on {name_of(name)}",
                )
            )
    for need in needs:
        late = evidence.figure(best, need.scenario, need.metric) if need.metric == "sse_late" else None
        if late is not None:
            where = name_of(need.scenario)
            rows.append(
                (number(late), f"{case.metrics[need.metric].short} on {where}; at most {number(need.high)} is asked")
            )
    rows = rows[:MOST_HEADLINES]
    late_s = evidence.late_s(evidence.main_test)
    metric = "sse_late" if late_s else case.metric
    own, other = (evidence.figure(law, evidence.main_test, metric) for law in (best, case.baseline))
    if own and other and own < other:
        where = name_of(evidence.main_test) + (f", from {late_s:g} s on" if late_s else "")
        rows.append(
            (
                f"{100 * (1 - own / other):.0f} %",
                f"lower {case.criterion.long} than the {law_name(case.baseline)} on {where}",
            )
        )
    return rows


def _locked(evidence: Evidence, law: str) -> dict[str, str]:
    """A law that locked up, on which tests, and why it is shipped all the same."""
    own = evidence.laws[law]
    return {
        "law": law,
        "loops": "one closed loop" if own.lock_ups == 1 else f"{own.lock_ups} closed loops",
        "tests": lock_up_text(own.locked_up),
        "why": "; shipped as printed, to reproduce the paper" if own.as_printed else "",
    }


def _law(evidence: Evidence, law: str) -> dict[str, Any]:
    found = evidence.laws[law]
    setting = found.metrics.get("setting") or {}
    return {
        "name": law,
        "title": found.title,
        "setting": ", ".join(f"{k} = {v}" for k, v in setting.items()),
        "score": evidence.score(law),
        "lock_ups": found.lock_ups,
        "seeds": found.seeds,
        "step_us": found.step_us,
    }


def _rows(evidence: Evidence) -> list[dict[str, Any]]:
    """The big table: each test in the case's metric, its late part where it has one, and the MV's travel at the end."""
    case = evidence.case
    rows = []
    for name, title in evidence.scenarios.items():
        rows.append(_row(evidence, name, title, case.metric))
        if late_s := evidence.late_s(name):
            rows.append(_row(evidence, name, f"{title}, from {late_s:g} s on", "sse_late"))
    mv, *others = case.plant_class.mv_signals
    unit = ", all MVs together" if others else "" if mv.unit in NO_UNIT else f" [{mv.unit}]"
    return [*rows, _row(evidence, evidence.main_test, f"MV travel{unit}: {evidence.main_title}", "mv_travel")]


def _further(evidence: Evidence) -> list[dict[str, Any]]:
    """Of each test the figures that the case has named beside its own: each law's median, and with noise."""
    case, found = evidence.case, []
    for name, title in evidence.scenarios.items():
        rows = [
            (metric.label(case.cv_unit), _row(evidence, name, title, metric.name)["cells"])
            for metric in case.own_metrics
            if metric.name != case.metric
        ]
        rows = [(metric, cells) for metric, cells in rows if any(c["value"] is not None for c in cells.values())]
        if rows:
            found.append({"name": name, "title": title, "rows": rows})
    return found


def _analyses(evidence: Evidence) -> list[dict[str, Any]]:
    """Of each law that tells of an analysis: its figures, a column for every form, and its notes."""
    found = []
    for law, own in evidence.laws.items():
        forms = own.analyses
        if not forms:
            continue
        names = dict.fromkeys(name for said in forms.values() for name in said.get("figures") or {})
        notes: dict[str, list[str]] = {}
        for form, said in forms.items():
            for note in said.get("notes") or ():
                notes.setdefault(note, []).append(form)
        found.append(
            {
                "law": law,
                "title": own.title,
                "forms": [form or "as shipped" for form in forms],
                "rows": [
                    (evidence.case.label(n), [(said.get("figures") or {}).get(n) for said in forms.values()])
                    for n in names
                ],
                # A note that every form has needs no form beside it.
                "notes": [
                    (note, "" if len(of) == len(forms) else ", ".join(f or "as shipped" for f in of))
                    for note, of in notes.items()
                ],
            }
        )
    return found


def _row(evidence: Evidence, name: str, title: str, metric: str) -> dict[str, Any]:
    """A row of the big table: each law's figure, its range, with noise, and its ratio to the bound."""
    cells = {
        law: {
            "value": evidence.figure(law, name, metric),
            "low": evidence.figure(law, name, metric, None, "min"),
            "high": evidence.figure(law, name, metric, None, "max"),
            "noise": evidence.figure(law, name + NOISE_SUFFIX, metric),
            "ratio": evidence.ratio(law, name) if metric == evidence.case.metric else None,
        }
        for law in evidence.laws
    }
    known = {law: c["value"] for law, c in cells.items() if c["value"] is not None and metric != "mv_travel"}
    return {
        "name": name,
        "title": title,
        "cells": cells,
        "winner": min(known, key=lambda law: known[law] or 0.0, default=None),
        "nmpc": evidence.bound(name, metric),
        "nmpc_noise": evidence.bound(name + NOISE_SUFFIX, metric),
        "offline": evidence.bound(name, metric, "offline"),
    }
