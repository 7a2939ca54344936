"""From evidence to report.html, report.md and validation.json."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from pipeline.cases import NOISE_SUFFIX
from pipeline.report.claims import CLAIMS, PLAIN
from pipeline.report.evidence import Evidence
from pipeline.report.figures import draw_all
from pipeline.report.verdicts import RULE, acceptance, paper_row, statements

REGISTRY_URL = "http://127.0.0.1:5000/#/models"


def write_report(evidence: Evidence, models: Path, out: Path) -> list[Path]:
    """Write validation.json, figures/, report.html and report.md into ``out``; returns their paths."""
    out.mkdir(parents=True, exist_ok=True)
    pictures = draw_all(evidence, out / "figures", models)
    content = context(evidence, pictures)
    validation = json.dumps(evidence.validation(), indent=1, allow_nan=False) + "\n"
    html, text = (
        _environment(end == "html").get_template(f"report.{end}.j2").render(content) for end in ("html", "md")
    )
    files = {"validation.json": validation, "report.html": html, "report.md": text}
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
    environment.filters |= {"figure": figure, "cell": cell}
    return environment


def figure(value: float | None) -> str:
    """A number with three digits; a dash where nothing was measured."""
    return "–" if value is None else f"{value:.3g}"


def cell(text: str) -> str:
    """Text that a cell of a Markdown table can hold."""
    return text.replace("|", "\\|").replace("\n", " ")


def context(evidence: Evidence, pictures: Mapping[str, str]) -> dict[str, Any]:
    """Everything that the templates show."""
    case, claims = evidence.case, CLAIMS.get(evidence.case.name, PLAIN)
    tables = [(table, [paper_row(row, evidence, claims.reason) for row in table.rows]) for table in case.tables]
    accepted, said = acceptance(evidence, claims), statements(evidence, claims)
    return {
        "case": case,
        "evidence": evidence,
        "best": evidence.laws.get(evidence.best or ""),
        "headline": _headline(evidence),
        "pictures": {k: v for k, v in pictures.items() if k.startswith("figure_")},
        "loops": {k: v for k, v in pictures.items() if k.startswith("closed_loop_")},
        "sweeps": {k: v for k, v in pictures.items() if k.startswith("sweep_")},
        "overview": pictures.get("closed_loop.png"),
        "tables": tables,
        "rule": RULE,
        "acceptance": accepted,
        "met": sum(v.holds is True for v in accepted),
        "statements": said,
        "laws": [_law(evidence, law) for law in evidence.laws],
        "scenarios": [_scenario(evidence, name, title) for name, title in evidence.scenarios.items()],
        "models": [row for name, model in evidence.models.items() for row in _model(name, model)],
        "step_ms": evidence.bound("held_out", "step_ms_p50"),
        "registry": REGISTRY_URL,
    }


def _headline(evidence: Evidence) -> list[tuple[str, str]]:
    """The figures that stand at the top: value and what it is."""
    best = evidence.best
    if best is None:
        return []
    rows = []
    for name, kind, words in (
        ("held_out", "nmpc", "× perfect-model NMPC on held-out set points"),
        ("sp_a", "offline", "× offline optimum on SP-A"),
        ("sp_b", "offline", "× offline optimum on SP-B"),
    ):
        ratio = evidence.ratio(best, name, kind)
        if ratio is not None:
            rows.append((f"{ratio:.2f}", words))
    own, pid = evidence.figure(best, "held_out"), evidence.figure("pid", "held_out")
    if own and pid and best != "pid":
        rows.append((f"{100 * (1 - own / pid):.0f} %", "less error than the PID on held-out set points"))
    return rows


def _law(evidence: Evidence, law: str) -> dict[str, Any]:
    found = evidence.laws[law]
    step = found.metrics.get("step_us")
    setting = found.metrics.get("setting") or {}
    return {
        "name": law,
        "title": found.title,
        "setting": ", ".join(f"{k} = {v}" for k, v in setting.items()),
        "score": evidence.score(law),
        "lock_ups": found.lock_ups,
        "seeds": found.seeds,
        "step_us": step.get("p50") if isinstance(step, Mapping) else step,
    }


def _scenario(evidence: Evidence, name: str, title: str) -> dict[str, Any]:
    """A block of the big table: each law's MAE, its range, with noise, and its ratio to the bound."""
    cells = {}
    for law in evidence.laws:
        cells[law] = {
            "mae": evidence.figure(law, name),
            "low": evidence.figure(law, name, "mae", None, "min"),
            "high": evidence.figure(law, name, "mae", None, "max"),
            "noise": evidence.figure(law, name + NOISE_SUFFIX),
            "ratio": evidence.ratio(law, name),
            "max_asse": evidence.figure(law, name, "max_asse"),
        }
    known = {law: c["mae"] for law, c in cells.items() if c["mae"] is not None}
    return {
        "name": name,
        "title": title,
        "cells": cells,
        "winner": min(known, key=lambda law: known[law], default=None),
        "nmpc": evidence.bound(name),
        "nmpc_noise": evidence.bound(name + NOISE_SUFFIX),
        "offline": evidence.bound(name, "mae", "offline"),
    }


def _model(name: str, model: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of the models table, one for each part."""
    rows = []
    for part, found in (model.get("parts") or {}).items():
        seeds = found.get("per_seed") or {}
        median = found.get("median") or {}
        errors = [s["rmse"] for s in seeds.values() if s.get("rmse") is not None]
        rows.append(
            {
                "model": name,
                "part": part,
                "kind": found.get("kind", ""),
                "horizon": found.get("horizon"),
                "centres": median.get("centres"),
                "rmse": median.get("rmse"),
                "r2": median.get("r2"),
                "range": [min(errors), max(errors)] if errors else None,
                "per_seed": {seed: s.get("rmse") for seed, s in seeds.items()},
                "regions": {r: v.get("rmse") for r, v in (median.get("regions") or {}).items()},
            }
        )
    return rows
