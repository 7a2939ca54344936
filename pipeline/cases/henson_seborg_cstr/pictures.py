"""Pictures of a local model network and of what blends over it: free run, phase plane, linear loops, responses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from pipeline.evaluation.case import Curve
from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.law_evidence import Loop
from pipeline.pictures.drawing import (
    PALETTE,
    SET_POINT,
    SIZE,
    axis_label,
    clear_legend,
    colour_of,
    layer,
    legend_below,
    symbol,
    time_axis,
)

PLANT, NETWORK = "black", PALETTE[0]
RECOVERED, LOST, ROAD = PALETTE[1], PALETTE[0], "#bbbbbb"
LAWS = ("local_pid_network", "auto_pid_network")

Draw = Callable[[Evidence], Canvas | None]


def free_run_picture(model_set: str) -> Draw:
    """States of the plant and of the network alone under the same MV, one panel each, and the MV below."""

    def draw(evidence: Evidence) -> Canvas | None:
        arrays = _predictions(evidence, model_set)
        if not {"time_s", "mv", "actual", "predicted"} <= set(arrays):
            return None
        plant = evidence.case.equations
        states, n = plant.state_signals, arrays["actual"].shape[1]
        canvas = Canvas(figsize=(SIZE[0], 1.0 + 1.7 * (n + 1)), layout="constrained")
        panels = list(canvas.subplots(n + 1, 1, sharex=True))
        time, words = time_axis(np.ravel(arrays["time_s"]))
        for i, (axes, signal) in enumerate(zip(panels, states, strict=False)):
            axes.plot(time, arrays["actual"][:, i], color=PLANT, label="plant", **layer(1))
            axes.plot(time, arrays["predicted"][:, i], "--", color=NETWORK, label="network alone", **layer(0))
            axes.set_ylabel(axis_label(symbol(signal.name), signal.unit))
        mv = plant.mv_signals[0]
        panels[-1].step(time, np.ravel(arrays["mv"]), where="post", color=PLANT, linewidth=1.0)
        panels[-1].set_ylabel(axis_label(symbol(mv.name), mv.unit))
        panels[-1].set_xlabel(words)
        canvas.align_ylabels(panels)
        clear_legend(panels[0])
        return canvas

    return draw


def phase_picture(evidence: Evidence) -> Canvas | None:
    """Where the Monte Carlo starts lie and which came to their set points, a panel a law; and where none comes back."""
    found = [(law, _analysis(evidence, Curve(law))) for law in LAWS]
    found = [(law, arrays) for law, arrays in found if "start" in arrays]
    if not found:
        return None
    canvas = Canvas(figsize=(SIZE[0], 5.4), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(1, len(found), sharex=True, sharey=True)))
    cvs, xs, _ = evidence.case.equations.steady_curve
    for axes, (law, arrays) in zip(panels, found, strict=True):
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
        axes.set_xlabel(_label(evidence, 0))
    panels[0].set_ylabel(_label(evidence, 1))
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

    def draw(evidence: Evidence) -> Canvas | None:
        found = [(words, _analysis(evidence, curve)) for curve, words in curves]
        found = [(words, arrays) for words, arrays in found if "frozen_radius" in arrays]
        if not found:
            return None
        canvas = Canvas(figsize=(SIZE[0], 4.6), layout="constrained")
        axes = canvas.subplots()
        for i, (words, arrays) in enumerate(found):
            colour = PALETTE[i % len(PALETTE)]
            axes.plot(arrays["frozen_cv"], arrays["frozen_radius"], color=colour, linewidth=1.5, label=words, zorder=3)
            if "contraction" not in arrays:
                continue
            proved = ~np.isnan(arrays["contraction"])
            for (a, b), rate in zip(pairwise(arrays["points"]), arrays["contraction"], strict=True):
                axes.plot([a, b], [rate, rate], color=colour, linewidth=4, alpha=0.35, solid_capstyle="butt", zorder=2)
            said = f"{int(proved.sum())} of {len(proved)} pairs proved"
            axes.plot([], [], color=colour, linewidth=4, alpha=0.35, label=said)
        axes.axhline(1.0, color="black", linewidth=0.9, linestyle="--")
        for at in found[0][1]["points"]:
            axes.axvline(at, color="#999999", linewidth=0.8, linestyle=":")
        axes.set_xlabel(_label(evidence, 0))
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

    def draw(evidence: Evidence) -> Canvas | None:
        if not any(evidence.loop(curve, name) for curve, _ in curves for name, _ in tests):
            return None
        canvas = Canvas(figsize=(SIZE[0], 6.4), layout="constrained")
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
        mv = evidence.case.plant_class.mv_signals[0]
        panels[0, 0].set_ylabel(_label(evidence, 0))
        panels[1, 0].set_ylabel(axis_label("error", evidence.case.plant_class.sp_signals[0].unit))
        panels[2, 0].set_ylabel(axis_label(symbol(mv.name), mv.unit))
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


def _label(evidence: Evidence, state: int) -> str:
    signal = evidence.case.equations.state_signals[state]
    return axis_label(symbol(signal.name), signal.unit)


def _analysis(evidence: Evidence, curve: Curve) -> Loop:
    law = evidence.laws.get(curve.law)
    return {} if law is None else law.analysis_arrays(curve.setting)


def _predictions(evidence: Evidence, model_set: str) -> Loop:
    """What the fit of a model set kept beside its figures; the stages' folders lie side by side."""
    for law in evidence.laws.values():
        path = law.trajectories.parents[2] / "models" / model_set / "predictions.npz"
        if path.exists():
            with np.load(path, allow_pickle=False) as file:
                return {key: np.asarray(file[key], float) for key in file.files}
    return {}
