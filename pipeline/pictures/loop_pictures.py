"""Closed loops drawn: set point, controlled variable and MVs of several controllers, or what their info says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.evaluation.case import Case, Curve, Figure
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import BASE, Array, Loop
from loopwright.pipeline.evaluation.poor_laws import worst_cycle
from loopwright.pipeline.pictures.drawing import (
    PICTURE_SIZE,
    SHADES,
    axis_label,
    colour_of,
    legend_below,
    ratio_unit,
    scale,
    time_axis,
)
from loopwright.pipeline.pictures.loop_panels import LoopPanels, first
from loopwright.pipeline.pictures.numbers import number, ratio
from loopwright.pipeline.pictures.words import curve_label, law_name, scenario_name
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

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
SHORTEST_PID_TIME, LONGEST_PID_TIME = 1e-3, 9e3  # periods; times below and above say that there is no such action
ORDERS_FOR_LOG = 2.0  # powers of ten that these must span to be drawn over them


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
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 1.0 + 1.7 * count), layout="constrained")
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
    values = np.where(values < SHORTEST_PID_TIME * period_s, 0.0, values)
    return np.where(values > LONGEST_PID_TIME * period_s, np.nan, values)


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
