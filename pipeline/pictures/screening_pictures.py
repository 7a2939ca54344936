"""Pictures of a screening: trends with their masks, the first stretch of every fault, readings by reason."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Patch
from numpy.typing import NDArray

from loopwright.pipeline.historian.cleaning.findings import TagReport
from loopwright.pipeline.historian.files.date_forms import DAY_S
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.historian.files.signal_statistics import runs_of
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.pictures.drawing import PICTURE_SIZE, STYLE, axis_label, legend_below, time_axis

TIME_TICKS = (4, 12)  # fewest and most


@dataclass(frozen=True, slots=True)
class ExportTimes:
    """Times [s] of an export from ``start_s`` to ``end_s``; ``zone`` as in ``Export``, empty of one without dates.

    Dates are drawn in ``local``, the zone that a person named, in which `--leave-out` counts too.
    """

    start_s: float
    end_s: float
    zone: str
    local: tzinfo = UTC

    def at(self, time_s: Array) -> Array:
        """Places (n,) on the axis of times (n,)."""
        if self.zone:
            return np.asarray(time_s / DAY_S)
        whole = self.end_s - self.start_s
        scale = time_axis(np.array([0.0, whole]))[0][1] / whole if whole > 0 else 1.0
        return np.asarray((time_s - self.start_s) * scale)

    @property
    def label(self) -> str:
        """Label of the axis."""
        return f"time ({self.zone})" if self.zone else time_axis(np.array([0.0, self.end_s - self.start_s]))[1]

    @property
    def words(self) -> str:
        """From when to when, for a sentence."""
        if not self.zone:
            return "The export has no dates: the time counts from its first row."
        start, end = (f"{datetime.fromtimestamp(t, self.local):%Y-%m-%d %H:%M:%S}" for t in (self.start_s, self.end_s))
        return f"From {start} to {end}, {self.zone}."

    def dress(self, axis: Axis) -> None:
        """Give the axis the ticks of dates, where there are dates."""
        if self.zone:
            locator = AutoDateLocator(tz=self.local, minticks=TIME_TICKS[0], maxticks=TIME_TICKS[1])  # type: ignore[no-untyped-call]
            axis.set_major_locator(locator)
            axis.set_major_formatter(ConciseDateFormatter(locator, tz=self.local))  # type: ignore[no-untyped-call]


# -------------------------------------------------------------------------------------------------------- the pictures
COLOURS = {
    Reason.EMPTY: "#bbbbbb", Reason.TEXT: "#8c564b", Reason.QUALITY: "#332288", Reason.SENTINEL: "#d55e00",
    Reason.RANGE: "#882255", Reason.UNIT_SLIP: "#cc79a7", Reason.OUTLIER: "#e69f00", Reason.DUPLICATE: "#dddddd",
    Reason.CLOCK: "#44aa99", Reason.GAP: "#999999", Reason.STUCK: "#009e73", Reason.SATURATED: "#56b4e9",
    Reason.MODE: "#ddcc77", Reason.SHORT_RUN: "#777777", Reason.COPY: "#6699cc", Reason.UNLIKE: "#ee3377",
    Reason.STOP: "#bbaa88", Reason.LEFT_OUT: "#aaaaaa",
}  # fmt: skip
LINE = "#0072b2"
LINE_POINTS = 3000  # of a line; more are drawn by their extremes
TREND_INCHES, HEAD_INCHES = 1.35, 1.0  # inches
MOST_PANELS, MOST_DETAILS = 8, 6  # tags that are drawn whole, and stretches that are drawn near
MOST_SPANS = 400  # spans of one reason that are drawn, and pieces of a line before it is thinned
ROWS_AROUND, AROUND_SHARE = 25, 0.6  # rows beside a detail, or this share of its length


def trends(found: Screened) -> Canvas:
    """Every signal over time: what is kept as a line, rows left out shaded by reason, bad readings as ticks below."""
    tags = [t for t in found.report.tags if t.role != "mode"][:MOST_PANELS]
    with rc_context(STYLE):
        canvas = Canvas(figsize=(PICTURE_SIZE[0] * 1.25, HEAD_INCHES + TREND_INCHES * len(tags)), layout="constrained")
        panels = canvas.subplots(len(tags), 1, sharex=True, squeeze=False)[:, 0]
        times = times_of(found)
        seen: set[Reason] = set()
        for axes, tag in zip(panels, tags, strict=True):
            seen |= _trend(axes, found, tag, times)
        times.dress(panels[-1].xaxis)
        panels[-1].set_xlabel(times.label)
        if seen:
            _reason_legend(canvas, seen)
        return canvas


def times_of(found: Screened) -> ExportTimes:
    """From the first row to the last one."""
    zone = found.report.zone if found.local is None else str(found.local)
    return ExportTimes(float(found.grid.time_s[0]), float(found.grid.time_s[-1]), zone, found.local or UTC)


def _trend(axes: Axes, found: Screened, tag: TagReport, times: ExportTimes) -> set[Reason]:
    """Trend of one signal over the grid's rows."""
    grid, series = found.grid, found.series[tag.tag]
    at = times.at(grid.time_s)
    values = grid.value[tag.tag]
    fresh = np.r_[True, np.diff(grid.piece) > 0]
    for mask, colour in ((found.code > 0, "#c8c8c8"), (found.code == 0, LINE)):
        axes.plot(*_stretches(at, values, mask, fresh), color=colour, linewidth=0.9)
    seen = _shade(axes, at, found.code)
    for k in np.flatnonzero(fresh[1:])[:MOST_SPANS]:
        axes.axvspan(at[k], at[k + 1], color=COLOURS[Reason.GAP], alpha=0.3, linewidth=0)
        seen.add(Reason.GAP)
    finite = values[np.isfinite(values)]
    if finite.size:
        low, high = np.quantile(finite, [0.001, 0.999])
        pad = 0.08 * (high - low) or 1.0
        axes.set_ylim(low - 2 * pad, high + pad)
    bad = np.flatnonzero((series.code > 0) & (series.code != Reason.DUPLICATE))
    bad = bad[:: max(1, len(bad) // LINE_POINTS)]
    for reason in np.unique(series.code[bad]):
        own = bad[series.code[bad] == reason]
        x = times.at(series.time_s[own])
        axes.plot(x, np.full(len(x), 0.05), "|", color=COLOURS[Reason(reason)], transform=axes.get_xaxis_transform(),
                  markersize=7, markeredgewidth=1.2, zorder=4)  # fmt: skip
        seen.add(Reason(reason))
    # In the picture's own words; a name may hold any sign.
    axes.set_title(f"{axis_label(tag.name, tag.unit)}  ({tag.role.upper()})", fontsize=9.5, parse_math=False)
    axes.margins(x=0.005)
    return seen


def details(found: Screened) -> Canvas | None:
    """Readings around the first stretch of every reason of every tag, at most MOST_DETAILS; None without any."""
    wanted = [
        (tag, Reason(r))
        for r in sorted(Reason)
        for tag in found.report.tags
        if r not in {Reason.GOOD, Reason.DUPLICATE, Reason.MODE, Reason.SHORT_RUN, Reason.GAP} and tag.role != "mode"
        and (np.any(found.series[tag.tag].code == r) or np.any(found.grid.code[tag.tag] == r))
    ][:MOST_DETAILS]  # fmt: skip
    if not wanted:
        return None
    rows = (len(wanted) + 1) // 2
    with rc_context(STYLE):
        canvas = Canvas(figsize=(PICTURE_SIZE[0] * 1.25, 0.3 + 2.0 * rows), layout="constrained")
        panels = canvas.subplots(rows, 2, squeeze=False).ravel()
        for axes, (tag, reason) in zip(panels, wanted, strict=False):
            _detail(axes, found, tag, reason)
        for axes in panels[len(wanted) :]:
            axes.set_axis_off()
        return canvas


def _detail(axes: Axes, found: Screened, tag: TagReport, reason: Reason) -> None:
    series, grid = found.series[tag.tag], found.grid
    raw = bool(np.any(series.code == reason))
    times = series.time_s if raw else grid.time_s
    start, end = runs_of(series.code == reason if raw else grid.code[tag.tag] == reason)
    longest = int(np.argmax(end - start))
    a, b = int(start[longest]), int(end[longest]) - 1
    around = max(ROWS_AROUND, int(AROUND_SHARE * (b - a)))
    first, last = times[max(a - around, 0)], times[min(b + around, len(times) - 1)]
    near = (series.time_s >= first) & (series.time_s <= last)
    source, values, codes = series.time_s, series.value, series.code
    if near.sum() < 2:  # of a long export only the remarkable readings are kept
        source, values, codes = grid.time_s, grid.value[tag.tag], np.zeros(len(grid), np.uint8)
        near = (source >= first) & (source <= last)
    t = source[near]
    # Without dates the time counts from the export's first row, in a unit that suits the detail's end.
    axis = ExportTimes(float(grid.time_s[0]), float(t[-1]), found.report.zone)
    x = axis.at(t)
    v, code = values[near], codes[near]
    good = code == Reason.GOOD
    axes.plot(x[good], v[good], ".-", color=LINE, linewidth=0.8, markersize=3)
    # A code for a missing value has no place on the axis of the others.
    bad = (code == reason) & np.isfinite(v) & (reason is not Reason.SENTINEL)
    axes.plot(x[bad], v[bad], "o", color=COLOURS[reason], markersize=4)
    lost = (code == reason) & ~bad
    axes.plot(x[lost], np.full(lost.sum(), 0.04), "|", color=COLOURS[reason], transform=axes.get_xaxis_transform(),
              markersize=9, markeredgewidth=1.5)  # fmt: skip
    if not raw:
        own = (grid.time_s >= first) & (grid.time_s <= last) & (grid.code[tag.tag] == reason)
        axes.plot(axis.at(grid.time_s[own]), grid.value[tag.tag][own], "o", color=COLOURS[reason], markersize=3)
    axes.set_title(f"{tag.name}: {reason.words}", fontsize=9.5, parse_math=False)
    axis.dress(axes.xaxis)
    axes.xaxis.get_offset_text().set_fontsize(8.5)
    axes.set_xlabel(axis.label, fontsize=8.5)
    axes.tick_params(labelsize=8.5)


def readings(found: Screened) -> Canvas:
    """Bad readings of every tag by reason, in percent of its readings."""
    tags = list(found.report.tags)
    with rc_context(STYLE):
        canvas = Canvas(figsize=(PICTURE_SIZE[0] * 1.25, HEAD_INCHES + 0.6 + 0.32 * len(tags)), layout="constrained")
        axes = canvas.subplots()
        left = np.zeros(len(tags))
        seen: set[Reason] = set()
        for reason in Reason:
            if reason is Reason.GOOD:
                continue
            key = reason.name.lower()
            share = np.array([100 * _count(t, key) / max(sum(t.readings.values()), 1) for t in tags])
            if share.any():
                axes.barh(range(len(tags)), share, left=left, color=COLOURS[reason], height=0.65)
                left += share
                seen.add(reason)
        axes.set_yticks(range(len(tags)), [t.name for t in tags], parse_math=False)
        axes.invert_yaxis()
        axes.set_xlabel("readings or rows left out [% of the tag's readings]")
        axes.set_xlim(0, max(float(left.max()) * 1.05, 1e-3))
        axes.grid(axis="y", visible=False)
        if seen:
            _reason_legend(canvas, seen)
        return canvas


def _count(tag: TagReport, key: str) -> int:
    return tag.readings.get(key, 0) or tag.rows_lost.get(key, 0)


def _shade(axes: Axes, at: Array, code: NDArray[np.uint8]) -> set[Reason]:
    seen = set()
    for reason in np.unique(code[code > 0]):
        start, end = runs_of(code == reason)
        order = np.argsort(start - end)[:MOST_SPANS]
        for a, b in zip(start[order], end[order], strict=True):
            axes.axvspan(at[a], at[min(b, len(at) - 1)], color=COLOURS[Reason(reason)], alpha=0.3, linewidth=0)
        seen.add(Reason(reason))
    return seen


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """At most about 2 LINE_POINTS points with the same extremes."""
    if len(x) <= 2 * LINE_POINTS:
        return x, y
    block = len(x) // LINE_POINTS
    n = len(x) // block * block
    shaped = y[:n].reshape(-1, block)
    empty = np.isnan(shaped).all(axis=1)
    filled = np.where(np.isnan(shaped), np.inf, shaped)
    low = np.where(empty, np.nan, filled.min(axis=1))
    high = np.where(empty, np.nan, np.where(np.isinf(filled), -np.inf, filled).max(axis=1))
    return np.repeat(x[:n:block], 2), np.column_stack([low, high]).ravel()


def _stretches(x: Array, y: Array, mask: NDArray[np.bool_], fresh: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The points of every stretch of ``mask``, with a break between two; ``fresh`` rows begin a stretch."""
    rows = np.flatnonzero(mask)
    if not rows.size:
        return np.zeros(0), np.zeros(0)
    cuts = np.flatnonzero((np.diff(rows) > 1) | fresh[rows[1:]]) + 1
    if len(cuts) > MOST_SPANS:
        return _thinned(x, np.where(mask, y, np.nan))
    parts = [_thinned(x[part], y[part]) for part in np.split(rows, cuts)]
    end = np.array([np.nan])
    columns = ([np.concatenate([part[i], end]) for part in parts] for i in (0, 1))
    first, second = (np.concatenate(column) for column in columns)
    return first, second


def _reason_legend(canvas: Canvas, seen: set[Reason]) -> None:
    order = sorted(seen)
    patches: list[Any] = [Patch(color=COLOURS[r]) for r in order]
    legend_below(canvas, patches, [r.words for r in order], most=4)
