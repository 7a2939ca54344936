"""The tables of a report on its laws: what each one is, its figures in every test, and its analysis."""

from __future__ import annotations

from typing import Any

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import BASE, FormAnalysis
from loopwright.pipeline.evaluation.metric import TRAVEL, with_unit
from loopwright.pipeline.pictures.words import given_text
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

MOST_TRIED = 40  # rows of what a search tried, the cheapest: a PID's has over a hundred, and the picture shows all


def law_row(evidence: Evidence, law: str) -> dict[str, Any]:
    """The row of a law in the table of laws: title, settings, score, lock-ups, data seeds, time of a step."""
    measured = evidence.laws[law]
    return {
        "name": law,
        "title": measured.title,
        "setting": given_text(measured.metrics.forms[BASE].setting) or "defaults",
        "score": evidence.score(law),
        "lock_ups": measured.lock_ups,
        "seeds": measured.seeds,
        "step_us": measured.step_us,
    }


def scenario_rows(evidence: Evidence) -> list[dict[str, Any]]:
    """The big table: each test in the case's metric, its late part if it has one, and at the end the MV's travel."""
    case = evidence.case
    rows = []
    for name, title in evidence.scenarios.items():
        rows.append(_row(evidence, name, title, case.metric))
        if late_s := evidence.late_s(name):
            rows.append(_row(evidence, name, f"{title}, from {late_s:g} s on", case.criterion.late))
    of = case.metrics[TRAVEL]
    words, unit = of.short + ", all MVs together" * (len(case.plant_class.mv_signals) > 1), of.unit_of(case.cv_unit)
    # In a minute a person compares it with the old loop, whose record has another length.
    per = "" if not case.on_models else "1/min" if not unit else f"{unit} a minute" if " " in unit else f"{unit}/min"
    shown = with_unit(words, per or unit)
    names = (evidence.main_test, *(evidence.daily if case.on_models else ()))
    titles = {name: evidence.scenarios[name.removesuffix(NOISE_SUFFIX)] for name in names}
    travel = [_row(evidence, name, f"{shown}: {title}", TRAVEL) for name, title in titles.items()]
    travel = [_a_minute(evidence, row) if per else row for row in travel]
    return [*rows, *(row | {"winner": None} for row in travel)]


def _a_minute(evidence: Evidence, row: dict[str, Any]) -> dict[str, Any]:
    """The row of the MVs' travel, in a minute of the test."""
    tests = evidence.tests[str(row["name"]).removesuffix(NOISE_SUFFIX)]
    minutes = sum(len(test.sp) for test in tests) / len(tests) * evidence.case.plant.period_s / 60.0

    def each(value: float | None) -> float | None:
        return None if value is None else value / minutes

    cells = {law: {key: each(value) for key, value in cell.items()} for law, cell in row["cells"].items()}
    bounds = {key: each(row[key]) for key in ("nmpc", "nmpc_noise", "offline")}
    return row | bounds | {"cells": cells}


def further_figures(evidence: Evidence) -> list[dict[str, Any]]:
    """The figures of ``own_metrics`` in each test: each law's median, without and with noise."""
    case, tables = evidence.case, []
    for name, title in evidence.scenarios.items():
        rows = [
            (metric.label(case.cv_unit), _row(evidence, name, title, metric.name)["cells"])
            for metric in case.own_metrics
            if metric.name != case.metric
        ]
        rows = [(metric, cells) for metric, cells in rows if any(c["value"] is not None for c in cells.values())]
        if rows:
            tables.append({"name": name, "title": title, "rows": rows})
    return tables


def analyses(evidence: Evidence) -> list[dict[str, Any]]:
    """The analysis of each law that has one: its figures by form, its notes, and what its search tried."""
    tables = []
    for name, law in evidence.laws.items():
        forms = {"as shipped" if form == BASE else form: analysis for form, analysis in law.analyses.items()}
        if not forms:
            continue
        shipped = next(iter(forms.values()))
        notes = dict.fromkeys(note for analysis in forms.values() for note in analysis.notes)
        of = {note: [form for form, analysis in forms.items() if note in analysis.notes] for note in notes}
        metrics = dict.fromkeys(metric for analysis in forms.values() for metric in analysis.figures)
        tables.append(
            {
                "law": name,
                "title": law.title,
                "forms": list(forms),
                "rows": [
                    (evidence.case.label(m), [analysis.figures.get(m) for analysis in forms.values()]) for m in metrics
                ],
                **_tried(evidence, shipped),
                # A note that all forms share names no form.
                "notes": [(note, "" if len(own) == len(forms) else ", ".join(own)) for note, own in of.items()],
            }
        )
    return tables


def _tried(evidence: Evidence, analysis: FormAnalysis) -> dict[str, Any]:
    """Columns and rows of what a search tried, the first ``MOST_TRIED`` and the one that was taken, and their count."""
    rows = [row for i, row in enumerate(analysis.table) if i < MOST_TRIED or row.get("taken")]
    names = [name for name in (analysis.table[0] if analysis.table else ()) if name != "taken"]
    return {
        "columns": [evidence.case.label(name) for name in names],
        "tried": [{"taken": bool(row.get("taken")), "values": [row[name] for name in names]} for row in rows],
        "tried_count": len(analysis.table),
    }


def _row(evidence: Evidence, name: str, title: str, metric: str) -> dict[str, Any]:
    """A row of the big table: each law's figure, range, figure with noise, and ratio to the bound."""
    cells = {
        law: {
            "value": evidence.figure(law, name, metric),
            # One data seed has no range.
            "low": evidence.figure(law, name, metric, None, "min") if found.seeds > 1 else None,
            "high": evidence.figure(law, name, metric, None, "max") if found.seeds > 1 else None,
            "noise": evidence.figure(law, name + NOISE_SUFFIX, metric),
            "ratio": evidence.ratio(law, name) if metric == evidence.case.metric else None,
        }
        for law, found in evidence.laws.items()
    }
    medians = {law: c["value"] for law, c in cells.items() if c["value"] is not None}
    return {
        "name": name,
        "title": title,
        "cells": cells,
        "winner": min(medians, key=lambda law: medians[law] or 0.0, default=None),
        "nmpc": evidence.bound(name, metric),
        "nmpc_noise": evidence.bound(name + NOISE_SUFFIX, metric),
        "offline": evidence.bound(name, metric, "offline"),
        "at_rest": evidence.at_rest(name) if metric == evidence.case.metric else None,
    }
