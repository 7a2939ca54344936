"""Pictures of loops that follow a reference model: levels, disturbances, training, and the models themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from loopwright.pipeline.cases.reversible_cstr.case import HOLD, NETWORK, PI, PLAIN, PRINTED
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Array, Loop
from loopwright.pipeline.evaluation.verdicts import CheckOutcome
from loopwright.pipeline.pictures.drawing import (
    PICTURE_SIZE,
    REFERENCE,
    SET_POINT,
    SHADES,
    CasePicture,
    axis_label,
    clear_legend,
    colour_of,
    layer,
    legend_below,
    scale,
    signal_label,
    symbol,
    time_axis,
)
from loopwright.pipeline.pictures.model_pictures import free_run_picture
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.pictures.words import law_name
from loopwright.pipeline.tuning.reference_model import CLASSIC, ORDERS, ReferenceModel

SPAN, STEP = 13.0, 0.02  # of the time wn t that is drawn
HEAD = ("order", "found: coefficients of $s^{n-1}..s^1$", "ITAE", "classic table", "ITAE")


def reference_models_picture(evidence: Evidence) -> Canvas:
    """Step responses of orders 1 to 6, found and classic, and the table of their coefficients and ITAE."""
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 6.4), layout="constrained")
    responses, table = canvas.subplots(2, 1, height_ratios=(2.2, 1))
    for order, colour in zip(ORDERS, SHADES, strict=True):
        for model, line in ((ReferenceModel.optimal(order), "-"), (ReferenceModel.classic(order), ":")):
            time, y = _step(model)
            responses.plot(time, y, line, color=colour, linewidth=1.3, label=f"n = {order}" if line == "-" else None)
    responses.plot([], [], ":", color="black", linewidth=1.3, label="classic table")
    responses.set_xlabel(r"time $\omega_n t$")
    responses.set_ylabel("response to a unit step")
    responses.legend(loc="lower right", ncols=2)
    _table(table)
    return canvas


def _step(model: ReferenceModel) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], ...]:
    time = np.arange(0.0, SPAN, STEP)
    # At rest at 0 before the step, which is there from the first sample on.
    levels = np.concatenate([[0.0], np.ones(len(time))])
    return time, model.response(levels, STEP)[1:, 0]


def _table(axes: Axes) -> None:
    kinds = (ReferenceModel.optimal, ReferenceModel.classic)
    cells = {n: [(_words(kind(n)), f"{kind(n).itae():.3f}") for kind in kinds] for n in ORDERS}
    rows = [[f"{order}", *ours, *classic] for order, (ours, classic) in cells.items()]
    axes.axis("off")
    drawn = axes.table(rows, colLabels=HEAD, cellLoc="left", loc="center", colWidths=(0.07, 0.37, 0.09, 0.33, 0.09))
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    for cell in drawn.get_celld().values():
        cell.set_edgecolor("#cccccc")


def _words(model: ReferenceModel) -> str:
    return "   ".join(f"{c:.3f}" for c in model.coefficients) or "–"


def beats_the_classic_tables(evidence: Evidence) -> CheckOutcome:
    """Whether the search's ITAE is below the classic table's for every order from 2."""
    pairs = {n: (ReferenceModel.optimal(n).itae(), ReferenceModel.classic(n).itae()) for n in CLASSIC if n > 1}
    shown = ", ".join(f"n = {n}: {ours:.3f} against {classic:.3f}" for n, (ours, classic) in pairs.items())
    return CheckOutcome(shown, all(ours < classic for ours, classic in pairs.values()))


LAWS = {
    "incremental network": NETWORK,
    "PI on the reference model": PI,
    "the paper's PID, sign settled": PRINTED,
    "two-error network": PLAIN,
}
LEVELS, DISTURBANCES = "levels", ("tin", "k", "ua", "dh")
UNTIL_S = 300.0  # of a disturbance's picture
LAST = 20  # samples of a level whose mean error is its offset


def _loops(evidence: Evidence, test: str) -> list[tuple[str, str, Loop]]:
    """(label, colour, loop) of each law that was run on a test."""
    colours = dict(zip(LAWS, SHADES, strict=False))
    loops = [(label, colours[label], evidence.loop(curve, test)) for label, curve in LAWS.items()]
    return [(label, colour, loop) for label, colour, loop in loops if loop is not None]


def _on_levels(evidence: Evidence) -> list[tuple[str, str, Loop]]:
    loops = _loops(evidence, LEVELS)
    if not loops:
        raise NotMeasuredError
    return loops


def _reference(evidence: Evidence) -> Array:
    (test, *_) = evidence.tests[LEVELS]
    return np.ravel(test.sp if test.reference is None else test.reference)


def levels_picture(evidence: Evidence) -> Canvas:
    """Set point, reference model and CV of each law; the distance from the reference; the MV."""
    loops, reference = _on_levels(evidence), _reference(evidence)
    cv, mv = evidence.case.plant_class.sp_signals[0], evidence.case.plant_class.mv_signals[0]
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 8.0), layout="constrained")
    course, distance, move = canvas.subplots(3, 1, sharex=True, height_ratios=(2.2, 1.6, 1.4))
    time, words = time_axis(loops[0][2]["time_s"])
    course.step(time, loops[0][2]["sp"][:, 0], where="post", label="set point", zorder=2, **SET_POINT)
    course.plot(time, reference, label="reference model", zorder=5, **REFERENCE)
    for rank, (label, colour, loop) in enumerate(loops):
        look = layer(rank)
        thin = {**look, "linewidth": 0.7 * look["linewidth"]}
        course.plot(time, loop["pv"][:, 0], color=colour, label=label, **look)
        distance.plot(time, np.abs(loop["pv"][:, 0] - reference), color=colour, linewidth=1.0)
        move.step(time, loop["mv"][:, 0], where="post", color=colour, **thin)
    distance.set_yscale("log")
    distance.set_ylim(1e-6, None)
    course.set_ylabel(signal_label(cv))
    distance.set_ylabel(axis_label("distance from\nreference", cv.unit))
    move.set_ylabel(signal_label(mv))
    move.set_xlabel(words)
    move.margins(x=0.01)
    canvas.align_ylabels()
    legend_below(canvas, most=3)
    return canvas


def disturbances_picture(evidence: Evidence) -> Canvas:
    """CV less its set point after each disturbance, a panel a test, with each law's IAE."""
    measured = [name for name in DISTURBANCES if _loops(evidence, name)]
    if not measured:
        raise NotMeasuredError
    rows = -(-len(measured) // 2)
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 1.4 + 2.8 * rows), layout="constrained")
    panels = canvas.subplots(rows, 2, squeeze=False).ravel()
    cv = evidence.case.plant_class.sp_signals[0]
    shown: dict[str, Any] = {}
    for axes, name in zip(panels, measured, strict=False):
        for rank, (label, colour, loop) in enumerate(_loops(evidence, name)):
            time, off = loop["time_s"], loop["pv"][:, 0] - loop["sp"][:, 0]
            iae = evidence.figure(LAWS[label].law, name, "iae", LAWS[label].setting)
            early, words = time <= UNTIL_S, "–" if iae is None else number(iae, 2)
            (line,) = axes.plot(time[early], off[early], color=colour, label=words, **layer(rank))
            shown.setdefault(label, line)
        axes.set_title(evidence.scenarios[name])
        axes.set_ylabel(axis_label(f"{symbol(cv.name)} less set point", cv.unit))
        axes.set_xlabel("time [s]")
    for axes in panels[len(measured) :]:
        axes.axis("off")
    legend_below(canvas, list(shown.values()), list(shown), most=2)
    for axes in panels[: len(measured)]:
        clear_legend(axes, fontsize="small", title="IAE", title_fontsize="small", ncols=2, handlelength=1.2)
    return canvas


def offsets_picture(evidence: Evidence) -> Canvas:
    """Mean error over the last samples of each level against the level: what a law without memory leaves."""
    cv = evidence.case.plant_class.sp_signals[0]
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 3.8), layout="constrained")
    axes = canvas.subplots()
    for rank, (label, colour, loop) in enumerate(_on_levels(evidence)):
        sp, error = loop["sp"][:, 0], loop["sp"][:, 0] - loop["pv"][:, 0]
        level, offset = sp.reshape(-1, HOLD)[:, 0], error.reshape(-1, HOLD)[:, -LAST:].mean(axis=1)
        order = np.argsort(level)
        axes.plot(level[order], offset[order], "o-", color=colour, markersize=4 + 2 * rank, label=label, **layer(rank))
    axes.axhline(0.0, color="black", linewidth=0.8, zorder=2)
    axes.set_xlabel(axis_label("set point", cv.unit))
    axes.set_ylabel(axis_label(f"offset on {LEVELS}", cv.unit))
    clear_legend(axes)
    return canvas


def training_picture(evidence: Evidence) -> Canvas:
    """Distance from the reference model over the iterations: on the training loops, and on those of validation."""
    arrays = {curve.law: evidence.analysis_arrays(curve) for curve in (NETWORK, PLAIN, PI)}
    histories = {name: a for name, a in arrays.items() if "history" in a}
    if not histories:
        raise NotMeasuredError
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 4.2), layout="constrained")
    axes = canvas.subplots()
    for name, values in histories.items():
        history, best = values["history"], int(values["best"][0])
        colour = colour_of(name, evidence.laws, evidence.case.baseline)
        axes.plot(history[:, 0], color=colour, linewidth=1.3, label=law_name(name))
        axes.plot(history[:, 1], ":", color=colour, linewidth=1.5)
        axes.plot([best], history[best, 1], "o", color=colour, markersize=5)
    for style, words in (("-", "training loops"), (":", "validation loops"), ("o", "the chosen iteration")):
        axes.plot([], [], style, color="black", linewidth=1.3, markersize=5, label=words)
    scale(axes.yaxis, np.concatenate([np.ravel(values["history"][:, :2]) for values in histories.values()]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("iteration of Levenberg-Marquardt")
    axes.set_ylabel(axis_label("RMS from the reference model", evidence.case.cv_unit))
    legend_below(canvas, most=3)
    return canvas


PICTURES = (
    CasePicture("levels_after_the_reference", "Twelve levels after the reference model", levels_picture),
    CasePicture("disturbances", "Four disturbances at 0.46 mol/l", disturbances_picture),
    CasePicture("offsets", "What is left of the error at the end of each level", offsets_picture),
    CasePicture("training", "Training through time", training_picture),
    CasePicture("reference_models", "Reference models of least ITAE", reference_models_picture),
    CasePicture(
        "free_runs",
        "Plant networks, one step ahead and running free",
        free_run_picture("plant_network", "C_B", "mol/l"),
    ),
)
