"""Closed loops drawn: set point, controlled variable and MVs of several controllers, or what their info says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from pipeline.evaluation.case import Case, Curve, Figure
from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.law_evidence import Array, Loop
from pipeline.evaluation.metric import Metric
from pipeline.pictures.drawing import SHADES, SIZE, axis_label, colour_of, ratio_unit, symbol, time_axis
from pipeline.pictures.words import law_label, number, ratio
from pipeline.simulation.scenario import NOISE_SUFFIX
from serving.manifest import Signal

SCALES = {"kc", "tau_i_s", "tau_d_s", "penalty"}  # info whose ratios matter, not its differences
SHORTEST, LONGEST = 1e-3, 9e3  # periods; times below and above say that there is no such action
ORDERS_FOR_LOG = 2.0  # powers of ten that these must span to be drawn over them
STRIP = 0.7  # height of a discrete MV's panel, where a continuous one's is 2
STRIP_ROOM = 0.3  # above and below its values, as a share of their range
INCHES = 0.84  # that a height of 1 takes


class LoopPanels:
    """The controlled variable with its set point, each MV, and the error of the late part where a test has one.

    A discrete MV has a narrow strip with its allowed values as ticks. ``reference`` (n, 1) is the
    course that the controlled variable should take where that is not the set point.
    """

    def __init__(self, case: Case, title: str, late_from: int = 0, reference: Array | None = None) -> None:
        self.late_from, self.reference = late_from, reference
        # A set point that is held jumps; a recipe's course is sampled from a curve.
        self.sp_style = "default" if case.recipe else "steps-post"
        cv, mvs = case.plant_class.sp_signals[0], case.plant_class.mv_signals
        strips = [2.0 if mv.values is None else STRIP for mv in mvs]
        heights = [3.0, *([1.6] if late_from else []), *strips]
        more = 1.2 * bool(late_from) + INCHES * (sum(strips) - 2.0)
        self.canvas = Canvas(figsize=(SIZE[0], SIZE[1] + more), layout="constrained")
        panels = list(self.canvas.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}))
        self.cv: Axes = panels[0]
        self.mvs: list[Axes] = panels[-len(mvs) :]
        self.error: Axes | None = panels[1] if late_from else None
        self.bottom = panels[-1]
        self.cv.set_title(title)
        self.cv.set_ylabel(axis_label(symbol(cv.name), cv.unit))
        for axes, mv in zip(self.mvs, mvs, strict=True):
            axes.set_ylabel(axis_label(symbol(mv.name), mv.unit))
            if mv.values is not None:
                _allow_only(axes, mv)
        if len(mvs) > 1:
            self.canvas.align_ylabels(panels)
        if self.error is not None:
            self.error.set_ylabel(axis_label("error", cv.unit))
            self.error.axhline(0.0, color="black", linewidth=0.9, linestyle="--", zorder=2)

    def add(self, loop: Loop, label: str, colour: str, strong: bool = False) -> None:
        """One controller; the strong one lies in front."""
        # Each move acts over the period after its sample: a staircase that begins there.
        order, wide = (4.0, 1.9) if strong else (3.0, 1.2)
        time, _ = time_axis(loop["time_s"])
        pv = first(loop["pv"])
        self.cv.plot(time, pv, label=label, color=colour, linewidth=wide, zorder=order)
        # Laws that ring fill the panel: behind the strong curve they are only hinted at.
        faint = 1.0 if strong else 0.5
        for axes, mv in zip(self.mvs, loop["mv"].reshape(len(time), -1).T, strict=False):
            axes.step(time, mv, where="post", color=colour, linewidth=0.6 * wide, zorder=order, alpha=faint)
        if self.error is not None:
            late = slice(self.late_from, None)
            error = first(loop["sp"])[late] - pv[late]
            self.error.plot(time[late], error, color=colour, linewidth=wide, zorder=order)

    def finish(self, loop: Loop) -> Canvas:
        """The set point, the time axis and the legend."""
        time, words = time_axis(loop["time_s"])
        style: Any = {"drawstyle": self.sp_style, "linewidth": 0.9, "zorder": 2}
        self.cv.plot(time, first(loop["sp"]), "--", color="black", label="set point", **style)
        if self.reference is not None and len(self.reference) == len(time):
            self.cv.plot(time, first(self.reference), ":", color="black", linewidth=1.3, label="reference", zorder=5)
        self.cv.margins(x=0.01)
        self.bottom.set_xlabel(words)
        labels = self.cv.get_legend_handles_labels()[1]
        self.canvas.legend(loc="outside lower center", ncols=min(4, len(labels)))
        return self.canvas


def _allow_only(axes: Axes, signal: Signal) -> None:
    """The axis of a discrete signal: a tick at each allowed value, and room above and below for the line."""
    values = list(signal.values or ())
    room = STRIP_ROOM * max(values[-1] - values[0], 1.0)
    axes.set_yticks(values, [f"{v:g}" for v in values])
    axes.set_ylim(values[0] - room, values[-1] + room)


def reference_of(evidence: Evidence, scenario: str) -> Array | None:
    """What the controlled variable should do in a test (its first sequence) where it is not the set point, (n, 1)."""
    tests = evidence.tests.get(scenario.removesuffix(NOISE_SUFFIX), ())
    return tests[0].reference if tests else None


def first(values: Array) -> Array:
    """The controlled variable or the first MV, shape (n,)."""
    return values if values.ndim == 1 else values[:, 0]


def curves_and_loops(evidence: Evidence, figure: Figure, curves: Sequence[Curve]) -> list[tuple[Curve, Loop]]:
    """The curves that have a trajectory."""
    found = [(c, evidence.loop(c, figure.scenario or "")) for c in curves]
    return [(c, loop) for c, loop in found if loop is not None]


def colours(evidence: Evidence, figure: Figure) -> dict[int, str]:
    """Colour of each curve by its place: the law's, or shades where several settings of one law are shown."""
    laws = [c.law for c in figure.curves]
    if len(set(laws)) < len(laws):
        return {i: SHADES[i % len(SHADES)] for i in range(len(laws))}
    return {i: colour_of(law, evidence.laws) for i, law in enumerate(laws)}


def loops_picture(evidence: Evidence, figure: Figure) -> Canvas | None:
    """A figure of the paper: its curves, and our best controller with them."""
    curves: Sequence[Curve] = figure.curves
    best = None if evidence.best is None else Curve(evidence.best)
    if best is not None and not any(_is_shipped(evidence, c) for c in curves if c.law == best.law):
        curves = (*curves, best)
    found = curves_and_loops(evidence, figure, curves)
    if not found:
        return None
    late, reference = evidence.late_from(figure.scenario or ""), reference_of(evidence, figure.scenario or "")
    panels = LoopPanels(evidence.case, f"Figure {figure.number}. {figure.title}", late, reference)
    own = colours(evidence, figure)
    for curve, loop in found:
        ours, alone = curve is best, len(found) == 1
        label = law_label(curve.law, curve.setting) + (" (ours, best)" if ours else "")
        panels.add(loop, label, "black" if ours else own[curves.index(curve)], ours or alone)
    return panels.finish(found[0][1])


def _is_shipped(evidence: Evidence, curve: Curve) -> bool:
    return evidence.laws[curve.law].variant_of(curve.setting) == ""


def info_picture(evidence: Evidence, figure: Figure) -> Canvas | None:
    """What the controllers of a figure say of themselves over time, a panel for each entry of info."""
    found = []
    for curve, loop in curves_and_loops(evidence, figure, figure.curves):
        names = evidence.laws[curve.law].info(curve.setting)
        if "info" in loop and set(figure.info) <= set(names):
            columns = {name: loop["info"][:, names.index(name)] for name in figure.info}
            period_s = evidence.case.plant.period_s
            found.append((curve, loop, {name: finite(v, name, period_s) for name, v in columns.items()}))
    if not found:
        return None
    count = len(figure.info)
    canvas = Canvas(figsize=(SIZE[0], 1.0 + 1.7 * count), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(count, 1, sharex=True)))
    own = colours(evidence, figure)
    for curve, loop, values in found:
        time, words = time_axis(loop["time_s"])
        colour = own[figure.curves.index(curve)]
        for axes, name in zip(panels, figure.info, strict=True):
            axes.step(time, values[name], where="post", color=colour, linewidth=1.3, label=_label(curve))
        panels[-1].set_xlabel(words)
    gaps = any(np.isnan(v).any() for _, _, values in found for v in values.values())
    for axes, name in zip(panels, figure.info, strict=True):
        axes.set_ylabel(info_label(evidence.case, name))
        if name in SCALES and over_orders(np.concatenate([values[name] for _, _, values in found])):
            axes.set_yscale("log", nonpositive="mask")
            gaps = True
        for at in moves(found[0][1]):
            axes.axvline(at, color="#b0b0b0", linewidth=0.8, linestyle=":", zorder=1)
        axes.margins(x=0.01)
    canvas.align_ylabels(panels)
    title = panels[0].set_title(f"Figure {figure.number}. {figure.title}")
    if len(found) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        canvas.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
    else:
        words = _label(found[0][0]) + ("; gaps: no such action" if gaps else "")
        beside = panels[0].set_title(words, loc="right", fontweight="normal", fontsize="medium")
        canvas.draw_without_rendering()
        if title.get_window_extent().x1 > beside.get_window_extent().x0:
            title.set_text(f"{title.get_text()}\n{words}")
            beside.set_text("")
    return canvas


def _label(curve: Curve) -> str:
    return law_label(curve.law, curve.setting)


def moves(loop: Loop) -> Array:
    """Times at which a set point that is held moves; none of one that follows a course."""
    sp, (time, _) = first(loop["sp"]), time_axis(loop["time_s"])
    at = np.flatnonzero(np.diff(sp)) + 1
    return time[at] if len(at) < len(sp) / 4 else time[:0]


def finite(values: Array, name: str, period_s: float) -> Array:
    """An info (n,) as it is drawn: a time of thousands of periods stands for no action, a tiny one for 0."""
    if not name.endswith("_s"):
        return values
    values = np.where(values < SHORTEST * period_s, 0.0, values)
    return np.where(values > LONGEST * period_s, np.nan, values)


def over_orders(values: Array) -> bool:
    """Whether values above 0 span so many powers of ten that a linear axis would show only the largest."""
    positive = values[values > 0]
    return 2 * len(positive) > len(values) and float(np.ptp(np.log10(positive))) > ORDERS_FOR_LOG


def info_label(case: Case, name: str) -> str:
    """An entry of info as an axis's label, with its unit where the name tells what it is."""
    cv, mv = case.plant_class.sp_signals[0], case.plant_class.mv_signals[0]
    known = {
        "kc": ("$k_c$", ratio_unit(mv.unit, cv.unit)),
        "tau_i_s": (r"$\tau_i$", "s"),
        "tau_d_s": (r"$\tau_d$", "s"),
        "penalty": (r"penalty $\mu$", ""),
        "offset": ("offset $d$", cv.unit),
        "linearization_error": ("linearization error", cv.unit),
    }
    return axis_label(*known.get(name, (name.replace("_", " "), "")))


def overview_picture(evidence: Evidence, law: str) -> Canvas | None:
    """A law beside the baseline on the first sequence of the test that weighs most, with the figures over all."""
    scenario, metric = evidence.main_test, evidence.case.criterion
    own = evidence.loop(Curve(law), scenario)
    if own is None:
        return None
    error, times = evidence.figure(law, scenario), evidence.ratio(law, scenario)
    beside = "" if times is None else f", {ratio(times)} × perfect-model NMPC"
    late, late_s = evidence.figure(law, scenario, "sse_late"), evidence.late_s(scenario)
    rest = "" if late is None or not late_s else f"; {number(late)} from {late_s:g} s on"
    title = f"{evidence.laws[law].title}\n{metric.short} {_error(error, metric)}{beside}{rest}"
    panels = LoopPanels(evidence.case, title, evidence.late_from(scenario), reference_of(evidence, scenario))
    other = evidence.case.baseline
    baseline = evidence.loop(Curve(other), scenario) if law != other else None
    if baseline is not None:
        error = evidence.figure(other, scenario)
        label = f"{law_label(other, {})}, {metric.short} {_error(error, metric)}"
        panels.add(baseline, label, colour_of(other, evidence.laws))
    panels.add(own, law, colour_of(law, evidence.laws), strong=True)
    return panels.finish(own)


def _error(value: float | None, metric: Metric) -> str:
    if value is None:
        return "–"
    return f"{value:.4f}" if not metric.squared and 0.01 <= value < 1.0 else number(value, 4)
