"""Hybrid fuzzy models beside each other: what each mode reaches, coefficients beside the physics, and checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.law_evidence import Array
from pipeline.evaluation.verdicts import Check, Verdict
from pipeline.pictures.drawing import PALETTE, SIZE, legend_below
from pipeline.pictures.words import number

MODES = {"hot": "#d55e00", "cold": "#0072b2"}
ROWS = {"a1": "", "a2": "", "b": " [°C]", "r": " [°C]"}
ORDER = ("printed", "local", "global", "tied")
"""Identifications, from the one that leaves most out of reach."""
GAP = "#444444"
WARM = 45.0  # core temperature [deg C] of the picture of what is reached, the middle of the recipe
WITHIN = 0.2  # relative: what another draw of the excitation may change
NO_GAP = 1e-9  # [deg C]

Coefficients = Mapping[str, float]  # "b_hot_40" -> its median over the data seeds


def _parts(evidence: Evidence, model_set: str) -> dict[str, Mapping[str, Any]]:
    """Medians over the data seeds of each identification of the set, in ORDER."""
    parts = evidence.models.get(model_set, {}).get("parts") or {}
    return {how: parts[how]["median"] for how in ORDER if "parameters" in (parts.get(how, {}).get("median") or {})}


def _over_centres(found: Coefficients, coefficient: str, mode: str) -> tuple[Array, Array]:
    """Centres (K,) and the coefficient's values there."""
    head = f"{coefficient}_{mode}_"
    at = {float(key.removeprefix(head)): value for key, value in found.items() if key.startswith(head)}
    centres = np.array(sorted(at))
    return centres, np.array([at[c] for c in centres])


def reach_picture(model_set: str) -> Callable[[Evidence], Canvas | None]:
    """What the jacket can do in one period over its temperature, in each mode, and what lies between the modes."""

    def draw(evidence: Evidence) -> Canvas | None:
        parts = _parts(evidence, model_set)
        if not parts:
            return None
        canvas = Canvas(figsize=(SIZE[0], 6.4), layout="constrained")
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

    return draw


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


def coefficients_picture(model_set: str) -> Callable[[Evidence], Canvas | None]:
    """a1, a2, b and r over the rules' centres, hot and cold, beside what the reactor itself does."""

    def draw(evidence: Evidence) -> Canvas | None:
        parts = _parts(evidence, model_set)
        if not parts:
            return None
        canvas = Canvas(figsize=(SIZE[0], 6.4), layout="constrained")
        physics: Coefficients = next(iter(parts.values()))["physics"]
        grid = canvas.subplots(2, 2, sharex=True)
        for axes, (name, unit) in zip(np.ravel(grid), ROWS.items(), strict=True):
            for mode, line in (("hot", "-"), ("cold", "--")):
                axes.plot(*_over_centres(physics, name, mode), line, color="black", linewidth=2.4, alpha=0.35)
                for how, colour in zip(reversed(ORDER), PALETTE, strict=False):
                    if how in parts:
                        curve = _over_centres(parts[how]["parameters"], name, mode)
                        axes.plot(*curve, line, color=colour, marker="." if mode == "hot" else "x", linewidth=1.1)
            axes.set_ylabel(f"${name[0]}_{name[1]}${unit}" if len(name) > 1 else f"${name}${unit}")
        for how, colour in zip(reversed(ORDER), PALETTE, strict=False):
            if how in parts:
                axes.plot([], [], color=colour, label=how)
        axes.plot([], [], color="black", linewidth=2.4, alpha=0.35, label="the reactor itself")
        axes.plot([], [], "-", color="black", linewidth=1.0, label="hot")
        axes.plot([], [], "--", color="black", linewidth=1.0, label="cold")
        for axes in grid[-1]:
            axes.set_xlabel("jacket temperature of the rule [°C]")
        legend_below(canvas, most=7)
        return canvas

    return draw


def drift_when_shut(evidence: Evidence, model_set: str, how: str, at: float) -> tuple[float, float] | None:
    """What an identification has a shut throttle do to a jacket as warm as its core, ``at`` degC, in mode hot and cold.

    [degC a period]. Above 0 in the one and below it in the other, neither holds the temperature, nor
    does any throttle: an open one moves it further away.
    """
    found = _parts(evidence, model_set).get(how)
    if found is None:
        return None
    hot, cold = (
        {name: float(np.interp(at, *_over_centres(found["parameters"], name, mode))) for name in ("a1", "a2", "r")}
        for mode in MODES
    )
    moved = [(c["a1"] + c["a2"] - 1.0) * at + c["r"] for c in (hot, cold)]
    return moved[0], moved[1]


def one_step_errors_as(model_set: str, expected: Mapping[str, float]) -> Check:
    """A check of the identifications' one-step errors [deg C] against expected ones."""

    def check(evidence: Evidence) -> Verdict:
        parts = _parts(evidence, model_set)
        found = {how: float(parts[how]["rmse"]) for how in expected if "rmse" in parts.get(how, {})}
        limit = ", ".join(f"{how} {number(value)}" for how, value in expected.items())
        what, limit = "one-step error of each identification", f"{limit} °C, each within {WITHIN:.0%}"
        if len(found) < len(expected):
            return Verdict(what, limit, "not measured", None)
        shown = ", ".join(f"{how} {number(value)}" for how, value in found.items())
        holds = all(abs(value - expected[how]) <= WITHIN * expected[how] for how, value in found.items())
        return Verdict(what, limit, f"{shown} °C", holds)

    return check


def ties_close_the_gap(model_set: str) -> Check:
    """A check that no jacket temperature lies between the modes' ranges of the tied model, and some of the others'."""

    def check(evidence: Evidence) -> Verdict:
        gaps = {how: float(found["gap"]) for how, found in _parts(evidence, model_set).items()}
        what = "temperatures that neither mode reaches"
        limit = "none with ties across the modes, some in every other model"
        if set(gaps) != set(ORDER):
            return Verdict(what, limit, "not measured", None)
        shown = ", ".join(f"{how} {value:.2f}" for how, value in gaps.items())
        others = [value for how, value in gaps.items() if how != "tied"]
        return Verdict(what, limit, f"up to {shown} °C a period", gaps["tied"] <= NO_GAP < min(others))

    return check


def printed_gap(model_set: str, expected: float) -> Check:
    """A check of the printed model's gap [deg C a period] against the expected one."""

    def check(evidence: Evidence) -> Verdict:
        gaps = [float(found["gap"]) for how, found in _parts(evidence, model_set).items() if how == "printed"]
        what, limit = "gap between the printed modes", f"{number(expected)} °C a period, within {WITHIN:.0%}"
        if not gaps:
            return Verdict(what, limit, "not measured", None)
        return Verdict(what, limit, f"{gaps[0]:.2f} °C a period", abs(gaps[0] - expected) <= WITHIN * expected)

    return check


def cold_authority(model_set: str, centre: float, expected: float) -> Check:
    """A check of how many times weaker the printed cold valve is at one rule than the reactor's."""

    def check(evidence: Evidence) -> Verdict:
        printed = _parts(evidence, model_set).get("printed", {})
        key = f"b_cold_{centre:g}"
        what = f"authority of the cold valve at {centre:g} °C"
        limit = f"printed {number(expected)} times weaker than the reactor's, within {WITHIN:.0%}"
        sides = [printed.get("physics", {}), printed.get("parameters", {})]
        if not all(key in side for side in sides):
            return Verdict(what, limit, "not measured", None)
        reactor, ours = (float(side[key]) for side in sides)
        ratio = reactor / ours
        shown = f"{ours:.2f} printed, {reactor:.2f} °C in the reactor: {ratio:.2f} times weaker"
        return Verdict(what, limit, shown, abs(ratio - expected) <= WITHIN * expected)

    return check
