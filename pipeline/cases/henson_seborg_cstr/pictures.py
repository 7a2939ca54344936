"""Pictures of a local model network and of what blends over it: free run, phase plane, linear loops, responses."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.cases.henson_seborg_cstr.case import ALONE, AUTO, GAINS, OUTPUTS, PID_1, TUNED, VELOCITY
from loopwright.pipeline.evaluation.case import Curve
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Loop
from loopwright.pipeline.pictures.drawing import (
    PALETTE,
    PICTURE_SIZE,
    SET_POINT,
    CasePicture,
    Draw,
    axis_label,
    clear_legend,
    colour_of,
    layer,
    legend_below,
    signal_label,
    time_axis,
)

PLANT, NETWORK = "black", PALETTE[0]
RECOVERED, LOST, ROAD = PALETTE[1], PALETTE[0], "#bbbbbb"


def free_run_picture(evidence: Evidence) -> Canvas:
    """States of the plant and of the network alone under the same MV, one panel each, and the MV below."""
    arrays = evidence.predictions("local_models")
    if not {"time_s", "mv", "actual", "predicted"} <= set(arrays):
        raise NotMeasuredError
    plant = evidence.case.equations
    n = arrays["actual"].shape[1]
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 1.0 + 1.7 * (n + 1)), layout="constrained")
    panels = list(canvas.subplots(n + 1, 1, sharex=True))
    time, words = time_axis(np.ravel(arrays["time_s"]))
    for i, (axes, signal) in enumerate(zip(panels, plant.state_signals, strict=False)):
        axes.plot(time, arrays["actual"][:, i], color=PLANT, label="plant", **layer(1))
        axes.plot(time, arrays["predicted"][:, i], "--", color=NETWORK, label="network alone", **layer(0))
        axes.set_ylabel(signal_label(signal))
    panels[-1].step(time, np.ravel(arrays["mv"]), where="post", color=PLANT, linewidth=1.0)
    panels[-1].set_ylabel(signal_label(plant.mv_signals[0]))
    panels[-1].set_xlabel(words)
    canvas.align_ylabels(panels)
    clear_legend(panels[0])
    return canvas


def phase_picture(evidence: Evidence) -> Canvas:
    """Where the Monte Carlo starts lie and which came to their set points, a panel a law; and where none comes back."""
    found = {c.law: arrays for c in (GAINS, AUTO) if "start" in (arrays := evidence.analysis_arrays(c))}
    if not found:
        raise NotMeasuredError
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 5.4), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(1, len(found), sharex=True, sharey=True)))
    cvs, xs, _ = evidence.case.equations.steady_curve
    for axes, (law, arrays) in zip(panels, found.items(), strict=True):
        good = arrays["arrived"] > 0
        start = arrays["start"]
        for i, course in enumerate(arrays["courses"]):
            axes.plot(*course[:, :2].T, color=ROAD, linewidth=0.7, zorder=1, label=None if i else "courses of some")
        axes.plot(*start[good].T, ".", color=RECOVERED, markersize=1.6, zorder=2, label="recovered")
        axes.plot(*start[~good].T, "x", color=LOST, markersize=7, zorder=5, label="did not")
        axes.plot(cvs, xs[:, 1], color="black", linewidth=1.6, zorder=3, label="steady states of the range")
        _other_rests(axes, arrays)
        axes.set_xscale("log")
        axes.set_title(f"{evidence.laws[law].title}\n{good.sum()} of {len(good)} recovered")
        axes.set_xlabel(signal_label(evidence.case.equations.state_signals[0]))
    panels[0].set_ylabel(signal_label(evidence.case.equations.state_signals[1]))
    handles, labels = panels[0].get_legend_handles_labels()
    legend_below(canvas, handles, labels, most=3, markerscale=1.5)
    return canvas


def _other_rests(axes: Axes, arrays: Loop) -> None:
    rests, back = arrays.get("other_rest", np.empty((0, 2))), arrays.get("other_rest_arrived", np.empty(0)) > 0
    courses = arrays.get("other_rest_courses", np.empty((0, 1, 2)))
    for course in courses:
        axes.plot(course[:, 0], course[:, 1], color="black", linewidth=0.8, linestyle=":", zorder=4)
    axes.plot(*rests[~back].T, "s", color=LOST, markersize=6, zorder=6, label="gone out: does not return")
    axes.plot(*rests[back].T, "s", color=RECOVERED, markersize=6, zorder=6, label="too hot, comes back")


def frozen_picture(curves: Sequence[tuple[Curve, str]]) -> Draw:
    """Largest eigenvalue of the linear loop over the set point, and what a Lyapunov function of each pair proves."""

    def draw(evidence: Evidence) -> Canvas:
        kept = {words: evidence.analysis_arrays(curve) for curve, words in curves}
        found = {words: arrays for words, arrays in kept.items() if "frozen_radius" in arrays}
        if not found:
            raise NotMeasuredError
        canvas = Canvas(figsize=(PICTURE_SIZE[0], 4.6), layout="constrained")
        axes = canvas.subplots()
        for i, (words, arrays) in enumerate(found.items()):
            colour = PALETTE[i % len(PALETTE)]
            axes.plot(arrays["frozen_cv"], arrays["frozen_radius"], color=colour, linewidth=1.5, label=words, zorder=3)
            if "contraction" not in arrays:
                continue
            proved = ~np.isnan(arrays["contraction"])
            for (a, b), rate in zip(pairwise(arrays["points"]), arrays["contraction"], strict=True):
                axes.plot([a, b], [rate, rate], color=colour, linewidth=4, alpha=0.35, solid_capstyle="butt", zorder=2)
            legend = f"{int(proved.sum())} of {len(proved)} pairs proved"
            axes.plot([], [], color=colour, linewidth=4, alpha=0.35, label=legend)
        axes.axhline(1.0, color="black", linewidth=0.9, linestyle="--")
        for at in next(iter(found.values()))["points"]:
            axes.axvline(at, color="#999999", linewidth=0.8, linestyle=":")
        axes.set_xlabel(signal_label(evidence.case.equations.state_signals[0]))
        axes.set_ylabel("factor per period")
        axes.set_title("lines: spectral radius; bars: contraction with one Lyapunov function", fontsize="medium")
        legend_below(canvas, most=3)
        return canvas

    return draw


def responses_picture(
    tests: Sequence[tuple[str, str]], curves: Sequence[tuple[Curve, str]], window: tuple[float, float] | None = None
) -> Draw:
    """Controlled variable, its error and the MV, a column a test ``(name, words)``; ``curves`` with their words.

    ``window`` is the time [min] that is shown; None all of it.
    """

    def draw(evidence: Evidence) -> Canvas:
        if not any(evidence.loop(curve, name) for curve, _ in curves for name, _ in tests):
            raise NotMeasuredError
        canvas = Canvas(figsize=(PICTURE_SIZE[0], 6.4), layout="constrained")
        panels = canvas.subplots(3, len(tests), sharex="col", sharey="row", height_ratios=(3, 2, 2), squeeze=False)
        for column, (name, words) in zip(panels.T, tests, strict=True):
            for i, (curve, label) in enumerate(curves):
                loop = evidence.loop(curve, name)
                if loop is not None:
                    look = {"color": _colour(evidence, curves, i), **layer(i)}
                    _response(column, loop, look, _with_figure(evidence, curve, name, label))
            column[0].set_title(words)
            if window is not None:
                column[0].set_xlim(*window)
        cv, mv = evidence.case.plant_class.sp_signals[0], evidence.case.plant_class.mv_signals[0]
        for axes, label in zip(
            panels[:, 0], (signal_label(cv), axis_label("error", cv.unit), signal_label(mv)), strict=True
        ):
            axes.set_ylabel(label)
        canvas.align_ylabels(list(panels[:, 0]))
        for axes in panels[0]:
            clear_legend(axes, fontsize="small")
        return canvas

    return draw


def _response(column: Sequence[Axes], loop: Loop, look: dict[str, Any], label: str) -> None:
    time = loop["time_s"] / 60.0
    above, middle, below = column
    sp, cv = np.ravel(loop["sp"]), loop["pv"][:, 0]
    if not above.lines:
        above.plot(time, sp, drawstyle="steps-post", label="set point", zorder=2, **SET_POINT)
    above.plot(time, cv, label=label, **look)
    middle.plot(time, sp - cv, **look)
    below.step(time, np.ravel(loop["mv"]), where="post", **{**look, "linewidth": 0.7 * look["linewidth"]})
    below.set_xlabel("time [min]")
    above.margins(x=0.01)


def _with_figure(evidence: Evidence, curve: Curve, test: str, label: str) -> str:
    iae = evidence.figure(curve.law, test, "iae", curve.setting)
    return label if iae is None else f"{label}: IAE {iae:.4f}"


def _colour(evidence: Evidence, curves: Sequence[tuple[Curve, str]], i: int) -> str:
    laws = [curve.law for curve, _ in curves]
    if len(set(laws)) < len(laws):
        return PALETTE[i % len(PALETTE)]
    return colour_of(laws[i], evidence.laws, evidence.case.baseline)


NETWORKS = ((GAINS, "network"), (AUTO, "one knob"), (PID_1, "PID 1"))
PICTURES = (
    CasePicture("local_models", "Plant and local model network on the staircase", free_run_picture),
    CasePicture(
        "up_down",
        "Up and down through the range: the network, its one-knob form, and PID 1 alone",
        responses_picture((("up", "up"), ("down", "down")), NETWORKS),
    ),
    CasePicture(
        "jumps",
        "One jump over the range, and back",
        responses_picture((("jump", "jump"), ("jump_down", "jump down")), NETWORKS, (4.5, 9.0)),
    ),
    CasePicture(
        "feed",
        "Changes of the feed that nobody measures",
        responses_picture(
            (("feed_temperature", "feed temperature"), ("feed_concentration", "feed concentration")), NETWORKS
        ),
    ),
    CasePicture(
        "blending",
        "What is blended, and PIDs alone",
        responses_picture(
            (("up", "set points up"),),
            ((PID_1, "PID 1"), (OUTPUTS, "outputs"), (VELOCITY, "velocity"), (GAINS, "gains"), (ALONE[0], "PID 2")),
        ),
    ),
    CasePicture(
        "frozen_loops",
        "Linear closed loops over the set point, and what Lyapunov functions of neighbours prove",
        frozen_picture(
            (
                (GAINS, "printed, gains"),
                (AUTO, "one knob, gains"),
                (OUTPUTS, "printed, outputs"),
                (PID_1, "PID 1"),
                (TUNED, "PID tuned in closed loop"),
            )
        ),
    ),
    CasePicture("phase_plane", "Where 2,000 starts go, and the state from which none returns", phase_picture),
)
