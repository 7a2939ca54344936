"""Hybrid fuzzy models beside each other: what each mode reaches, coefficients beside the physics, and checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Array
from loopwright.pipeline.evaluation.verdicts import CheckOutcome
from loopwright.pipeline.pictures.drawing import PALETTE, PICTURE_SIZE, legend_below
from loopwright.pipeline.pictures.numbers import number

SET = "hybrid_fuzzy"
MODES = {"hot": "#d55e00", "cold": "#0072b2"}
ROWS = {"a1": "", "a2": "", "b": " [°C]", "r": " [°C]"}
ORDER = ("printed", "local", "global", "tied")
"""Identifications, from the one that leaves most out of reach."""
COLOURS = dict(zip(reversed(ORDER), PALETTE, strict=False))
GAP = "#444444"
WARM = 45.0  # core temperature [deg C] of the picture of what is reached, the middle of the recipe
LITTLE = 1.25  # times the error of the models without ties: what ties across the modes may cost
COLDEST = 20.0  # [deg C] the rule at the jacket's lower limit
WEAK = 0.5  # of the reactor's authority
NO_GAP = 1e-9  # [deg C]

Coefficients = Mapping[str, float]  # "b_hot_40" -> its median over the data seeds


def _parts(evidence: Evidence) -> dict[str, Mapping[str, Any]]:
    """Medians over the data seeds of each identification, in ORDER; raises NotMeasuredError where there is none."""
    parts = {how: part for how in ORDER if "parameters" in (part := evidence.part(SET, how))}
    if not parts:
        raise NotMeasuredError
    return parts


def _each(evidence: Evidence, figure: str, *ways: str) -> dict[str, float]:
    """A figure of some identifications; raises NotMeasuredError unless all have it."""
    parts = _parts(evidence)
    if any(figure not in parts.get(how, {}) for how in ways):
        raise NotMeasuredError
    return {how: float(parts[how][figure]) for how in ways}


def _over_centres(found: Coefficients, coefficient: str, mode: str) -> tuple[Array, Array]:
    """Centres (K,) and the coefficient's values there."""
    head = f"{coefficient}_{mode}_"
    at = {float(key.removeprefix(head)): value for key, value in found.items() if key.startswith(head)}
    centres = np.array(sorted(at))
    return centres, np.array([at[c] for c in centres])


def reach_picture(evidence: Evidence) -> Canvas:
    """The jacket's reach in one period over its temperature, in each mode, and the gap between the modes."""
    parts = _parts(evidence)
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 6.4), layout="constrained")
    grid = canvas.subplots(2, 2, sharex=True, sharey=True)
    panels = np.ravel(grid)
    for axes, (how, found) in zip(panels, parts.items(), strict=False):
        _reach(axes, found["parameters"], how)
    for axes in panels[len(parts) :]:
        axes.axis("off")
    for axes in grid[-1]:
        axes.set_xlabel(f"jacket temperature [°C], core at {WARM:g} °C")
    for axes in grid[:, 0]:
        axes.set_ylabel("change in a period [°C]")
    handles, labels = panels[0].get_legend_handles_labels()
    legend_below(canvas, handles, labels, most=3)
    return canvas


def _reach(axes: Axes, found: Coefficients, how: str) -> None:
    t_w = np.linspace(20.0, 70.0, 501)
    shut = {}
    for mode, colour in MODES.items():
        a1, a2, b, r = (np.interp(t_w, *_over_centres(found, name, mode)) for name in ROWS)
        shut[mode] = a1 * t_w + a2 * WARM + r - t_w
        axes.fill_between(t_w, shut[mode], shut[mode] + b, color=colour, alpha=0.25, linewidth=0, label=f"{mode} mode")
        axes.plot(t_w, shut[mode], color=colour, linewidth=1.2)
    between = shut["hot"] - shut["cold"]
    axes.fill_between(
        t_w, shut["cold"], shut["hot"], where=between > NO_GAP, color=GAP, linewidth=0, label="out of reach of both"
    )
    widest = max(0.0, float(between.max()))
    axes.set_title(f"{how}: up to {widest:.2f} °C out of reach" if widest > NO_GAP else f"{how}: nothing out of reach")
    # Where the modes meet; full flow goes far beyond.
    axes.set_ylim(-5.0, 5.0)
    axes.set_axisbelow(True)
    axes.margins(x=0)


def coefficients_picture(evidence: Evidence) -> Canvas:
    """a1, a2, b and r over the rules' centres, hot and cold, beside what the reactor itself does."""
    parts = _parts(evidence)
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 6.4), layout="constrained")
    physics: Coefficients = next(iter(parts.values()))["physics"]
    reactor: Any = {"color": "black", "linewidth": 2.4, "alpha": 0.35}
    colours = {how: colour for how, colour in COLOURS.items() if how in parts}
    grid = canvas.subplots(2, 2, sharex=True)
    for axes, (name, unit) in zip(np.ravel(grid), ROWS.items(), strict=True):
        for mode, line, mark in (("hot", "-", "."), ("cold", "--", "x")):
            axes.plot(*_over_centres(physics, name, mode), line, **reactor)
            for how, colour in colours.items():
                curve = _over_centres(parts[how]["parameters"], name, mode)
                axes.plot(*curve, line, color=colour, marker=mark, linewidth=1.1)
        axes.set_ylabel(f"${name[0]}_{name[1]}${unit}" if len(name) > 1 else f"${name}${unit}")
    for how, colour in colours.items():
        axes.plot([], [], color=colour, label=how)
    axes.plot([], [], label="the reactor itself", **reactor)
    axes.plot([], [], "-", color="black", linewidth=1.0, label="hot")
    axes.plot([], [], "--", color="black", linewidth=1.0, label="cold")
    for axes in grid[-1]:
        axes.set_xlabel("jacket temperature of the rule [°C]")
    legend_below(canvas, most=7)
    return canvas


def drift_when_shut(evidence: Evidence, how: str, at: float) -> tuple[float, float]:
    """Drift of a jacket as warm as its core, ``at`` degC, by an identification: throttle shut, in mode hot and cold.

    [degC a period]. Above 0 in the one and below it in the other, neither holds the temperature, nor
    does any throttle: an open one moves it further away. Raises NotMeasuredError without that identification.
    """
    found = _parts(evidence).get(how)
    if found is None:
        raise NotMeasuredError

    def moved(mode: str) -> float:
        a1, a2, r = (float(np.interp(at, *_over_centres(found["parameters"], row, mode))) for row in ("a1", "a2", "r"))
        return (a1 + a2 - 1.0) * at + r

    return moved("hot"), moved("cold")


def one_step_errors(evidence: Evidence) -> CheckOutcome:
    """Whether ties across the modes cost little accuracy, and less than parts that know nothing of each other."""
    found = _each(evidence, "rmse", "tied", "global", "local")
    shown = ", ".join(f"{how} {number(value)}" for how, value in found.items())
    return CheckOutcome(f"{shown} °C", found["tied"] <= LITTLE * found["global"] and found["tied"] < found["local"])


def gaps(evidence: Evidence) -> CheckOutcome:
    """Whether no jacket temperature lies between the modes' ranges of the tied model, and some of the others'."""
    found = _each(evidence, "gap", *ORDER)
    shown = ", ".join(f"{how} {value:.2f}" for how, value in found.items())
    others = [value for how, value in found.items() if how != "tied"]
    return CheckOutcome(f"up to {shown} °C a period", found["tied"] <= NO_GAP < min(others))


def weak_cold_valve(evidence: Evidence) -> CheckOutcome:
    """Whether the printed cold valve is much weaker than the reactor's at the jacket's lower limit."""
    printed, key = evidence.part(SET, "printed"), f"b_cold_{COLDEST:g}"
    sides = [printed.get(side, {}).get(key) for side in ("physics", "parameters")]
    if None in sides:
        raise NotMeasuredError
    reactor, ours = map(float, sides)
    shown = f"{ours:.2f} printed, {reactor:.2f} °C in the reactor: {reactor / ours:.2f} times weaker"
    return CheckOutcome(shown, abs(ours) <= WEAK * abs(reactor))
