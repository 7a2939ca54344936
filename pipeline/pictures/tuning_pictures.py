"""The picture of all numbers that a law's search tried: the loops' error over the MVs' travel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullLocator

from loopwright.pipeline.evaluation.evidence import NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import FormAnalysis
from loopwright.pipeline.pictures.drawing import OTHER_COLOUR, PALETTE, PICTURE_SIZE, legend_below, scale
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.tuning.calm_choice import CALM_COST

MOST_DRAWN_ERROR = 1.5  # times the least; farther numbers stand at the upper edge, or nothing else could be told apart
EDGE_ROOM = 0.06  # of the axis's height, above the numbers at the upper edge and below the least
SPEED = "speed"  # the number of a law that a person changes first
SPEED_COLOURS = "viridis"  # brighter is faster; even in grey
MOST_SPEEDS = 9  # that have room for a number each beside the colours


class TriedPoint(NamedTuple):
    """Numbers that a search tried: the MVs' travel and the loops' error."""

    travel: float  # [% of the MVs' range a sample]
    error: float  # times the least


@dataclass(frozen=True, slots=True)
class TravelCurve:
    """All numbers that a search tried, and which of them the law has."""

    points: Sequence[TriedPoint]
    taken: int  # the law's own among them
    speed: Sequence[float] | None  # of each, where the law has a speed

    @classmethod
    def of(cls, analysis: FormAnalysis | None) -> Self:
        """The points of an analysis's table; raises NotMeasuredError where it has none, or knows none as taken."""
        rows = () if analysis is None else analysis.table
        if not rows or not {"travel", "error", "taken"} <= set(rows[0]):
            raise NotMeasuredError
        taken, least = [i for i, row in enumerate(rows) if row["taken"]], min(row["error"] for row in rows)
        if not taken or not least > 0:
            raise NotMeasuredError
        speed = [float(row[SPEED]) for row in rows] if SPEED in rows[0] else None
        return cls([TriedPoint(float(row["travel"]), float(row["error"] / least)) for row in rows], taken[0], speed)

    @property
    def least(self) -> int:
        """The point of the least error; of equal ones that of the least travel."""
        return min(range(len(self.points)), key=lambda i: self.points[i][::-1])

    @property
    def edge(self) -> list[int]:
        """The points that no other one betters in both, by their travel: the Pareto edge."""
        found: list[int] = []
        for i in sorted(range(len(self.points)), key=lambda i: self.points[i]):
            if not found or self.points[i].error < self.points[found[-1]].error:
                found.append(i)
        return found

    def words(self, title: str) -> str:
        """The caption: how many points there are, which one is taken, and what a speed does."""
        taken, least = self.points[self.taken], self.points[self.least]
        caption = f"{title}: error over travel of the {len(self.points)} sets of numbers that the search tried"
        if taken == least or not least.travel:
            caption += "; those of the least error are taken"
        else:
            more, moved = number(100 * (taken.error - 1), 2), number(100 * taken.travel / least.travel, 2)
            caption += f"; those taken err {more} % more than those of the least error, and travel {moved} % as far"
        if self.speed is None:
            return caption
        return (
            f"{caption}. A higher speed moves the MVs more and follows faster, a lower one is calmer; to choose it "
            "yourself, give the controller tuning: given and its speed"
        )


def travel_picture(curve: TravelCurve, law: str) -> Canvas:
    """Each set of numbers that the search of a law tried: error over travel, their edge, the least and the taken."""
    travel, error = np.array(curve.points).T
    top = max(MOST_DRAWN_ERROR, error[curve.taken])
    near, edge = error <= top, [i for i in curve.edge if error[i] <= top]
    canvas = Canvas(figsize=PICTURE_SIZE, layout="constrained")
    axes = canvas.subplots()
    dots: Any = {"s": 34, "zorder": 3, "edgecolors": "white", "linewidths": 0.5}
    colours: Any = {"color": OTHER_COLOUR}
    if curve.speed is not None:
        # A speed of 0.5 is as far from 1 as 2 is; a linear scale would show the slow ones in one colour.
        span = LogNorm(min(curve.speed), max(curve.speed))
        colours = {"c": np.array(curve.speed), "cmap": SPEED_COLOURS, "norm": span}
    every = axes.scatter(travel[near], error[near], **dots, **_some(colours, near))
    if curve.speed is not None:
        bar = canvas.colorbar(every, ax=axes, label="speed")
        if len(speeds := sorted(set(curve.speed))) <= MOST_SPEEDS:
            bar.set_ticks(speeds)
            bar.ax.yaxis.set_minor_locator(NullLocator())
        plain = FuncFormatter(lambda value, _: number(value, 2))
        bar.ax.yaxis.set_major_formatter(plain)
        bar.ax.yaxis.set_minor_formatter(plain)
    handles: list[Any] = [Line2D([], [], marker="o", linestyle="", color=OTHER_COLOUR, markersize=5)]
    labels = ["tried"]
    if not near.all():
        axes.scatter(travel[~near], np.full((~near).sum(), top), marker="^", **dots, **_some(colours, ~near))
        handles.append(Line2D([], [], marker="^", linestyle="", color=OTHER_COLOUR, markersize=5))
        labels.append(f"tried, error above {top:.3g}")
    (line,) = axes.plot(travel[edge], error[edge], color="black", linewidth=1.0, drawstyle="steps-post", zorder=2)
    limit = axes.axhline(1 + CALM_COST, color=PALETTE[0], linestyle="--", linewidth=1.1, zorder=1)
    ring: Any = {"linestyle": "", "fillstyle": "none", "zorder": 4}
    least = axes.plot(travel[curve.least], error[curve.least], "s", color="black", ms=9, mew=1.4, **ring)[0]
    taken = axes.plot(travel[curve.taken], error[curve.taken], "o", color=PALETTE[0], ms=13, mew=2.0, **ring)[0]
    handles += [line, limit, least, taken]
    labels += ["no other is better in both", f"{100 * CALM_COST:.0f} % above the least error", "least error", "taken"]
    scale(axes.xaxis, travel)
    shown = max(error[near].max(), 1 + 2 * CALM_COST) if near.all() else top
    room = EDGE_ROOM * (shown - 1)
    axes.set_ylim(1 - room, shown + room)
    axes.set_xlabel("MV travel [% of its range a period]")
    axes.set_ylabel("error [times the least]")
    axes.set_title(f"{law}: the numbers that the search tried", wrap=True)
    legend_below(canvas, handles, labels, most=3)
    return canvas


def _some(colours: dict[str, Any], which: Any) -> dict[str, Any]:
    """The colours of some points."""
    return {name: value[which] if name == "c" else value for name, value in colours.items()}
