"""The note at the top of the page of a run or an experiment, in Markdown."""

from __future__ import annotations

from loopwright.pipeline.evaluation.validation import Validation
from loopwright.pipeline.tracking.gate import Gate
from loopwright.pipeline.tracking.headline import ratio_name
from loopwright.pipeline.tracking.stage_results import StageResult, Times

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


def _bound(validation: Validation) -> str:
    """The divisor of an error, in words."""
    gate = validation.gate
    if gate.relative_to == "nmpc":
        return BOUND[validation.on_models]
    tested = "every test ran on a simulator or on models of the plant, none on the plant"
    if gate.relative_to == "baseline":
        return f"the {gate.baseline_name}, and 1 is as good as it; {tested}"
    return f"a loop whose error is what noise can hide, and 1 is as good as that; {tested}"


def run_note(result: StageResult, case: str, validation: Validation | None, times: Times) -> str:
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
