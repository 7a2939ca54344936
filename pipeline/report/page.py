"""From evidence to report.html, report.md and validation.json."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from pipeline.cases.base import NOISE_SUFFIX
from pipeline.report.claims import CLAIMS, PLAIN
from pipeline.report.evidence import Evidence
from pipeline.report.figures import draw_all
from pipeline.report.for_programs import validation
from pipeline.report.model_evidence import candidates, model_rows
from pipeline.report.verdicts import RULE, acceptance, paper_row, plain_reason, statements
from pipeline.report.words import LONG, NO_UNIT, SHORT, number, ratio, scenario_name

REGISTRY_URL = "http://127.0.0.1:5000/#/models"
MOST_HEADLINES = 5


def write_report(evidence: Evidence, models: Path, out: Path) -> list[Path]:
    """Write validation.json, figures/, report.html and report.md into ``out``; returns their paths."""
    out.mkdir(parents=True, exist_ok=True)
    pictures = draw_all(evidence, out / "figures", models)
    content = context(evidence, pictures)
    programs = json.dumps(validation(evidence), indent=1, allow_nan=False) + "\n"
    html, text = (
        _environment(end == "html").get_template(f"report.{end}.j2").render(content) for end in ("html", "md")
    )
    files = {"validation.json": programs, "report.html": html, "report.md": text}
    for name, body in files.items():
        draft = out / f"{name}.draft"
        draft.write_text(body, encoding="utf-8")
        os.replace(draft, out / name)
    return [*(out / name for name in files), *(out / "figures" / name for name in pictures)]


def _environment(html: bool) -> Environment:
    environment = Environment(
        loader=PackageLoader("pipeline.report"),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"figure": figure, "times": times, "cell": cell}
    return environment


def figure(value: float | None) -> str:
    """A number with three digits; a dash where nothing was measured."""
    return "–" if value is None else number(value)


def times(value: float | None) -> str:
    """A ratio with three digits, and one more where it comes near 1."""
    return "–" if value is None else number(value, 4 if abs(value - 1) < 0.01 else 3)


def cell(text: str) -> str:
    """Text that a cell of a Markdown table can hold."""
    return text.replace("|", "\\|").replace("\n", " ")


def context(evidence: Evidence, pictures: Mapping[str, str]) -> dict[str, Any]:
    """Everything that the templates show."""
    case, claims = evidence.case, CLAIMS.get(evidence.case.name, PLAIN)
    # What is known of the paper's record says nothing of a user's own.
    reason = plain_reason if evidence.own_data else claims.reason
    tables = [(table, [paper_row(row, evidence, reason) for row in table.rows]) for table in case.tables]
    accepted, said = acceptance(evidence, claims), statements(evidence, claims)

    models = [row for name, model in evidence.models.items() for row in model_rows(name, model)]

    def of_kind(start: str) -> dict[str, str]:
        return {k: v for k, v in pictures.items() if k.startswith(start)}

    return {
        "case": case,
        "evidence": evidence,
        "metric": {"short": SHORT[case.metric], "long": LONG[case.metric]},
        "noise": "true output, noisy measurement"
        + (f", mean of {draws} draws" if (draws := case.noise_draws) > 1 else ""),
        "floor": _floor(evidence),
        "best": (best := evidence.laws.get(evidence.best or "")),
        "seeds": "" if best is None else _seeds(best.seeds),
        "headline": headline(evidence),
        "pictures": of_kind("figure_"),
        "loops": of_kind("closed_loop_"),
        "sweeps": of_kind("sweep_") | of_kind("candidates_"),
        "overview": pictures.get("closed_loop.png"),
        "main_test": evidence.main_words[0],
        "tables": tables,
        "rule": RULE,
        "acceptance": accepted,
        "met": sum(v.holds is True for v in accepted),
        "statements": said,
        "laws": [_law(evidence, law) for law in evidence.laws],
        "scenarios": _rows(evidence),
        "models": models,
        "free_run": any(row["free_run"] is not None for row in models),
        "candidates": [table for name, model in evidence.models.items() for table in candidates(name, model)],
        "step_ms": evidence.bound(evidence.main_test, "step_ms_p50"),
        "registry": REGISTRY_URL,
    }


def _seeds(count: int) -> str:
    return "one data seed" if count == 1 else f"{count} data seeds, each with networks of its own"


def _floor(evidence: Evidence) -> str:
    """What the gate takes for perfect, in words."""
    if evidence.case.metric == "mae":
        return f"{evidence.noise} (the measurement noise)"
    return f"what the measurement noise alone adds up to ({evidence.noise:g} squared times the samples)"


def headline(evidence: Evidence) -> list[tuple[str, str]]:
    """The figures that stand at the top: value and what it is.

    The best controller beside the bound on the test that weighs most, then on each test of the
    case's requirements for it, and beside the PID.
    """
    best, case = evidence.best, evidence.case
    if best is None:
        return []
    short = "" if case.metric == "mae" else f"{SHORT[case.metric]} of the "
    bounds = {"nmpc": "perfect-model NMPC", "offline": "offline optimum"}
    needs = [n for n in case.requirements if n.law in (None, best) and not n.low and not n.setting]
    asked = [(evidence.main_test, "nmpc"), *((n.scenario, n.times or "nmpc") for n in needs if n.metric == case.metric)]
    rows = []
    for name, kind in dict.fromkeys(asked):
        value = evidence.ratio(best, name, kind)
        if value is not None:
            rows.append((ratio(value), f"× {short}{bounds.get(kind, kind)} on {scenario_name(name, case.recipe)}"))
    for need in needs:
        late = evidence.figure(best, need.scenario, need.metric) if need.metric == "sse_late" else None
        if late is not None:
            where = scenario_name(need.scenario, case.recipe)
            rows.append((number(late), f"{SHORT[need.metric]} on {where}; at most {number(need.high)} is asked"))
    rows = rows[:MOST_HEADLINES]
    late_s = evidence.late_s(evidence.main_test)
    metric = "sse_late" if late_s else case.metric
    own, pid = (evidence.figure(law, evidence.main_test, metric) for law in (best, "pid"))
    if own and pid and own < pid:
        what = "less error" if case.metric == "mae" else "less squared error"
        where = scenario_name(evidence.main_test, case.recipe) + (f", from {late_s:g} s on" if late_s else "")
        rows.append((f"{100 * (1 - own / pid):.0f} %", f"{what} than the PID on {where}"))
    return rows


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
    mv = case.plant_class.mv_signals[0]
    unit = "" if mv.unit in NO_UNIT else f" [{mv.unit}]"
    return [*rows, _row(evidence, evidence.main_test, f"MV travel{unit}: {evidence.main_title}", "mv_travel")]


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
