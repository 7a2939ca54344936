"""Pictures of the fuzzy laws' loops: core, jacket, throttle and mode; switches over their penalty; offsets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.patheffects import withStroke

from pipeline.evaluation.case import Curve
from pipeline.evaluation.evidence import Evidence
from pipeline.pictures.drawing import PALETTE, SET_POINT, SIZE, colour_of, legend_below, scale, time_axis
from pipeline.pictures.words import law_name, number

Draw = Callable[[Evidence], Canvas | None]
HOT, COLD = "#d55e00", "#0072b2"
AHEAD = 2  # samples between the step that tells an adjusted reference of the core and the sample that it is for
SMALLEST = 1e-4  # [deg C] that a bar of offsets shows
ROOM = 1.6  # factor above the highest point of a logarithmic axis, for its number
CORE, ADJUSTED, JACKET, WANTED = PALETTE[1], PALETTE[5], PALETTE[3], PALETTE[7]
HALO = (withStroke(linewidth=2.5, foreground="white"),)


def recipe_picture(curve: Curve, scenario: str) -> Draw:
    """A loop over a recipe: core with its adjusted reference, jacket with what was wanted of it, throttle, mode."""

    def draw(evidence: Evidence) -> Canvas | None:
        loop, law = evidence.loop(curve, scenario), evidence.laws.get(curve.law)
        names = () if law is None else law.info(curve.setting)
        if loop is None or not {"adjusted_reference", "wanted_jacket"} <= set(names):
            return None
        told = {name: loop["info"][:, i] for i, name in enumerate(names)}
        time, words = time_axis(loop["time_s"])
        canvas = Canvas(figsize=(SIZE[0], 8.4), layout="constrained")
        core, jacket, throttle, mode = canvas.subplots(4, 1, sharex=True, height_ratios=(3, 2.2, 1.6, 0.6))
        core.step(time, loop["sp"][:, 0], where="post", label="set point", **SET_POINT)
        core.plot(time, loop["pv"][:, 0], color=CORE, linewidth=2.6, label="core")
        core.plot(time[AHEAD:], told["adjusted_reference"][:-AHEAD], "--", color=ADJUSTED, linewidth=1.3,
                  label="adjusted reference")  # fmt: skip
        jacket.plot(time, loop["pv"][:, 1], color=JACKET, linewidth=2.2, label="jacket")
        jacket.plot(time[1:], told["wanted_jacket"][:-1], ":", color=WANTED, linewidth=1.3, label="wanted jacket")
        throttle.step(time, loop["mv"][:, 0], where="post", color="black", linewidth=0.9)
        for value, colour, word in ((1.0, HOT, "hot"), (2.0, COLD, "cold")):
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


def switches_picture(law: str, penalties: Sequence[float], scenarios: Mapping[str, str]) -> Draw:
    """Switches of the mode, and the largest offset, over the price of a switch; a line a test."""

    def draw(evidence: Evidence) -> Canvas | None:
        canvas = Canvas(figsize=(SIZE[0], 4.2), layout="constrained")
        left, right = canvas.subplots(1, 2)
        for (scenario, label), colour in zip(scenarios.items(), PALETTE, strict=False):
            settings = [{"switch_penalty": p} for p in penalties]
            counts = [evidence.figure(law, scenario, "switches", s) for s in settings]
            offsets = [evidence.figure(law, scenario, "max_asse", s) for s in settings]
            if None in counts or None in offsets:
                return None
            left.plot(penalties, counts, "o-", color=colour, label=label)
            right.plot(penalties, offsets, "o-", color=colour)
            for p, count in zip(penalties, counts, strict=True):
                left.annotate(f"{count:g}", (p, float(count or 0)), xytext=(5, 5), textcoords="offset points",
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
        for axes in (left, right):
            axes.set_xlabel("penalty of a switch [°C of the jacket]")
        legend_below(canvas, most=2)
        return canvas

    return draw


def offsets_picture(laws: Sequence[str], scenarios: Mapping[str, str]) -> Draw:
    """Mean and largest offset of each law where the model is off and the signals are noisy."""

    def draw(evidence: Evidence) -> Canvas | None:
        rows = {law: [evidence.figure(law, s, "masse") for s in scenarios] for law in laws}
        worst = {law: [evidence.figure(law, s, "max_asse") for s in scenarios] for law in laws}
        if any(v is None for table in (rows, worst) for row in table.values() for v in row):
            return None
        canvas = Canvas(figsize=(SIZE[0], 4.4), layout="constrained")
        axes = canvas.subplots()
        wide = 0.8 / len(laws)
        for i, law in enumerate(laws):
            at = np.arange(len(scenarios)) + (i - (len(laws) - 1) / 2) * wide
            mean, largest = (np.array(table[law], dtype=np.float64) for table in (rows, worst))
            colour = colour_of(law, evidence.laws, evidence.case.baseline)
            axes.bar(at, mean, 0.9 * wide, color=colour, label=law_name(law))
            axes.vlines(at, mean, largest, color=colour, linewidth=1.2)
            axes.plot(at, largest, "_", color=colour, markersize=9)
            for x, value in zip(at, largest, strict=True):
                axes.annotate(number(value, 2), (x, value), xytext=(0, 4), textcoords="offset points",
                              ha="center", fontsize="small", path_effects=HALO, zorder=5)  # fmt: skip
        axes.set_yscale("log")
        axes.set_axisbelow(True)
        axes.set_ylim(SMALLEST, 2.0 * ROOM * max(v for row in worst.values() for v in row if v is not None))
        axes.set_xticks(range(len(scenarios)), list(scenarios.values()))
        axes.set_ylabel("offset at the end of a level [°C]")
        axes.set_title("bar: mean over the levels; mark and number: largest", fontweight="normal", fontsize="medium")
        legend_below(canvas, most=len(laws))
        return canvas

    return draw
