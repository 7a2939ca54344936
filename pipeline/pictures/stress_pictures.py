"""Pictures of a stress test: one loop, how errors are spread, and along which drawn quantity they grow."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from loopwright.pipeline.evaluation.stress.draws import STUCK, Draw
from loopwright.pipeline.evaluation.stress.summary import ErrorGrowth, Summary
from loopwright.pipeline.pictures.drawing import STYLE, scale, signal_label, symbol, time_axis
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.simulation.simulate import Trajectory

PANELS, COLUMNS, AXIS_TICKS = 6, 3, 4  # of a picture, in a row of it, and of an axis
BLUE, RED, GREY, GOLD = "#0072b2", "#d55e00", "#7f7f7f", "#e69f00"


def loop_canvas(plant: Simulator, draw: Draw, loop: Trajectory, title: str) -> Canvas:
    """CVs with set points, below them the positions of the actuators; a stuck one is shaded."""
    time, words = time_axis(loop.time_s)
    cvs, mvs = plant.sp_signals, plant.mv_signals
    with matplotlib.rc_context(STYLE):
        canvas = Canvas(figsize=(8.4, 1.2 + 1.7 * (len(cvs) + len(mvs))), layout="constrained")
        panels = canvas.subplots(len(cvs) + len(mvs), 1, sharex=True, squeeze=False)[:, 0]
        for i, (axes, signal) in enumerate(zip(panels, cvs, strict=False)):
            axes.plot(time, loop.measured[:, i], color=GREY, linewidth=0.6, label="measured")
            axes.plot(time, loop.pv[:, i], color=BLUE, linewidth=1.3, label="process variable")
            axes.step(
                time, loop.sp[:, i], where="post", color="black", linestyle="--", linewidth=0.9, label="set point"
            )
            axes.set_ylabel(signal_label(signal))
        for j, (axes, signal) in enumerate(zip(panels[len(cvs) :], mvs, strict=True)):
            axes.step(time, loop.mv[:, j], where="post", color=RED, linewidth=1.1, label="actuator's position")
            axes.set_ylabel(signal_label(signal))
            fault = draw.fault
            if fault is not None and fault.kind == STUCK and fault.mv == j:
                last = min(fault.end, len(time) - 1)
                axes.axvspan(time[fault.start], time[last], color=GOLD, alpha=0.25, label="stuck")
        panels[0].set_title(title, wrap=True)
        panels[-1].set_xlabel(words)
        for axes in panels:
            axes.margins(x=0.01)
        found = {label: h for axes in panels for h, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        canvas.legend(found.values(), found.keys(), loc="outside lower center", ncols=len(found))
    return canvas


def spread_canvas(summary: Summary, label: str) -> Canvas:
    """Share of the loops whose error is at most so large, a curve a test."""
    errors = np.array([o.figures[summary.case.metric] for o in summary.outcomes])
    with matplotlib.rc_context(STYLE):
        canvas = Canvas(figsize=(8.4, 4.2), layout="constrained")
        axes = canvas.subplots()
        for test, places in summary.tests.items():
            values = np.sort(errors[places])
            axes.step(
                values, np.arange(1, len(values) + 1) / len(values), where="post", label=f"{test} ({len(values)})"
            )
        finite = errors[np.isfinite(errors)]
        scale(axes.xaxis, finite if finite.size else np.ones(1))
        axes.set_ylim(0, 1.02)
        axes.set_xlabel(label)
        axes.set_ylabel("share of the loops")
        axes.set_title("Errors of the loops, by test")
        axes.legend()
    return canvas


def growth_canvas(growths: list[ErrorGrowth]) -> Canvas | None:
    """The relative error along the drawn quantities that move it most; None where nothing was drawn."""
    shown = growths[:PANELS]
    if not shown:
        return None
    rows = -(-len(shown) // COLUMNS)
    with matplotlib.rc_context(STYLE):
        canvas = Canvas(figsize=(10.2, 0.6 + 2.6 * rows), layout="constrained")
        panels = canvas.subplots(rows, min(COLUMNS, len(shown)), sharey=True, squeeze=False)
        for axes, growth in zip(panels.ravel(), shown, strict=False):
            numbers = not isinstance(growth.at[0], str)
            at: Array = (
                np.array(growth.at, dtype=np.float64) if numbers else np.arange(len(growth.at), dtype=np.float64)
            )
            axes.plot(at, growth.high, "^--", color=RED, label="90 % of the loops are below")
            axes.plot(at, growth.median, "o-", color=BLUE, label="median")
            if not numbers:
                axes.set_xticks(at, [str(word) for word in growth.at], rotation=20)
            elif set(growth.at) == {0.0, 1.0}:
                axes.set_xticks(at, ["no", "yes"])
            else:
                axes.xaxis.set_major_locator(MaxNLocator(AXIS_TICKS))
            axes.set_title(symbol(growth.name) if " " not in growth.name else growth.name)
            axes.margins(0.1)
        every = np.concatenate([np.array([*g.median, *g.high]) for g in shown])
        scale(panels[0, 0].yaxis, every)
        for axes in panels.ravel()[len(shown) :]:
            axes.set_visible(False)
        for row in panels:
            row[0].set_ylabel("relative error")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        canvas.legend(handles, labels, loc="outside lower center", ncols=2)
    return canvas
