"""Pictures of loops that follow a reference model: levels, disturbances, and how the controllers were trained."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from pipeline.evaluation.case import Curve
from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.law_evidence import Array, Loop
from pipeline.pictures.drawing import (
    REFERENCE,
    SET_POINT,
    SHADES,
    SIZE,
    axis_label,
    clear_legend,
    colour_of,
    layer,
    legend_below,
    scale,
    symbol,
    time_axis,
)
from pipeline.pictures.words import law_name, number, scenario_name

Draw = Callable[[Evidence], Canvas | None]


def _loops(evidence: Evidence, curves: Mapping[str, Curve], scenario: str) -> list[tuple[str, str, Loop]]:
    """(label, colour, loop) of each curve that was run."""
    colours = dict(zip(curves, SHADES, strict=False))
    found = [(label, colours[label], evidence.loop(curve, scenario)) for label, curve in curves.items()]
    return [(label, colour, loop) for label, colour, loop in found if loop is not None]


def _reference(evidence: Evidence, scenario: str) -> Array:
    (test, *_) = evidence.tests[scenario]
    return np.ravel(test.sp if test.reference is None else test.reference)


def levels_picture(scenario: str, curves: Mapping[str, Curve]) -> Draw:
    """Set point, reference model and CV of each curve; the distance from the reference; the MV."""

    def draw(evidence: Evidence) -> Canvas | None:
        found = _loops(evidence, curves, scenario)
        if not found:
            return None
        cv, mv = evidence.case.plant_class.sp_signals[0], evidence.case.plant_class.mv_signals[0]
        canvas = Canvas(figsize=(SIZE[0], 8.0), layout="constrained")
        course, distance, move = canvas.subplots(3, 1, sharex=True, height_ratios=(2.2, 1.6, 1.4))
        reference = _reference(evidence, scenario)
        time, words = time_axis(found[0][2]["time_s"])
        course.step(time, found[0][2]["sp"][:, 0], where="post", label="set point", zorder=2, **SET_POINT)
        course.plot(time, reference, label="reference model", zorder=5, **REFERENCE)
        for rank, (label, colour, loop) in enumerate(found):
            look = layer(rank)
            thin = {**look, "linewidth": 0.7 * look["linewidth"]}
            course.plot(time, loop["pv"][:, 0], color=colour, label=label, **look)
            distance.plot(time, np.abs(loop["pv"][:, 0] - reference), color=colour, linewidth=1.0)
            move.step(time, loop["mv"][:, 0], where="post", color=colour, **thin)
        distance.set_yscale("log")
        distance.set_ylim(1e-6, None)
        course.set_ylabel(axis_label(symbol(cv.name), cv.unit))
        distance.set_ylabel(axis_label("distance from\nreference", cv.unit))
        move.set_ylabel(axis_label(symbol(mv.name), mv.unit))
        move.set_xlabel(words)
        move.margins(x=0.01)
        canvas.align_ylabels()
        legend_below(canvas, most=3)
        return canvas

    return draw


def disturbances_picture(scenarios: Sequence[str], curves: Mapping[str, Curve], until_s: float) -> Draw:
    """CV less its set point after each disturbance, a panel a test, with each curve's IAE."""

    def draw(evidence: Evidence) -> Canvas | None:
        known = [name for name in scenarios if _loops(evidence, curves, name)]
        if not known:
            return None
        rows = -(-len(known) // 2)
        canvas = Canvas(figsize=(SIZE[0], 1.4 + 2.8 * rows), layout="constrained")
        panels = canvas.subplots(rows, 2, squeeze=False).ravel()
        cv = evidence.case.plant_class.sp_signals[0]
        shown: dict[str, Any] = {}
        for axes, name in zip(panels, known, strict=False):
            for rank, (label, colour, loop) in enumerate(_loops(evidence, curves, name)):
                _deviation(axes, loop, {"color": colour, **layer(rank)}, until_s)
                shown.setdefault(label, axes.lines[-1])
                iae = evidence.figure(curves[label].law, name, "iae", curves[label].setting)
                axes.lines[-1].set_label("–" if iae is None else number(iae, 2))
            axes.set_title(evidence.scenarios[name])
            axes.set_ylabel(axis_label(f"{symbol(cv.name)} less set point", cv.unit))
            axes.set_xlabel("time [s]")
        for axes in panels[len(known) :]:
            axes.axis("off")
        legend_below(canvas, list(shown.values()), list(shown), most=2)
        for axes in panels[: len(known)]:
            clear_legend(axes, fontsize="small", title="IAE", title_fontsize="small", ncols=2, handlelength=1.2)
        return canvas

    return draw


def _deviation(axes: Axes, loop: Loop, look: dict[str, Any], until_s: float) -> None:
    shown = loop["time_s"] <= until_s
    axes.plot(loop["time_s"][shown], (loop["pv"][:, 0] - loop["sp"][:, 0])[shown], **look)


def training_picture(laws: Sequence[str]) -> Draw:
    """Distance from the reference model over the iterations: on the training loops, and on those of validation."""

    def draw(evidence: Evidence) -> Canvas | None:
        arrays = {name: evidence.laws[name].analysis_arrays({}) for name in laws if name in evidence.laws}
        found = {name: a for name, a in arrays.items() if "history" in a}
        if not found:
            return None
        unit = evidence.case.plant_class.sp_signals[0].unit
        canvas = Canvas(figsize=(SIZE[0], 4.2), layout="constrained")
        axes = canvas.subplots()
        for name, values in found.items():
            history, best = values["history"], int(values["best"][0])
            colour = colour_of(name, evidence.laws, evidence.case.baseline)
            axes.plot(history[:, 0], color=colour, linewidth=1.3, label=law_name(name))
            axes.plot(history[:, 1], ":", color=colour, linewidth=1.5)
            axes.plot([best], history[best, 1], "o", color=colour, markersize=5)
        for style, words in (("-", "training loops"), (":", "validation loops"), ("o", "the iteration that was kept")):
            axes.plot([], [], style, color="black", linewidth=1.3, markersize=5, label=words)
        scale(axes.yaxis, np.concatenate([np.ravel(values["history"][:, :2]) for values in found.values()]))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("iteration of Levenberg-Marquardt")
        axes.set_ylabel(axis_label("RMS from the reference model", unit))
        legend_below(canvas, most=3)
        return canvas

    return draw


def offsets_picture(scenario: str, curves: Mapping[str, Curve], hold: int, last: int = 20) -> Draw:
    """Mean error over the last samples of each level against the level: what a law without memory leaves."""

    def draw(evidence: Evidence) -> Canvas | None:
        found = _loops(evidence, curves, scenario)
        if not found:
            return None
        cv = evidence.case.plant_class.sp_signals[0]
        canvas = Canvas(figsize=(SIZE[0], 3.8), layout="constrained")
        axes = canvas.subplots()
        for rank, (label, colour, loop) in enumerate(found):
            sp, error = loop["sp"][:, 0], loop["sp"][:, 0] - loop["pv"][:, 0]
            level = sp.reshape(-1, hold)[:, 0]
            offset = error.reshape(-1, hold)[:, -last:].mean(axis=1)
            order = np.argsort(level)
            axes.plot(
                level[order], offset[order], "o-", color=colour, markersize=4 + 2 * rank, label=label, **layer(rank)
            )
        axes.axhline(0.0, color="black", linewidth=0.8, zorder=2)
        axes.set_xlabel(axis_label("set point", cv.unit))
        axes.set_ylabel(axis_label(f"offset on {scenario_name(scenario, False)}", cv.unit))
        clear_legend(axes)
        return canvas

    return draw
