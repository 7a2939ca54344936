"""Pictures of tests in which operators change more than set points: ranges as bands, and times outside them."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Array, Loop
from loopwright.pipeline.evaluation.operated import OperatedResult
from loopwright.pipeline.evaluation.ranges_kept import stretches_outside
from loopwright.pipeline.pictures.drawing import (
    FRONT,
    PALETTE,
    PICTURE_SIZE,
    SET_POINT,
    fit_labels,
    legend_below,
    signal_label,
    time_axis,
)
from loopwright.serving.manifest import Signal

IN_RANGE: Any = {"color": "#009e73", "alpha": 0.16, "linewidth": 0}
OUTSIDE: Any = {"color": "#d55e00", "alpha": 0.25, "linewidth": 0}
OUT_OF_USE: Any = {"color": "#888888", "alpha": 0.25, "linewidth": 0}
RESTING: Any = {"color": "#332288", "linestyle": ":", "linewidth": 1.3}
COURSE, MOVED = PALETTE[1], "#444444"  # a process variable and an MV
PANEL = 1.55  # inches of a panel's height
ROOM_AROUND = 0.08  # of what is shown, above and below


def operated_picture(evidence: Evidence, law: str, test: str) -> tuple[Canvas, str]:
    """The loop of a test that was outside its ranges longest, and what its picture shows, in words.

    Raises NotMeasuredError where its course was not kept.
    """
    loop, result = evidence.laws[law].operated(test), evidence.laws[law].metrics.operated[test]
    if not loop:
        raise NotMeasuredError
    pvs, mvs = evidence.case.plant.pv_signals, evidence.case.plant.mv_signals
    hidden = {one.signal: one.hidden for one in result.ranges}
    shown = [i for i, s in enumerate(pvs[: loop["pv"].shape[1]]) if _asked(loop, i, s)]
    n = len(shown) + len(mvs)
    canvas = Canvas(figsize=(PICTURE_SIZE[0], 1.1 + PANEL * n), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(n, 1, sharex=True)))
    panels[0].set_title(f"{evidence.laws[law].title}\n{result.title}", wrap=True)
    time, words = time_axis(loop["time_s"])
    for axes, i in zip(panels, shown, strict=False):
        _draw_pv(axes, time, loop, i, pvs[i], hidden.get(pvs[i].name, 0.0))
    for axes, (j, s) in zip(panels[len(shown) :], enumerate(mvs), strict=True):
        _draw_mv(axes, time, loop, j, s)
    for axes in panels:
        axes.margins(x=0.01)
    panels[-1].set_xlabel(words)
    canvas.align_ylabels(panels)
    drawn = _legend(loop, any(one.outside for one in result.ranges))
    legend_below(canvas, list(drawn.values()), list(drawn))
    fit_labels(canvas)
    return canvas, _caption(result)


def _asked(loop: Loop, i: int, s: Signal) -> bool:
    """Whether a PV has a set point or a narrower range than its own at any time of a test."""
    low, high = loop["low"][:, i], loop["high"][:, i]
    narrower = np.nanmax(low, initial=s.low) > s.low or np.nanmin(high, initial=s.high) < s.high
    return bool(narrower or loop["track"][:, i].any())


def _draw_pv(axes: Axes, time: Array, loop: Loop, i: int, s: Signal, hidden: float) -> None:
    """A PV over its range as a band, with the time outside it shaded, and its set point while it follows one."""
    y, low, high = loop["pv"][:, i], loop["low"][:, i], loop["high"][:, i]
    axes.set_ylabel(signal_label(s))
    follows = (loop["track"][:, i] > 0) & (loop["use"][:, i] > 0)
    seen = [y]
    if follows.any() and i < loop["sp"].shape[1]:
        sp = np.where(follows, loop["sp"][:, i], np.nan)
        axes.step(time, sp, where="post", **SET_POINT)
        seen.append(sp[follows])
    if np.isfinite(low).all():
        narrow = [end for end, own in ((low, s.low), (high, s.high)) if np.any(end != own)]
        seen += [end[end != (s.low if end is low else s.high)] for end in narrow]
        asked = (loop["use"][:, i] > 0) & ((low > s.low) | (high < s.high))
        axes.fill_between(time, low, high, where=asked, step="post", zorder=1, **IN_RANGE)
        for part in stretches_outside(y, low, high, hidden):
            end = min(part.stop, len(time) - 1)
            axes.axvspan(time[part.start], time[end], zorder=0, **OUTSIDE)
    axes.plot(time, y, color=COURSE, linewidth=FRONT, zorder=3)
    _limit(axes, np.concatenate(seen))


def _draw_mv(axes: Axes, time: Array, loop: Loop, j: int, s: Signal) -> None:
    """An MV with operators' limits as a band where they are narrower than its range, and the time it was out of use."""
    mv, low, high = loop["mv"][:, j], loop["mv_low"][:, j], loop["mv_high"][:, j]
    axes.set_ylabel(signal_label(s))
    seen = [mv]
    if np.isfinite(low).all() and (np.any(low > s.low) or np.any(high < s.high)):
        axes.fill_between(time, low, high, step="post", zorder=1, **IN_RANGE)
        seen += [low[low > s.low], high[high < s.high]]
    if loop["out"][:, j].any():
        axes.fill_between(time, 0, 1, where=loop["out"][:, j] > 0, step="post", transform=axes.get_xaxis_transform(),
                          **OUT_OF_USE)  # fmt: skip
    if np.isfinite(loop["rest"][:, j]).any():
        axes.step(time, loop["rest"][:, j], where="post", **RESTING)
        seen.append(loop["rest"][np.isfinite(loop["rest"][:, j]), j])
    axes.step(time, mv, where="post", color=MOVED, linewidth=FRONT, zorder=3)
    _limit(axes, np.concatenate(seen))


def _limit(axes: Axes, values: Array) -> None:
    """An axis of what is shown with a little room, and not of a range that nothing comes near."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    room = ROOM_AROUND * max(high - low, 1e-9 * max(abs(low), abs(high), 1.0))
    axes.set_ylim(low - room, high + room)


def _legend(loop: Loop, outside: bool) -> dict[str, Any]:
    """The lines and patches that the picture has, by their words."""
    rests, out = np.isfinite(loop["rest"]).any(), loop["out"].any()
    ranged = np.ptp(loop["low"], axis=0).any() or np.ptp(loop["high"], axis=0).any() or outside
    return {
        "process variable": Line2D([], [], color=COURSE, linewidth=FRONT),
        "MV": Line2D([], [], color=MOVED, linewidth=FRONT),
        **({"set point": Line2D([], [], **SET_POINT)} if loop["track"].any() else {}),
        **({"range": Patch(**IN_RANGE)} if ranged else {}),
        **({"time outside it": Patch(**OUTSIDE)} if outside else {}),
        **({"MV out of use": Patch(**OUT_OF_USE)} if out else {}),
        **({"resting value": Line2D([], [], **RESTING)} if rests else {}),
    }


def _caption(result: OperatedResult) -> str:
    """The choice of the loop, in words; empty where there is one."""
    count = len(result.loops)
    return "" if count == 1 else f". It is the one of {count} loops that was outside its ranges longest"
