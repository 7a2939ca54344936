"""From evidence to report.html, report.md and validation.json."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import lock_up_text
from loopwright.pipeline.evaluation.leaderboard import because, by_reason
from loopwright.pipeline.evaluation.metric import TRAVEL
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED, candidates, model_rows
from loopwright.pipeline.evaluation.validation import FILE, reference_words
from loopwright.pipeline.evaluation.verdicts import Claims
from loopwright.pipeline.optimal.bounds import bounded
from loopwright.pipeline.pictures.drawing import CasePicture
from loopwright.pipeline.pictures.numbers import number, ratio
from loopwright.pipeline.pictures.words import law_name, scenario_name
from loopwright.pipeline.report.figures import draw_all, main_words
from loopwright.pipeline.report.identified_model import ANSWERS, TRIED, VARIABLES, model_section
from loopwright.pipeline.report.law_tables import analyses, further_figures, law_row, scenario_rows
from loopwright.pipeline.report.operated_tables import MVS, PROFITS, RANGES, operated_tables
from loopwright.pipeline.report.own_acceptance import (
    against,
    beyond_reach,
    cold_starts,
    dead_time_to_state,
    shipped_laws,
    step_test_to_run,
    wrong_rows,
)
from loopwright.pipeline.report.templating import REGISTRY_URL, render, write_pages
from loopwright.pipeline.report.verdicts import BOUNDS, RULE, Judged, judge, validation
from loopwright.pipeline.tuning.pid_forms import PidForms, whole_span
from loopwright.pipeline.tuning.rules import PidSettings

MOST_HEADLINES = 5  # headline rows; those of each CV and of the models' fits come on top


def write_report(evidence: Evidence, claims: Claims, own: Sequence[CasePicture], out: Path) -> list[Path]:
    """Write validation.json, figures/, report.html and report.md into ``out``; returns their paths.

    ``own`` are the pictures that only this case has.
    """
    out.mkdir(parents=True, exist_ok=True)
    judged = judge(evidence, claims)
    pictures = draw_all(evidence, out / "figures", own)
    content = context(evidence, judged, pictures, {f"{picture.name}.png" for picture in own})
    pages = {name: render(f"{name}.j2", content) for name in ("report.html", "report.md")}
    written = write_pages(out, {FILE: validation(evidence, judged).to_json(), **pages})
    return [*written, *(out / "figures" / name for name in pictures)]


def context(evidence: Evidence, judged: Judged, pictures: Mapping[str, str], own: Collection[str]) -> dict[str, Any]:
    """Everything that the templates show."""
    case, best = evidence.case, evidence.laws.get(evidence.best or "")
    shipped = shipped_laws(evidence)
    models = [row for name, model in evidence.models.items() for row in model_rows(name, model)]
    # An identified model has a section of its own, with what these rows have no columns for.
    models = [row for row in models if row["kind"] != IDENTIFIED]

    def of_kind(start: str) -> dict[str, str]:
        return {k: v for k, v in pictures.items() if k.startswith(start) and k not in own}

    draws = f", mean of {case.noise_draws} draws" if case.noise_draws > 1 else ""
    return {
        "case": case,
        "evidence": evidence,
        "metric": case.criterion,
        "noise": f"true output, noisy measurement{draws}",
        "floor": _floor(evidence),
        "best": best,
        "old_loop_stands": bool(evidence.old_loop and shipped) and best is None,
        "nothing_shipped": bool(evidence.withheld or evidence.laws) and not shipped,
        "to_do": step_test_to_run(evidence),
        "shown_law": evidence.best or next(iter(shipped), None),
        "seeds": "" if best is None else _seeds(best.seeds),
        "headline": headline(evidence),
        "warning": "" if evidence.grounds is None else evidence.grounds.warning,
        "pictures": of_kind("figure_"),
        "own_pictures": {k: v for k, v in pictures.items() if k in own},
        "further_pictures": [
            *_loops(evidence, of_kind("closed_loop_")),
            *([("Tests that say most against a law", worst)] if (worst := of_kind("worst_")) else ()),
            *([("Limit cycles", cycles)] if (cycles := of_kind("cycle_")) else ()),
        ],
        "sweeps": of_kind("sweep_") | of_kind("candidates_"),
        # A search over models has no offline optimum: its column would stand empty.
        "offline": evidence.grounds is None,
        "replays": of_kind("replay_"),
        "replayed": [(name, mv, row) for name, law in evidence.laws.items() for mv, row in law.metrics.replay.items()],
        "cold_starts": cold_starts(evidence),
        "overview": pictures.get("closed_loop.png"),
        "identified": model_section(evidence),
        "identified_heads": (VARIABLES, ANSWERS, TRIED),
        "identified_pictures": of_kind("model_"),
        "tables": judged.tables,
        "rule": RULE,
        "acceptance": judged.acceptance,
        "met": sum(row.holds is True for row in judged.acceptance),
        "statements": judged.statements,
        "against": against(evidence),
        "beyond_reach": beyond_reach(evidence),
        "caveat": _caveat(evidence, judged),
        "operated": () if evidence.grounds is None else evidence.grounds.operated,
        "old_controllers": _old_controllers(evidence),
        "picture_against": {
            law: next((name for kind in ("worst", "cycle") if (name := f"{kind}_{law}.png") in pictures), "")
            for law in evidence.laws
        },
        "locked": [_locked(evidence, name) for name, law in evidence.laws.items() if law.lock_ups],
        "poor": [
            {"law": name, "why": law.why_withheld}
            for name, law in evidence.laws.items()
            if case.on_models and law.withheld and not law.lock_ups
        ],
        "at_rest": any(evidence.at_rest(name) is not None for name in evidence.scenarios),
        "withheld": by_reason({law: why for law, why in evidence.withheld.items() if law != case.old_loop}),
        "gate_of": _gate_of(evidence),
        "gate_one": reference_words(evidence.relative_to, law_name(case.baseline)),
        "no_baseline": because(evidence.no_baseline) if evidence.no_baseline else "",
        "baseline": law_name(case.baseline),
        "laws": [law_row(evidence, law) for law in evidence.laws],
        "scenarios": scenario_rows(evidence),
        "certificates": {n: c for n in shipped if (c := evidence.laws[n].metrics.certificate) is not None},
        "gone_wrong": wrong_rows(evidence),
        "late": [words for law in shipped if (words := dead_time_to_state(evidence, law))],
        "further": further_figures(evidence),
        "operator_tests": operated_tables(evidence, pictures),
        "operator_heads": (RANGES, MVS, PROFITS),
        "operator_pictures": of_kind("operated_"),
        "analyses": analyses(evidence),
        "tuning_pictures": of_kind("tuning_"),
        "bound_notes": _bound_notes(evidence),
        "bounded": any(evidence.bound(name) is not None for name in evidence.scenarios),
        "models": models,
        "free_run": any(row["free_run"] is not None for row in models),
        "candidates": [table for name, model in evidence.models.items() for table in candidates(name, model)],
        "step_ms": evidence.bound(evidence.main_test, "step_ms_p50"),
        "registry": REGISTRY_URL,
    }


def _caveat(evidence: Evidence, judged: Judged) -> str:
    """Warnings for a reader beside the best controller, as sentences; empty without any."""
    missed = [row.what for row in judged.acceptance if row.holds is False]
    found = [f"Not met: {'; '.join(missed)}."] if missed else []
    if evidence.grounds is not None and evidence.grounds.doubt and not evidence.grounds.proven:
        found.append("A model of these data is doubtful, as said below.")
    return " ".join(found)


def _gate_of(evidence: Evidence) -> str:
    """The divisor of errors in the gate score."""
    if evidence.relative_to == "floor":
        return "the error that noise can hide"
    whose = "NMPC" if evidence.relative_to == "nmpc" else law_name(evidence.case.baseline)
    return f"{whose}'s {evidence.case.criterion.short}"


def _floor(evidence: Evidence) -> str:
    """The error that noise can hide, in words; empty where the case's metric has no floor."""
    floor = evidence.case.criterion.floor
    return "" if floor is None else floor.text.format(noise=evidence.noise, unit=f" {evidence.case.unit}".rstrip())


def _loops(evidence: Evidence, pictures: Mapping[str, str]) -> list[tuple[str, dict[str, str]]]:
    """Pictures of closed loops below their headings; the best law's on the main test stands at the top of the page."""
    moved = {name: words for name, words in pictures.items() if name.startswith("closed_loop_test_")}
    others = {k: v for k, v in pictures.items() if k not in moved and k != f"closed_loop_{evidence.best}.png"}
    law = "Each law" if evidence.best is None else "The other laws"
    found = [(f"{law} on {main_words(evidence)[0]}", others), ("Tests that move measured disturbances", moved)]
    return [(title, shown) for title, shown in found if shown]


def _bound_notes(evidence: Evidence) -> list[str]:
    """Notes on the bounds: tests without a bound, and tests whose optimum is the NMPC's plan."""
    bounds = evidence.bounds
    lacking = {
        kind: [
            n for n, tests in evidence.tests.items() if bounded(evidence.case, tests) and kind not in bounds.get(n, {})
        ]
        for kind in BOUNDS
    }
    notes = [
        f"The {BOUNDS[kind]} was not computed for: {', '.join(names)}." for kind, names in lacking.items() if names
    ]
    replaced = [n for n, of in bounds.items() if of.get("offline", {}).get("from_nmpc")]
    if replaced:
        notes.append(f"No search improved the NMPC's plan; its figures stand for the optimum: {', '.join(replaced)}.")
    return notes if bounds else []


def _seeds(count: int) -> str:
    return "one data seed" if count == 1 else f"{count} data seeds, each with its own models"


def headline(evidence: Evidence) -> list[tuple[str, str]]:
    """The figures at the top of the page: value and words.

    They compare the best controller with the bound on the main test and on each test of its
    requirements, say how well the models fit that it was tested on, and compare it with the case's baseline. Where no
    law is the best beside the loop that the plant was run by before, each shipped one is compared with that.
    """
    best, case = evidence.best, evidence.case
    if best is None:
        found = [(law, row) for law in shipped_laws(evidence) for row in over_old_loop(evidence, law)]
        return [(share, f"{law}: {words}") for law, (share, words) in found]
    needs = [n for n in case.requirements if n.law in (None, best) and not n.low and not n.setting]
    pairs = [(evidence.main_test, "nmpc"), *((n.scenario, n.times or "nmpc") for n in needs if n.metric == case.metric)]
    name_of = partial(scenario_name, recipe=case.recipe, own=case.test_words)
    rows = [
        (ratio(value), f"× {case.criterion.short} of the {BOUNDS.get(kind, kind)} on {name_of(name)}")
        for name, kind in dict.fromkeys(pairs)
        if (value := evidence.ratio(best, name, kind)) is not None
    ]
    for need in (n for n in needs if n.metric == case.criterion.late):
        late = evidence.figure(best, need.scenario, need.metric)
        if late is not None:
            metric = case.metrics[need.metric]
            unit = metric.unit_of(case.cv_unit)
            words = f"{metric.short} on {name_of(need.scenario)}; at most {number(need.high)} is asked"
            rows.append((f"{number(late)} {unit}".rstrip(), words))
    rows = [*rows[:MOST_HEADLINES], *_of_each_cv(evidence, best, name_of(evidence.main_test))]
    if evidence.grounds is not None:
        rows_ahead = evidence.grounds.ahead
        how = "free-run fit" if rows_ahead is None else f"fit up to {rows_ahead} samples ahead"
        rows += [
            ("none" if fit is None else f"{fit:.3g} %", f"{how} of {name} by the models, over unseen rows")
            for name, fit in evidence.grounds.fit.items()
        ]
    late_s = evidence.late_s(evidence.main_test)
    compared = case.criterion.late if late_s else case.metric
    own, other = (evidence.figure(law, evidence.main_test, compared) for law in (best, case.baseline))
    if old_loop := over_old_loop(evidence, best):
        return [*old_loop, *rows]
    if own and other and own < other:
        where = name_of(evidence.main_test) + (f", from {late_s:g} s on" if late_s else "")
        lower = f"lower {case.criterion.long} than the {law_name(case.baseline)} on {where}"
        rows.append((f"{100 * (1 - own / other):.0f} %", lower))
    return rows


def _old_controllers(evidence: Evidence) -> list[str]:
    """The law of each loop of the record, a clause each; of one that is believed in all forms of control systems.

    Where the record has no set point that is said; empty where nobody screened it.
    """
    grounds, words = evidence.grounds, list[str]()
    if grounds is None or grounds.record is None:
        return words
    if evidence.case.stand_in == IDENTIFIED and not grounds.operated:
        return ["it is not known, as no set point of the record is named (`--sp` of `loopwright new`)"]
    signals = evidence.case.record_signals
    spans = {s.name: s.high - s.low for s in signals.pv} | {s.name: whole_span(s) for s in signals.mv}
    for law in grounds.old_controllers:
        forms = ""
        if law.believed and law.pv in spans and law.mv in spans:
            of = PidForms.of(PidSettings(law.kc, law.ti_s, law.td_s), spans[law.pv], spans[law.mv])
            forms = f"; {of.words(law.pv_unit, law.mv_unit)}"
        words.append(law.words + forms)
    return words


def over_old_loop(evidence: Evidence, law: str) -> list[tuple[str, str]]:
    """By how much a law's error is below that of the loop that the plant was run by before, and its travel beside it.

    Empty where no test has both.
    """
    case, old, words = evidence.case, evidence.old_loop, []
    if not old or evidence.no_baseline:
        return []
    names = partial(scenario_name, recipe=case.recipe, own=case.test_words)
    for test in (*sorted(case.weights, key=lambda name: -case.weights[name]), *evidence.daily):
        own, other = evidence.figure(law, test), evidence.figure(old, test)
        if own is not None and other:
            words.append((100 * (1 - own / other), names(test)))
    if not words:
        return []
    (first, where), *rest = words
    further = "".join(f"; {abs(share):.0f} % {_less(share)} on {test}" for share, test in rest)
    moved = (*evidence.daily, evidence.main_test)[0]
    own, other = (evidence.figure(name, moved, TRAVEL) for name in (law, old))
    travel = (
        f". Its MV travel is {number(own / other)} times the old loop's on {names(moved)}"
        if own is not None and other
        else ""
    )
    lower = f"{_less(first)} {case.criterion.short} than the old loop on {where}{further}{travel}"
    return [(f"{abs(first):.0f} %", lower)]


def _less(share: float) -> str:
    return "lower" if share >= 0 else "higher"


def _of_each_cv(evidence: Evidence, law: str, where: str) -> list[tuple[str, str]]:
    """Each CV's own error on the main test, of several CVs whose errors are put together in shares of ranges."""
    case, rows = evidence.case, []
    for metric in case.own_metrics if case.on_models else ():
        own, other = (evidence.figure(name, evidence.main_test, metric.name) for name in (law, case.baseline))
        if metric.name.startswith(f"{case.metric}_") and own is not None:
            beside = (
                "" if law == case.baseline or other is None else f"; the {law_name(case.baseline)} has {number(other)}"
            )
            rows.append(
                (f"{number(own)} {metric.unit_of(case.cv_unit)}".rstrip(), f"{metric.short} on {where}{beside}")
            )
    return rows[:MOST_HEADLINES]


def _locked(evidence: Evidence, law: str) -> dict[str, str]:
    """A law that locked up: the tests, and why it is shipped nevertheless."""
    own = evidence.laws[law].metrics
    return {
        "law": law,
        "did": "locked up or left its limits" if evidence.case.on_models else "locked up",
        "loops": "one closed loop" if own.lock_ups == 1 else f"{own.lock_ups} closed loops",
        "tests": lock_up_text(own.locked_up),
        "why": ". It is shipped as printed, to reproduce the paper" if own.as_printed else ". It is not shipped",
    }
