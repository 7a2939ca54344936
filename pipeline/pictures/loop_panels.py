"""Panels of closed loops: controlled variables with their set points, MVs, and measured disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Patch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.law_evidence import Array, Loop
from loopwright.pipeline.pictures.drawing import (
    PICTURE_SIZE,
    REFERENCE,
    SET_POINT,
    axis_label,
    fit_labels,
    layer,
    legend_below,
    signal_label,
    time_axis,
)
from loopwright.serving.manifest import Signal

DISCRETE_HEIGHT = 0.7  # height of a discrete MV's panel, where a continuous one's is 2
STRIP_ROOM = 0.3  # above and below its values, as a share of their range
INCHES = 0.84  # that a height of 1 takes
CV_HEIGHT, SHARED_HEIGHT = 3.0, 2.2  # of the panel of the controlled variable, and of each of several
MV_HEIGHT, OWN_HEIGHT = 2.0, 1.2  # of the panel of a continuous MV, and of one that a ringing law has for itself
MV_THINNER = 0.7  # its line beside the controlled variable's
REVERSAL_WINDOWS = 50  # parts of the time axis, each about 15 pixels wide, in which reversals are counted
MOST_REVERSALS = 4  # of an MV in such a part; more of them run into one another
LEAST_REVERSAL = 0.02  # of the MV's range: a smaller move is no reversal
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
        self.canvas = Canvas(figsize=(PICTURE_SIZE[0], PICTURE_SIZE[1] + more), layout="constrained")
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
            return DISCRETE_HEIGHT
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
    return max(2, len(mv) // REVERSAL_WINDOWS)


def too_fast(mv: Array, signal: Signal) -> NDArray[np.bool_]:
    """Samples (n,) around which a continuous MV (n,) reverses more often than a picture can show."""
    if signal.values is not None or len(mv) < REVERSAL_WINDOWS:
        return np.zeros(len(mv), dtype=bool)
    width = _window(mv)
    moved = np.diff(mv)
    at = np.flatnonzero(np.abs(moved) > LEAST_REVERSAL * (signal.high - signal.low))
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
