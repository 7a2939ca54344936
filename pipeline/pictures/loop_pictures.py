"""Closed loops drawn: set point, controlled variable and MVs of several controllers, or what their info says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Patch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from loopwright.pipeline.evaluation.case import Case, Curve, Figure
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import BASE, Array, Loop
from loopwright.pipeline.evaluation.poor_laws import worst_cycle
from loopwright.pipeline.pictures.drawing import (
    REFERENCE,
    SET_POINT,
    SHADES,
    SIZE,
    axis_label,
    colour_of,
    fit_labels,
    layer,
    legend_below,
    ratio_unit,
    scale,
    signal_label,
    time_axis,
)
from loopwright.pipeline.pictures.numbers import number, ratio
from loopwright.pipeline.pictures.words import curve_label, law_name, scenario_name
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX
from loopwright.serving.manifest import Signal

SCALES = {"kc", "tau_i_s", "tau_d_s", "penalty"}  # info whose ratios matter, not its differences
LIKE_CV = (
    "adjusted_reference",
    "disturbance",
    "reached_jacket",
    "reference",
    "sp_max",
    "sp_min",
    "sp_requested",
    "wanted_jacket",
)
"""Info in the unit of the controlled variable."""
SHORTEST, LONGEST = 1e-3, 9e3  # periods; times below and above say that there is no such action
ORDERS_FOR_LOG = 2.0  # powers of ten that these must span to be drawn over them
STRIP = 0.7  # height of a discrete MV's panel, where a continuous one's is 2
STRIP_ROOM = 0.3  # above and below its values, as a share of their range
INCHES = 0.84  # that a height of 1 takes
CV_HEIGHT, SHARED_HEIGHT = 3.0, 2.2  # of the panel of the controlled variable, and of each of several
MV_HEIGHT, OWN_HEIGHT = 2.0, 1.2  # of the panel of a continuous MV, and of one that a ringing law has for itself
MV_THINNER = 0.7  # its line beside the controlled variable's
WINDOWS = 50  # parts of the time axis, each about 15 pixels wide, in which reversals are counted
MOST_REVERSALS = 4  # of an MV in such a part; more of them run into one another
SWING = 0.02  # of the MV's range: a smaller move is no reversal
RINGING = 0.05  # share of the samples at which an MV reverses too fast to draw: from here on it has its own panel
FAST = "shaded: swings too fast to draw, with their mean"


class LoopPanels:
    """Each controlled variable with its set point, each MV, and each measured disturbance that a test moves.

    A test with a late part has the error in it too. A discrete MV has a narrow strip with its allowed values as
    ticks. A law whose continuous MV rings (``rings``) has a panel of its own for it, so that it hides no other law's.
    ``loops`` are the curves to come by their label, the first in front; ``reference`` (n, 1) is the course that the
    controlled variable should take where that is not the set point; ``dv`` (n, n_dv) are the measured disturbances.
    """

    def __init__(
        self,
        case: Case,
        title: str,
        loops: Mapping[str, Loop],
        late_from: int = 0,
        reference: Array | None = None,
        dv: Array | None = None,
    ) -> None:
        self.ranks = {label: rank for rank, label in enumerate(loops)}
        self.late_from, self.reference = late_from, reference
        # A set point that is held jumps; a recipe's course is sampled from a curve.
        self.sp_style = "default" if case.recipe else "steps-post"
        cvs, self.signals = case.plant_class.sp_signals, case.plant_class.mv_signals
        self.places = self._places(loops)
        self.hidden = False
        ordered = sorted({place for row in self.places.values() for place in row})
        above = [CV_HEIGHT] if len(cvs) == 1 else [SHARED_HEIGHT] * len(cvs)
        below = [self._height(*place) for place in ordered]
        self.moved = _moved(case.plant_class.dv_signals, dv)
        heights = [*above, *([1.6] if late_from else []), *below, *[OWN_HEIGHT] * len(self.moved)]
        more = 1.2 * bool(late_from) + INCHES * (
            sum(above) - CV_HEIGHT + sum(below) - MV_HEIGHT + OWN_HEIGHT * len(self.moved)
        )
        self.canvas = Canvas(figsize=(SIZE[0], SIZE[1] + more), layout="constrained")
        panels = list(self.canvas.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}))
        self.cvs: list[Axes] = panels[: len(cvs)]
        first_mv = len(panels) - len(self.moved) - len(ordered)
        self.mvs: dict[tuple[int, str], Axes] = dict(zip(ordered, panels[first_mv:], strict=False))
        self.dvs: list[Axes] = panels[len(panels) - len(self.moved) :]
        self.error: Axes | None = panels[len(cvs)] if late_from else None
        self.bottom = panels[-1]
        self.cvs[0].set_title(title, wrap=True)
        for axes, cv in zip(self.cvs, cvs, strict=True):
            axes.set_ylabel(signal_label(cv))
        for (i, owner), axes in self.mvs.items():
            mv = self.signals[i]
            axes.set_ylabel(signal_label(mv))
            if owner:
                axes.set_title(owner, loc="right", fontsize="small", fontweight="normal", pad=2.0)
            if mv.values is not None:
                _allow_only(axes, mv)
        for axes, (signal, _) in zip(self.dvs, self.moved, strict=True):
            axes.set_ylabel(signal_label(signal))
        if len(self.mvs) + len(self.dvs) > 1 or len(cvs) > 1:
            self.canvas.align_ylabels(panels)
        if self.error is not None:
            self.error.set_ylabel(axis_label("error", cvs[0].unit))
            self.error.axhline(0.0, color="black", linewidth=0.9, linestyle="--", zorder=2)

    def _places(self, loops: Mapping[str, Loop]) -> dict[str, list[tuple[int, str]]]:
        """For each curve the panels of its MVs: (place of the MV, label of the curve that has it alone or "")."""
        return {
            label: [
                (i, label if len(loops) > 1 and rings(mv, signal) else "")
                for i, (mv, signal) in enumerate(zip(_columns(loop), self.signals, strict=False))
            ]
            for label, loop in loops.items()
        }

    def _height(self, i: int, owner: str) -> float:
        if self.signals[i].values is not None:
            return STRIP
        return OWN_HEIGHT if owner else MV_HEIGHT

    def add(self, loop: Loop, label: str, colour: str) -> None:
        """One of the controllers that were announced."""
        look = layer(self.ranks[label])
        time, _ = time_axis(loop["time_s"])
        pv = first(loop["pv"])
        for i, axes in enumerate(self.cvs):
            axes.plot(time, _column(loop["pv"], i), label=label, color=colour, **look)
        for place, mv in zip(self.places[label], _columns(loop), strict=True):
            wide = layer(0 if place[1] else self.ranks[label])["linewidth"]
            style = {**look, "color": colour, "linewidth": MV_THINNER * wide}
            self._move(self.mvs[place], self.signals[place[0]], time, mv, style)
        if self.error is not None:
            late = slice(self.late_from, None)
            error = first(loop["sp"])[late] - pv[late]
            self.error.plot(time[late], error, color=colour, **look)

    def _move(self, axes: Axes, signal: Signal, time: Array, mv: Array, style: dict[str, Any]) -> None:
        # Each move acts over the period after its sample: a staircase that begins there.
        if not rings(mv, signal):
            axes.step(time, mv, where="post", **style)
            return
        self.hidden, fast = True, too_fast(mv, signal)
        around = sliding_window_view(np.pad(mv, _window(mv) // 2, mode="reflect"), _window(mv))[: len(mv)]
        low, high = around.min(axis=1), around.max(axis=1)
        axes.fill_between(time, low, high, where=fast, step="post", color=style["color"], alpha=0.25, linewidth=0)
        axes.step(time, np.where(fast, around.mean(axis=1), mv), where="post", **style)

    def finish(self, loop: Loop) -> Canvas:
        """The set point, the time axis and the legend."""
        time, words = time_axis(loop["time_s"])
        style: dict[str, Any] = {"drawstyle": self.sp_style, "zorder": 2, **SET_POINT}
        for i, axes in enumerate(self.cvs):
            axes.plot(time, _column(loop["sp"], i), label="set point", **style)
            axes.margins(x=0.01)
        if self.reference is not None and len(self.reference) == len(time):
            self.cvs[0].plot(time, first(self.reference), label="reference", zorder=5, **REFERENCE)
        for axes, (_, values) in zip(self.dvs, self.moved, strict=True):
            axes.step(time[: len(values)], values[: len(time)], where="post", **SET_POINT)
        self.bottom.set_xlabel(words)
        handles, labels = self.cvs[0].get_legend_handles_labels()
        if self.hidden:
            handles, labels = [*handles, Patch(color="black", alpha=0.25, linewidth=0)], [*labels, FAST]
        legend_below(self.canvas, handles, labels)
        fit_labels(self.canvas)
        return self.canvas


def _moved(signals: Sequence[Signal], dv: Array | None) -> list[tuple[Signal, Array]]:
    """The measured disturbances that a test moves, each with its course (n,)."""
    return [] if dv is None else [(s, v) for s, v in zip(signals, dv.T, strict=True) if np.ptp(v) > 0]


def _column(values: Array, i: int) -> Array:
    """One signal of several, (n,)."""
    return values if values.ndim == 1 else values[:, i]


def _columns(loop: Loop) -> list[Array]:
    """The MVs of a loop, (n,) each."""
    return list(loop["mv"].reshape(len(loop["time_s"]), -1).T)


def _window(mv: Array) -> int:
    """Samples of one of the parts in which reversals are counted."""
    return max(2, len(mv) // WINDOWS)


def too_fast(mv: Array, signal: Signal) -> NDArray[np.bool_]:
    """Samples (n,) around which a continuous MV (n,) reverses more often than a picture can show."""
    if signal.values is not None or len(mv) < WINDOWS:
        return np.zeros(len(mv), dtype=bool)
    width = _window(mv)
    moved = np.diff(mv)
    at = np.flatnonzero(np.abs(moved) > SWING * (signal.high - signal.low))
    # A pulse may rest between its two moves.
    turned = at[1:][moved[at[1:]] * moved[at[:-1]] < 0]
    reversals = np.zeros(len(mv))
    reversals[turned + 1] = 1.0
    counted = np.convolve(np.pad(reversals, width // 2, mode="reflect"), np.ones(width), mode="valid")[: len(mv)]
    return np.asarray(counted > MOST_REVERSALS)


def rings(mv: Array, signal: Signal) -> bool:
    """Whether an MV (n,) reverses too fast to draw in so many samples that it would hide others in its panel."""
    return float(np.mean(too_fast(mv, signal))) > RINGING


def _allow_only(axes: Axes, signal: Signal) -> None:
    """The axis of a discrete signal: a tick at each allowed value, and room above and below for the line."""
    values = list(signal.values or ())
    room = STRIP_ROOM * max(values[-1] - values[0], 1.0)
    axes.set_yticks(values, [f"{v:g}" for v in values])
    axes.set_ylim(values[0] - room, values[-1] + room)


def first(values: Array) -> Array:
    """The first controlled variable or MV, shape (n,)."""
    return _column(values, 0)


def colours(evidence: Evidence, curves: Sequence[Curve]) -> list[str]:
    """Colour of each curve: the law's, or shades where several settings of one law are shown."""
    laws = [c.law for c in curves]
    if len(set(laws)) < len(laws):
        return [SHADES[i % len(SHADES)] for i in range(len(laws))]
    return [colour_of(law, evidence.laws, evidence.case.baseline) for law in laws]


def loops_picture(evidence: Evidence, figure: Figure) -> Canvas:
    """A figure of the paper: its curves, and our best controller with them."""
    scenario, best = figure.scenario or "", evidence.best
    drawn = {
        curve_label(evidence, curve): (curve, colour)
        for curve, colour in zip(figure.curves, colours(evidence, figure.curves), strict=True)
    }
    shipped = (c.law for c in figure.curves if c.law == best and evidence.laws[c.law].form_of(c.setting) == BASE)
    if best is not None and best not in shipped:
        drawn[f"{law_name(best)} (ours, best)"] = Curve(best), "black"
    # The paper's curves lie in front: the figure is about them.
    found = {label: (loop, colour) for label, (c, colour) in drawn.items() if (loop := evidence.loop(c, scenario))}
    if not found:
        raise NotMeasuredError
    return _picture(evidence, scenario, f"Figure {figure.number}. {figure.title}", found)


def _picture(evidence: Evidence, scenario: str, title: str, drawn: Mapping[str, tuple[Loop, str]]) -> Canvas:
    """Loops of a test by their labels, each with its colour; the reference is that of the test's first sequence."""
    tests = evidence.tests.get(scenario.removesuffix(NOISE_SUFFIX), ())
    loops = {label: loop for label, (loop, _) in drawn.items()}
    reference = tests[0].reference if tests else None
    dv = tests[0].dv if tests else None
    panels = LoopPanels(evidence.case, title, loops, evidence.late_from(scenario), reference, dv)
    for label, (loop, colour) in drawn.items():
        panels.add(loop, label, colour)
    return panels.finish(next(iter(loops.values())))


def info_picture(evidence: Evidence, figure: Figure) -> Canvas:
    """The info of the controllers of a figure over time, a panel for each entry."""
    found: dict[str, tuple[str, Loop, dict[str, Array]]] = {}
    period_s = evidence.case.plant.period_s
    for curve, colour in zip(figure.curves, colours(evidence, figure.curves), strict=True):
        with suppress(NotMeasuredError):
            loop, info = evidence.info(curve, figure.scenario or "", *figure.info)
            columns = {name: finite(values, name, period_s) for name, values in info.items()}
            found[curve_label(evidence, curve)] = colour, loop, columns
    if not found:
        raise NotMeasuredError
    count = len(figure.info)
    canvas = Canvas(figsize=(SIZE[0], 1.0 + 1.7 * count), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(count, 1, sharex=True)))
    for label, (colour, loop, columns) in found.items():
        time, words = time_axis(loop["time_s"])
        for axes, name in zip(panels, figure.info, strict=True):
            axes.step(time, columns[name], where="post", color=colour, linewidth=1.3, label=label)
        panels[-1].set_xlabel(words)
    first_label, (_, first_loop, _) = next(iter(found.items()))
    gaps = any(np.isnan(v).any() for *_, columns in found.values() for v in columns.values())
    for axes, name in zip(panels, figure.info, strict=True):
        axes.set_ylabel(info_label(evidence.case, name))
        shown = np.concatenate([columns[name] for *_, columns in found.values()])
        if name in SCALES and over_orders(shown):
            scale(axes.yaxis, shown)
            gaps = gaps or bool((shown <= 0).any())
        for at in moves(first_loop):
            axes.axvline(at, color="#b0b0b0", linewidth=0.8, linestyle=":", zorder=1)
        axes.margins(x=0.01)
    canvas.align_ylabels(panels)
    title = panels[0].set_title(f"Figure {figure.number}. {figure.title}")
    if len(found) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        legend_below(canvas, handles, labels)
    else:
        words = first_label + ("; gaps: no such action" if gaps else "")
        beside = panels[0].set_title(words, loc="right", fontweight="normal", fontsize="medium")
        canvas.draw_without_rendering()
        if title.get_window_extent().x1 > beside.get_window_extent().x0:
            title.set_text(f"{title.get_text()}\n{words}")
            beside.set_text("")
    return canvas


def moves(loop: Loop) -> Array:
    """Times at which the first set point that is held moves; none of one that follows a course."""
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
    """An entry of info as an axis's label, with its unit where the name tells what it is.

    A request on a signal, or an estimate of it, has the signal's unit.
    """
    cv, mv = case.plant_class.sp_signals[0], case.plant_class.mv_signals[0]
    known = {
        "kc": ("$k_c$", ratio_unit(mv.unit, cv.unit)),
        "tau_i_s": (r"$\tau_i$", "s"),
        "tau_d_s": (r"$\tau_d$", "s"),
        "penalty": (r"penalty $\mu$", ""),
        "offset": ("offset $d$", cv.unit),
        "linearization_error": ("linearization error", cv.unit),
        "mv_requested": ("requested MV", mv.unit),
        **{name: (name.replace("_", " "), cv.unit) for name in LIKE_CV},
    }
    return axis_label(*known.get(name, (name.replace("_", " "), "")))


def overview_picture(evidence: Evidence, law: str, test: str | None = None) -> Canvas:
    """A law beside the baseline on the first sequence of a test, with the figures over all.

    Without ``test`` it is the one that weighs most.
    """
    scenario, case, baseline = test or evidence.main_test, evidence.case, evidence.case.baseline
    own = evidence.loop(Curve(law), scenario)
    if own is None:
        raise NotMeasuredError
    error, times = evidence.figure(law, scenario), evidence.ratio(law, scenario)
    beside = "" if times is None else f", {ratio(times)} × perfect-model NMPC"
    late, late_s = evidence.figure(law, scenario, case.criterion.late), evidence.late_s(scenario)
    rest = "" if late is None or not late_s else f"; {number(late)} {case.unit}".rstrip() + f" from {late_s:g} s on"
    where = "" if test is None else f", {scenario_name(test, case.recipe, case.test_words)}"
    title = f"{evidence.laws[law].title}{where}\n{_error(error, case)}{beside}{rest}"
    drawn = {law_name(law): (own, colour_of(law, evidence.laws, baseline))}
    other = evidence.loop(Curve(baseline), scenario) if law != baseline else None
    if other is not None:
        error = evidence.figure(baseline, scenario)
        label = f"{law_name(baseline)}, {_error(error, case)}"
        drawn[label] = other, colour_of(baseline, evidence.laws, baseline)
    return _picture(evidence, scenario, title, drawn)


def cycle_picture(evidence: Evidence, law: str) -> tuple[Canvas, str]:
    """The loop with the worst limit cycle of a law; and what swings in it, how far and how fast, in words."""
    measured, case = evidence.laws[law], evidence.case
    test, loop = worst_cycle(evidence, law), measured.cycling()
    if test is None or not loop:
        raise NotMeasuredError
    where, words = scenario_name(test, case.recipe, case.test_words), measured.metrics.cycles[test].words
    name = law_name(law)
    panels = LoopPanels(case, f"{measured.title}, {where}\n{words}", {name: loop})
    panels.add(loop, name, colour_of(law, evidence.laws, case.baseline))
    return panels.finish(loop), f"{measured.title} on {where}: {words}"


def disturbance_picture(evidence: Evidence, scenario: str) -> Canvas:
    """The first sequence of a test that moves a measured disturbance, under the best law and the baseline.

    All laws are shown of an own plant: a person chooses among them, and some take the disturbance and some do not.
    """
    laws = dict.fromkeys((evidence.best or "", *(evidence.laws if evidence.case.on_models else ())))
    laws |= {evidence.case.baseline: None}
    drawn = {}
    for law in laws:
        loop = evidence.loop(Curve(law), scenario)
        if loop is not None:
            label = f"{law_name(law)}, {_error(evidence.figure(law, scenario), evidence.case)}"
            drawn[label] = loop, colour_of(law, evidence.laws, evidence.case.baseline)
    if not drawn:
        raise NotMeasuredError
    return _picture(evidence, scenario, evidence.scenarios[scenario], drawn)


def _error(value: float | None, case: Case) -> str:
    """A figure in the case's metric: MAE 0.0123 mol/l."""
    metric = case.criterion
    if value is None:
        return f"{metric.short} –"
    words = f"{value:.4f}" if not metric.squared and 0.01 <= value < 1.0 else number(value, 4)
    return f"{metric.short} {words} {case.unit}".rstrip()
