"""Models drawn: predictions beside what was measured, candidates of a search, and errors of a free run."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.evaluation.case import Figure
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Array
from loopwright.pipeline.evaluation.verdicts import Check, CheckOutcome
from loopwright.pipeline.files import draft_of
from loopwright.pipeline.pictures.drawing import (
    PALETTE,
    PICTURE_SIZE,
    SET_POINT,
    Draw,
    axis_label,
    clear_legend,
    colour_of,
    fit_labels,
    legend_below,
    scale,
    signal_label,
    time_axis,
)
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.pictures.words import law_name

if TYPE_CHECKING:
    from loopwright.pipeline.models.static.sweep import SweepResult


PREDICTED = PALETTE[1]
ONE_STEP = {
    "nnarx": ("NNARX", "#0072b2"),
    "linearized": ("linearized", "#e69f00"),
    "recursive": ("recursive", "#cc79a7"),
}
RECURSIVE_SHADES = ("#cc79a7", "#009e73", "#d55e00")
PANEL_BEYOND = 0.5
"""Share of the measured range that a panel reaches beyond it; recursive models leave any."""


def predictions_picture(evidence: Evidence, figure: Figure) -> Canvas:
    """The inverse model's MV beside the real one over some validation samples."""
    sets = (evidence.predictions(name) for name in sorted(evidence.models))
    arrays = next((a for a in sets if {"actual", "predicted"} <= set(a)), None)
    if arrays is None:
        raise NotMeasuredError
    time_s, actual, predicted = (np.ravel(arrays[k]) for k in ("time_s", "actual", "predicted"))
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 4.2), layout="constrained")
    axes = canvas.subplots(1, 2, gridspec_kw={"width_ratios": (2.4, 1)})
    n = min(len(actual), 100)
    # No line: a random split leaves samples that do not follow one another.
    axes[0].plot(time_s[:n], actual[:n], "o", color="black", markersize=5, fillstyle="none", label="applied")
    axes[0].plot(time_s[:n], predicted[:n], ".", color=PREDICTED, markersize=4, label="predicted")
    axes[0].set_title(f"Figure {figure.number}. {figure.title}", wrap=True)
    axes[0].set_xlabel("time [s]")
    mv = evidence.case.plant_class.mv_signals[0]
    axes[0].set_ylabel(signal_label(mv))
    canvas.legend(loc="outside lower center", ncols=2)
    axes[1].plot(actual, predicted, ".", color=PREDICTED, markersize=3)
    ends = [float(min(actual.min(), predicted.min())), float(max(actual.max(), predicted.max()))]
    axes[1].plot(ends, ends, color="black", linewidth=0.8)
    axes[1].set_xlabel(axis_label("applied", mv.unit))
    axes[1].set_ylabel(axis_label("predicted", mv.unit))
    axes[1].set_aspect("equal", adjustable="box")
    return canvas


def one_step_picture(evidence: Evidence, figure: Figure) -> Canvas:
    """One-step predictions beside the measurement: network and linearization above, recursive models below."""
    arrays = evidence.predictions(figure.model or "")
    names = [key for key in arrays if key not in {"time_s", "measured"}]
    if "measured" not in arrays or not names:
        raise NotMeasuredError
    recursive = [key for key in names if key.startswith("recursive")]
    groups = [group for group in ([n for n in names if n not in recursive], recursive) if group]
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 1.2 + 2.2 * len(groups)), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(len(groups), 1, sharex=True)))
    time, words = time_axis(np.ravel(arrays["time_s"]))
    for axes, group in zip(panels, groups, strict=True):
        _one_step_panel(axes, time, arrays, group)
    panels[0].set_title(f"Figure {figure.number}. {figure.title}", wrap=True)
    panels[-1].set_xlabel(words)
    return canvas


def _one_step_panel(axes: Axes, time: Array, arrays: Mapping[str, Array], group: list[str]) -> None:
    measured = np.ravel(arrays["measured"])
    axes.plot(time, measured, "o", color="black", markersize=3.5, fillstyle="none", label="measured", zorder=2)
    for i, key in enumerate(group):
        predicted = np.ravel(arrays[key])
        kind, _, factor = key.partition("_")
        label, colour = ONE_STEP.get(kind, (key.replace("_", " "), PALETTE[i]))
        if kind == "recursive":
            label, colour = f"{label}, f = {factor}", RECURSIVE_SHADES[i % len(RECURSIVE_SHADES)]
        sse = number(float(np.sum((measured - predicted) ** 2)))
        axes.plot(time, predicted, color=colour, linewidth=1.3, label=f"{label}, SSE {sse}", zorder=3)
    room = PANEL_BEYOND * float(np.ptp(measured))
    axes.set_ylim(float(measured.min()) - room, float(measured.max()) + room)
    axes.set_ylabel("$y$")
    axes.margins(x=0.01)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.0), ncols=4)


def candidates_picture(table: Mapping[str, Any], unit: str) -> Canvas:
    """One-step and free-run error [``unit``] of each candidate of a search, and which was chosen."""
    rows = sorted(table["rows"], key=lambda row: (row["parameters"], row["free_run_rmse"]))
    at = np.arange(len(rows))
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 3.8), layout="constrained")
    axes = canvas.subplots()
    kinds = (("free_run_rmse", "free run", "o", "#0072b2"), ("rmse", "one step", "s", "#e69f00"))
    for key, words, mark, colour in kinds:
        axes.plot(at, [row[key] for row in rows], mark, color=colour, markersize=5, label=words)
    ring: Any = {"color": "#d55e00", "fillstyle": "none", "markersize": 12, "markeredgewidth": 1.6}
    beside: Any = {"xytext": (0, 10), "textcoords": "offset points", "ha": "center", "fontsize": "small"}
    for place in ((i, row["free_run_rmse"]) for i, row in enumerate(rows) if row["chosen"]):
        words = f"chosen by {rows[place[0]]['chosen']} of {table['seeds']}"
        axes.plot(*place, "o", **ring)
        axes.annotate(words, place, color="#d55e00", **beside)
    scale(axes.yaxis, np.array([row[key] for row in rows for key in ("free_run_rmse", "rmse")]))
    axes.set_ylabel(axis_label("validation RMSE", unit))
    axes.set_xlabel("past outputs, past inputs | hidden units, by number of parameters")
    axes.set_xticks(at, [f"{row['lags']} | {row['hidden']}" for row in rows], rotation=35, ha="right", fontsize="small")
    axes.margins(x=0.1, y=0.18)
    axes.set_title(f"Candidates of {table['model']}, {table['part']}", wrap=True)
    canvas.legend(loc="outside lower center", ncols=2)
    return canvas


# ----------------------------------------------------------------------------------- the replay of a law over a record
DONE = "#56b4e9"  # neither the baseline's grey nor the first law's colour
MOST_DRAWN_ROWS = 600  # rows: more cannot be told apart
CV_INCHES, MV_INCHES, ROOM_INCHES = 1.7, 1.9, 1.0  # inches


def replay_picture(evidence: Evidence, law: str) -> Canvas:
    """Each controlled variable with what the law was given as its set point, each MV as asked and as done."""
    loop = evidence.laws[law].replay()
    if not loop:
        raise NotMeasuredError
    plant = evidence.case.plant_class
    cvs, mvs = plant.sp_signals, plant.mv_signals
    heights = [CV_INCHES] * len(cvs) + [MV_INCHES] * len(mvs)
    canvas = Canvas(figsize=(PICTURE_SIZE[0], ROOM_INCHES + sum(heights)), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights})))
    rows = {name: values[-MOST_DRAWN_ROWS:] for name, values in loop.items()}
    time, words = time_axis(rows["time_s"])
    for i, (axes, signal) in enumerate(zip(panels, cvs, strict=False)):
        axes.plot(time, rows["pv"][:, i], color="black", linewidth=0.9, label="recorded")
        axes.plot(time, rows["sp"][:, i], label="set point of the replay: where the operation went", **SET_POINT)
        axes.set_ylabel(signal_label(signal))
    colour = colour_of(law, evidence.laws, evidence.case.baseline)
    for i, (axes, signal) in enumerate(zip(panels[len(cvs) :], mvs, strict=True)):
        axes.step(time, rows["done"][:, i], where="post", color=DONE, linewidth=1.6, label="done")
        axes.step(time, rows["asked"][:, i], where="post", color=colour, linewidth=1.0, label="asked by the law")
        axes.set_ylabel(signal_label(signal))
    panels[0].set_title(f"{law_name(law)} over the record, nothing fed back", wrap=True)
    panels[-1].set_xlabel(f"{words}, counted over the rows shown; gaps of the record are closed")
    panels[-1].margins(x=0.01)
    canvas.align_ylabels(panels)
    found = [axes.get_legend_handles_labels() for axes in (panels[0], panels[-1])]
    legend_below(canvas, [h for row, _ in found for h in row], [text for _, row in found for text in row], most=2)
    fit_labels(canvas)
    return canvas


def draw(result: SweepResult, path: Path) -> None:
    """RMSE overall and per region above, the number of centres below, the chosen partitions marked."""
    c = [row.partitions for row in result.rows]
    best = result.best
    figure = Canvas(figsize=(8.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    error, size = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    error.plot(c, [row.validation.rmse for row in result.rows], color="black", lw=2, label="validation")
    error.plot(c, [row.train.rmse for row in result.rows], color="0.6", lw=2, label="training")
    names = dict.fromkeys(name for row in result.rows for name in row.validation.regions)
    for i, name in enumerate(names):
        values = [row.validation.regions.get(name, float("nan")) for row in result.rows]
        error.plot(c, values, color=f"C{i}", lw=1, label=f"validation, {name}")
    error.plot([best.partitions], [best.validation.rmse], "o", color="C3", ms=7)
    error.set_title(
        f"best: c = {best.partitions}, {best.centres} centres, RMSE {best.validation.rmse:.3g} {result.unit}"
    )
    error.set_yscale("log")
    error.set_ylabel("RMSE" + (f" [{result.unit}]" if result.unit else ""))
    figure.legend(loc="outside lower center", frameon=False, ncols=3)
    size.plot(c, [row.centres for row in result.rows], color="black")
    size.set_ylabel("centres")
    size.set_xlabel("partitions c of each input")
    for axes in (error, size):
        axes.axvline(best.partitions, color="C3", lw=0.8, ls=":")
        axes.grid(alpha=0.3)
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=120, format=path.suffix.lstrip(".") or "png")


# -------------------------------------------- one step ahead and running free: a network's two errors beside each other
TRAINED = {"one_step_trained": ("one step", "s"), "free_run_trained": ("free runs", "o")}
"""Metrics of a part: the objective of the network's last training, and its mark."""
NETWORKS = {"nnarx": ("NNARX", PALETTE[0]), "state_space": ("state space", PALETTE[1])}

Figures = dict[str, list[float]]  # one_step_rmse, free_run_rmse, free_run_fit -> one value a data seed


def free_run_figures(evidence: Evidence, model_set: str, kind: str, trained: str, pv: str) -> Figures:
    """Figures of one PV over the data seeds, from fits of ``kind``; raises NotMeasuredError without any."""
    parts = (evidence.models.get(model_set, {}).get("parts") or {}).values()
    rows = [row for part in parts for row in (part.get("per_seed") or {}).values()]
    found = [row[kind][trained][pv] for row in rows if pv in ((row.get(kind) or {}).get(trained) or {})]
    if not found:
        raise NotMeasuredError
    return {key: [float(row[key]) for row in found] for key in found[0]}


def free_run_picture(model_set: str, pv: str, unit: str) -> Draw:
    """Error one step ahead against error running free, a point a data seed; a line joins a network's two trainings."""

    def draw(evidence: Evidence) -> Canvas:
        canvas = Canvas(figsize=(PICTURE_SIZE[0], 4.4), layout="constrained")
        axes = canvas.subplots()
        known: list[Figures] = []
        for kind, (name, colour) in NETWORKS.items():
            stages: list[Figures] = []
            for trained, (words, mark) in TRAINED.items():
                with suppress(NotMeasuredError):
                    found = free_run_figures(evidence, model_set, kind, trained, pv)
                    stages.append(found)
                    label = f"{name}, trained on {words}: fit {statistics.median(found['free_run_fit']):.2f} %"
                    style: Any = {"color": colour, "fillstyle": "full" if mark == "o" else "none", "zorder": 3}
                    axes.plot(found["one_step_rmse"], found["free_run_rmse"], mark, label=label, **style)
            for first, then in pairwise(stages):
                for key in range(len(first["one_step_rmse"])):
                    ends = [(run["one_step_rmse"][key], run["free_run_rmse"][key]) for run in (first, then)]
                    axes.plot(*zip(*ends, strict=True), color=colour, linewidth=0.8, alpha=0.6, zorder=2)
            known += stages
        if not known:
            raise NotMeasuredError
        for axis, metric in ((axes.xaxis, "one_step_rmse"), (axes.yaxis, "free_run_rmse")):
            scale(axis, np.array([v for found in known for v in found[metric]]))
        axes.set_xlabel(f"RMSE one step ahead [{unit}]")
        axes.set_ylabel(f"RMSE running free [{unit}]")
        clear_legend(axes, title="median fit of the free run")
        return canvas

    return draw


def free_run_fit_at_least(limit: float, model_set: str, kind: str, *pvs: str) -> Check:
    """A check that the kept network's long free run fits to ``limit`` [%] in every named PV, for every data seed."""

    def measure(evidence: Evidence) -> CheckOutcome:
        kept = {pv: free_run_figures(evidence, model_set, kind, "free_run_trained", pv) for pv in pvs}
        worst = {pv: min(found["free_run_fit"]) for pv, found in kept.items()}
        return CheckOutcome(", ".join(f"{pv} {fit:.2f} %" for pv, fit in worst.items()), min(worst.values()) >= limit)

    what = f"free-run fit of the {NETWORKS[kind][0]} network"
    return Check(what, measure, f"at least {limit:g} % of {' and '.join(pvs)}, whatever the data seed")


def one_step_says_little(model_set: str, kind: str, pv: str, unit: str, evidence: Evidence) -> CheckOutcome:
    """Whether of a network's two trainings the one more accurate one step ahead runs free the worse."""
    runs = [free_run_figures(evidence, model_set, kind, trained, pv) for trained in TRAINED]
    near, far = ([statistics.median(run[key]) for run in runs] for key in ("one_step_rmse", "free_run_fit"))
    shown = (
        f"one step ahead {number(near[0])}, then {number(near[1])} {unit}; "
        f"free-run fit {far[0]:.1f} %, then {far[1]:.1f} %"
    )
    limit = "trained on free runs: a larger error one step ahead, a smaller one running free (medians)"
    return CheckOutcome(shown, near[1] > near[0] and far[1] > far[0], limit)
