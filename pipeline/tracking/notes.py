"""The note and the figures at the top of a run's page: about ten, the ones that decide something.

All other figures stand in the run's artifacts: metrics.json or validation.json as the stage wrote
it, and ``figures.json``, the same as one table of name and value.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping
from typing import Any, TypeGuard

from loopwright.pipeline.evaluation.law_evidence import BASE, LawMetrics
from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX
from loopwright.pipeline.tracking.gate import Gate
from loopwright.pipeline.tracking.stage_results import StageResult, StageTimes, flat

MOST_NOTED_FIGURES = 12  # figures of a run: more would hide those that decide
OF_A_MODEL = ("rmse", "free_run_rmse", "r2", "inside", "centres", "parameters")
OF_AN_OPERATED_TEST = ("outside_late", "gain", "borne_by_last", "rest_miss", "profit_per_h", "optimum_per_h")
TRACKED_POINTS = 200
"""Points of a curve; a training of thousands of iterations is thinned to these."""

Figures = dict[str, float]


def headline(kind: str, metrics: Mapping[str, Any], validation: Validation | None) -> Figures:
    """The metrics of a run of stage ``kind``, from its own metrics.json and its case's validation.json."""
    figures = {
        "screen": lambda: _of_record(metrics),
        "excite": lambda: _of_record(metrics),
        "fit": lambda: _of_models(metrics),
        "design": lambda: _of_files(metrics),
        "validate": lambda: _of_law(metrics, validation),
        "report": lambda: _of_case(validation),
    }.get(kind, dict)()
    finite = {name: float(value) for name, value in figures.items() if _is_figure(value)}
    return dict(list(finite.items())[:MOST_NOTED_FIGURES]) | (_operated(metrics) if kind == "validate" else {})


def ratio_name(validation: Validation | None) -> str:
    """The name of the gate score among the metrics: ``ratio_to_bound``, or of what else it is a multiple."""
    other = "nmpc" if validation is None else validation.gate.relative_to
    return "ratio_to_" + {"nmpc": "bound", "baseline": "baseline", "floor": "noise_floor"}[other]


def of_gate(law: str, validation: Validation | None) -> Figures:
    """The case's score of a law: its error over the bound's or what else is named. A later report may change it."""
    score = Gate.of(validation, law).score
    return {ratio_name(validation): float(score)} if _is_figure(score) else {}


def _of_record(tree: Mapping[str, Any]) -> dict[str, Any]:
    seeds = tree.get("per_seed") or {}
    return {"data_seeds": len(seeds), "rows": sum(row.get("rows", 0) for row in seeds.values())} if seeds else {}


def _of_models(tree: Mapping[str, Any]) -> dict[str, Any]:
    parts = tree.get("parts") or {}
    rows: dict[str, Any] = {}
    for part, row in parts.items():
        before = f"{part}/" if len(parts) > 1 else ""
        rows |= {f"{before}{name}": row["median"][name] for name in OF_A_MODEL if name in (row.get("median") or {})}
    seeds = max((len(row.get("per_seed") or {}) for row in parts.values()), default=0)
    return {"data_seeds": seeds, **rows} if parts else {}


def _of_files(tree: Mapping[str, Any]) -> dict[str, Any]:
    rows = [row for row in tree.get("controllers") or () if row.get("form") == "base"]
    if not rows:
        return {}
    figures = (rows[0].get("analysis") or {}).get("figures") or {}
    shown = {"data_seeds": len(rows), "bytes": max(r["bytes"] for r in rows), "states": rows[0]["n_state"]}
    return shown | {f"analysis/{name}": value for name, value in figures.items()}


def _of_law(tree: Mapping[str, Any], validation: Validation | None) -> dict[str, Any]:
    """The case's score on each kind of test, the tests of the gate first: the median over the data seeds."""
    if not tree:
        return {}
    law = LawMetrics.of(tree)
    tests = law.forms[BASE].tests
    weights = validation.gate.weights if validation else {}
    errors = {}
    plain = (name for name in tests if not name.endswith(NOISE_SUFFIX))
    for test in sorted(plain, key=lambda name: -max(weights.get(name, 0), weights.get(name + NOISE_SUFFIX, 0))):
        noisy = test + NOISE_SUFFIX in weights and test not in weights
        errors[f"{law.metric}/{test}"] = tests[test + NOISE_SUFFIX * noisy].median.get(law.metric)
    own = validation.laws.get(law.name) if validation else None
    shown = {
        **of_gate(law.name, validation),
        "lock_ups": law.lock_ups,
        "step_us": own.step_us if own else None,
        "data_seeds": len(law.seeds),
    }
    return shown | _grounds(validation) | errors


def _operated(tree: Mapping[str, Any]) -> Figures:
    """The figures that judge a law with ``operate``, of each of its tests; none of another law."""
    tests = LawMetrics.of(tree).operated if tree.get("operated") else {}
    return {
        f"operated/{test}/{name}": value
        for test, result in tests.items()
        for name, value in result.figures().items()
        if name in OF_AN_OPERATED_TEST
    }


def _grounds(validation: Validation | None) -> dict[str, Any]:
    """Free-run fit [%] of the identified models of the tests over rows that they never saw."""
    grounds = validation.grounds if validation else None
    return {} if grounds is None else {f"models_free_run_fit/{name}": fit for name, fit in grounds.fit.items()}


def _of_case(validation: Validation | None) -> dict[str, Any]:
    if validation is None:
        return {}
    laws = validation.gate.laws
    scores = [row.score for row in laws.values() if row.score is not None]
    ratio = ratio_name(validation)
    shown: dict[str, Any] = {"laws": len(laws), "laws_that_locked_up": sum(bool(r.lock_ups) for r in laws.values())}
    if scores:
        shown |= {f"best_{ratio}": min(scores), f"median_{ratio}": statistics.median(scores)}
    shown |= _grounds(validation)
    for name, words in (("requirements", "met"), ("claims", "confirmed"), ("paper", "reproduced")):
        known = [row.holds for row in getattr(validation, name) if row.holds is not None]
        if known:
            shown |= {f"{name}/checked": len(known), f"{name}/{words}": sum(known)}
    return shown


def curves(metrics: Mapping[str, Any], sweep: Mapping[str, Any]) -> Iterator[tuple[str, int, float]]:
    """Name, step and value of the training curves (of the first data seed) and of the sweep over partitions."""
    for part, row in (metrics.get("parts") or {}).items():
        seed: Mapping[str, Any] = next(iter((row.get("per_seed") or {}).values()), {})
        history = seed.get("history") or ()
        for step in range(0, len(history), max(1, math.ceil(len(history) / TRACKED_POINTS))):
            if _is_figure(history[step]):
                yield f"training/{part}", step, float(history[step])
    for row in sweep.get("rows") or ():
        for name in ("train", "validation"):
            value = (row.get(name) or {}).get("rmse")
            if _is_figure(value):
                yield f"sweep/{name}_rmse", int(row["partitions"]), float(value)


def table(trees: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, float]]:
    """Every figure of some JSON files as rows of name and value; lists stay in the files alone."""
    several = len(trees) > 1
    rows = []
    for file, tree in trees.items():
        rows += [(f"{file}: {k}" if several else k, float(v)) for k, v in flat(tree).items() if _is_figure(v)]
    return rows


def _is_figure(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and math.isfinite(value)


WHAT = {
    "screen": "Read and screened the export files of the plant *{case}*, and made its record of them."
    " The models learn from it. Open `screening.html` under Artifacts.",
    "excite": "Made the data set **{item}** of the case *{case}*: the simulated plant, excited, with measurement noise."
    " The models learn from it.",
    "fit": "Trained the model set **{item}** of the case *{case}*, once for each data seed."
    " The control laws are designed from it.",
    "design": "Designed the control law **{item}** of the case *{case}* and exported it as ONNX, one file for each"
    " data seed. Each file agrees with its PyTorch original to 1e-9 over 1,000 steps in closed loop; otherwise this"
    " stage fails.",
    "validate": "Ran the exported files of the control law **{item}** in closed loop on every test of the case"
    " *{case}*. The best file by the development tests is shipped and stands in the registry.",
    "report": "Compared all control laws of the case *{case}* with each other, with the bound and with the paper.",
}
# What an error is divided by: of a case that is tested on its plant's equations, and on models of its record.
BOUND = {
    False: "an NMPC that knows the plant exactly, and 1 is the bound",
    True: "an NMPC that knows the model of each test exactly, and 1 is the bound; every test ran on models identified"
    " from the plant's record, none on the plant",
}
METRICS = {
    "screen": "`rows` counts the rows of the record. `figures.json` names the files with their digests.",
    "excite": "`rows` counts the samples of all data seeds.",
    "fit": "The metrics are medians over the data seeds: `rmse` one step ahead, `free_run_rmse` when the model runs on"
    " its own output. `training/` and `sweep/` are curves.",
    "design": "`bytes` is the largest file, `states` the length of the state vector.",
    "validate": "`{ratio}` is the figure that decides: the error divided by that of {bound};"
    " lower is better. `{metric}/…` is the error on each test, the median over the data seeds."
    " `lock_ups` must be 0. `step_us` is the time of one step in microseconds.",
    "report": "`best_{ratio}` is that of the best law; 1 is {one}.",
}


OPERATED = (
    "`operated/…` are tests in which operators change ranges, MVs in use, costs and ranks: `outside_late` is the share"
    " of time outside a range that a steady state keeps, in the end of the test; `gain` the share of the profit that"
    " the best steady state would gain. Their pictures lie in the folder `operated` under Artifacts."
)


def _bound(validation: Validation) -> str:
    """The divisor of an error, in words."""
    gate = validation.gate
    if gate.relative_to == "nmpc":
        return BOUND[validation.on_models]
    tested = "every test ran on a simulator or on models of the plant, none on the plant"
    if gate.relative_to == "baseline":
        return f"the {gate.baseline_name}, and 1 is as good as it; {tested}"
    return f"a loop whose error is what noise can hide, and 1 is as good as that; {tested}"


def run_note(result: StageResult, case: str, validation: Validation | None, times: StageTimes) -> str:
    """The description of a run: what the stage did, what came out, and what its metrics mean."""
    item = result.item
    words = {"case": case, "item": item, "metric": "<metric>", "bound": BOUND[False], "one": "the bound"}
    words["ratio"] = ratio_name(validation)
    if validation is not None:
        words |= {
            "case": validation.titles.case,
            "metric": validation.metric,
            "bound": _bound(validation),
            "one": validation.gate.reference,
        }
        if result.kind in {"design", "validate"}:
            words["item"] = validation.titles.laws.get(item, item)
    # the page shows the first lines, the rest on a click
    parts = [_verdict(Gate.of(validation, item))] if result.kind == "validate" else []
    parts.append(WHAT.get(result.kind, "The stage {item} of the case *{case}*.").format(**words))
    if validation is not None and validation.grounds is not None:
        parts.append(f"Tested {validation.grounds.words}.")
    if result.kind == "report":
        parts.append("Open `report.html` under Artifacts.")
    parts.append(METRICS.get(result.kind, "").format(**words))
    if result.kind == "validate" and validation is not None and item in validation.laws:
        parts.append(OPERATED if validation.laws[item].operated else "")
    parts.append("All other figures: `figures.json` under Artifacts.")
    if not times.measured:
        parts.append(
            "The duration is not known: DVC took the files from its cache, or they came without their receipt."
            " Created is when the files were written."
        )
    return "\n\n".join(filter(None, parts))


def _verdict(gate: Gate) -> str:
    if gate.score is None:
        return ""
    refusal = gate.refusal()
    passed = "It passes the gate." if refusal is None else f"It does not pass the gate: {refusal}."
    return f"**{gate.score:.3f} times {gate.reference}.** {passed}"


def experiment_note(case: str, validation: Validation | None, champion: str | None) -> str:
    """The description of a case's experiment: its champion, its laws in order, where to look."""
    laws = validation.titles.laws if validation else {}
    title = validation.titles.case if validation else case
    first = f"**{title}.**"  # the page shows this line, the rest on a click
    if champion:
        law = champion.removeprefix(f"{case}-")
        gate = Gate.of(validation, law)
        beside = "" if gate.score is None else f", {gate.score:.3f} times {gate.reference}"
        first += f" Champion: **[{laws.get(law, law)}](#/models/{champion})**{beside}."
    if validation is not None and validation.grounds is not None:
        first += f" Tested {validation.grounds.words}."
    lines = [first, "One run for each stage of the pipeline."]
    results = validation.gate.laws if validation else {}
    scores = {law: row.score for law, row in results.items() if row.score is not None}
    if scores:
        rows = [
            f"| {laws.get(law, law)} | {scores[law]:.3f} | {Gate.of(validation, law).lock_ups} |"
            for law in sorted(scores, key=lambda law: scores[law])
        ]
        over = "the bound's" if validation is None else validation.gate.reference.replace("the bound", "the bound's")
        head = f"| Control law | Error over {over} | Lock-ups |\n|---|---|---|\n"
        lines.append(head + "\n".join(rows))
    return "\n\n".join(lines)
