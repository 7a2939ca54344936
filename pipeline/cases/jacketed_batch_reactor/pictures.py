"""Pictures of the fuzzy laws' loops: core, jacket, throttle and mode; switches over their penalty; offsets."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.patheffects import withStroke

from loopwright.pipeline.cases.jacketed_batch_reactor.case import AHEAD, FEEDFORWARD, LAWS, OBSERVER, PENALTIES, PRINTED
from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_models import MODES, coefficients_picture, reach_picture
from loopwright.pipeline.evaluation.case import Curve
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.pictures.drawing import (
    PALETTE,
    PICTURE_SIZE,
    SET_POINT,
    CasePicture,
    Draw,
    colour_of,
    legend_below,
    scale,
    time_axis,
)
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.pictures.words import law_name

SMALLEST = 1e-4  # [deg C] that a bar of offsets shows
ROOM = 1.6  # factor above the highest point of a logarithmic axis, for its number
CORE, ADJUSTED, JACKET, WANTED = PALETTE[1], PALETTE[5], PALETTE[3], PALETTE[7]
HALO = (withStroke(linewidth=2.5, foreground="white"),)
NOISY = {"profile_noise": "on the reactor", "same_model_noise": "on the printed model"}
OFF = {
    "profile_noise": "reactor",
    "theta_10_noise": "printed model,\njacket off by 10 %",
    "theta_20_noise": "printed model,\njacket off by 20 %",
    "held_out_noise": "random recipes\non the reactor",
}


def recipe_picture(curve: Curve, scenario: str) -> Draw:
    """A loop over a recipe: core with its adjusted reference, jacket with what was wanted of it, throttle, mode."""

    def draw(evidence: Evidence) -> Canvas:
        loop, info = evidence.info(curve, scenario, "adjusted_reference", "wanted_jacket")
        time, words = time_axis(loop["time_s"])
        canvas = Canvas(figsize=(PICTURE_SIZE[0], 8.4), layout="constrained")
        core, jacket, throttle, mode = canvas.subplots(4, 1, sharex=True, height_ratios=(3, 2.2, 1.6, 0.6))
        core.step(time, loop["sp"][:, 0], where="post", label="set point", **SET_POINT)
        core.plot(time, loop["pv"][:, 0], color=CORE, linewidth=2.6, label="core")
        core.plot(time[AHEAD:], info["adjusted_reference"][:-AHEAD], "--", color=ADJUSTED, linewidth=1.3,
                  label="adjusted reference")  # fmt: skip
        jacket.plot(time, loop["pv"][:, 1], color=JACKET, linewidth=2.2, label="jacket")
        jacket.plot(time[1:], info["wanted_jacket"][:-1], ":", color=WANTED, linewidth=1.3, label="wanted jacket")
        throttle.step(time, loop["mv"][:, 0], where="post", color="black", linewidth=0.9)
        for value, (word, colour) in enumerate(MODES.items(), start=1):
            here = loop["mv"][:, 1] == value
            mode.fill_between(time, 0, 1, where=here, step="post", color=colour, linewidth=0, label=word)
        changes = np.count_nonzero(np.diff(loop["mv"][:, 1]))
        mode.set_title(f"{changes} switches", fontsize="medium", fontweight="normal")
        mode.set_ylabel("mode")
        mode.set_yticks([])
        mode.grid(visible=False)
        for axes, label in ((core, "core [°C]"), (jacket, "jacket [°C]"), (throttle, "$k_M$")):
            axes.set_ylabel(label)
        mode.set_xlabel(words)
        for axes in (core, jacket, throttle, mode):
            axes.margins(x=0.01)
        canvas.align_ylabels()
        legend_below(canvas, most=4)
        return canvas

    return draw


def switches_picture(evidence: Evidence) -> Canvas:
    """Switches of the mode, and the largest offset, over the price of a switch; a line a test."""
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 4.2), layout="constrained")
    left, right = canvas.subplots(1, 2)
    forms = [Curve(OBSERVER, {"switch_penalty": p}) for p in PENALTIES]
    for (scenario, label), colour in zip(NOISY.items(), PALETTE, strict=False):
        counts, offsets = (
            [evidence.measured(form, scenario, metric) for form in forms] for metric in ("switches", "max_asse")
        )
        left.plot(PENALTIES, counts, "o-", color=colour, label=label)
        right.plot(PENALTIES, offsets, "o-", color=colour)
        for place in zip(PENALTIES, counts, strict=True):
            left.annotate(f"{place[1]:g}", place, xytext=(5, 5), textcoords="offset points",
                          color=colour, path_effects=HALO, zorder=5)  # fmt: skip
    counted = np.concatenate([np.asarray(line.get_ydata(), float) for line in left.lines])
    scale(left.yaxis, counted)
    if left.get_yscale() == "log":
        left.set_ylim(None, ROOM * float(counted.max()))
    left.set_ylabel("switches of the mode")
    right.set_ylabel("largest offset [°C]")
    right.set_ylim(0.0, 1.1 * max(float(np.max(line.get_ydata())) for line in right.lines))
    for axes in (left, right):
        axes.margins(x=0.15)
        axes.set_xlabel("penalty of a switch [°C of the jacket]")
    legend_below(canvas, most=2)
    return canvas


def offsets_picture(evidence: Evidence) -> Canvas:
    """Mean and largest offset of each law where the model is off and the signals are noisy."""
    mean, largest = (
        {law: np.array([evidence.measured(law, test, metric) for test in OFF]) for law in LAWS}
        for metric in ("masse", "max_asse")
    )
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 4.4), layout="constrained")
    axes = canvas.subplots()
    wide = 0.8 / len(LAWS)
    for i, law in enumerate(LAWS):
        at = np.arange(len(OFF)) + (i - (len(LAWS) - 1) / 2) * wide
        colour = colour_of(law, evidence.laws, evidence.case.baseline)
        axes.bar(at, mean[law], 0.9 * wide, color=colour, label=law_name(law))
        axes.vlines(at, mean[law], largest[law], color=colour, linewidth=1.2)
        axes.plot(at, largest[law], "_", color=colour, markersize=9)
        for place in zip(at, largest[law], strict=True):
            axes.annotate(number(place[1], 2), place, xytext=(0, 4), textcoords="offset points",
                          ha="center", fontsize="small", path_effects=HALO, zorder=5)  # fmt: skip
    axes.set_yscale("log")
    axes.set_axisbelow(True)
    axes.set_ylim(SMALLEST, 2.0 * ROOM * max(float(row.max()) for row in largest.values()))
    axes.set_xticks(range(len(OFF)), list(OFF.values()))
    axes.set_ylabel("offset at the end of a level [°C]")
    axes.set_title("bar: mean over the levels; mark and number: largest", fontweight="normal", fontsize="medium")
    legend_below(canvas, most=len(LAWS))
    return canvas


PICTURES = (
    CasePicture(
        "recipe_same_model",
        "The recipe by feedforward on the printed model itself",
        recipe_picture(Curve(FEEDFORWARD, PRINTED), "same_model"),
    ),
    CasePicture(
        "recipe_reactor",
        "The recipe on the reactor with noise, by a tied model with offset observers",
        recipe_picture(Curve(OBSERVER), "profile_noise"),
    ),
    CasePicture("offsets", "Offset where the model is not the plant, with noise", offsets_picture),
    CasePicture("switches", "What a price on switching does, with noise", switches_picture),
    CasePicture("reach", "What the modes reach under each identification", reach_picture),
    CasePicture("coefficients", "Coefficients beside the reactor's", coefficients_picture),
)
