"""Shared parts of all pictures: size, style, colours, labels, axes, legends."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Canvas
from matplotlib.legend import Legend
from matplotlib.path import Path as Outline
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, ScalarFormatter

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import Array
from loopwright.pipeline.evaluation.metric import NO_UNIT
from loopwright.pipeline.files import write_bytes
from loopwright.serving.manifest import Signal

BASELINE_COLOUR = "#7f7f7f"
PALETTE = ("#d55e00", "#0072b2", "#cc79a7", "#009e73", "#56b4e9", "#e69f00", "#8c564b", "#332288")
"""Colours of the other laws of a case, in their order; told apart also by the colour-blind."""
SHADES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
"""Colours of several settings of one law."""
OTHER_COLOUR = "#444444"
PICTURE_SIZE = (8.4, 5.2)  # inches; 100 dots each: MLflow shows pictures in their own size
STYLE: Any = {
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.edgecolor": "#888888",
    "axes.titlesize": 11.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 9.0,
}
SET_POINT: Any = {"color": "black", "linestyle": "--", "linewidth": 0.9}
REFERENCE: Any = {"color": "black", "linestyle": ":", "linewidth": 1.3}
"""Lines of the set point and of the reference model, in every picture."""
FRONT, STEP_BACK = 1.3, 0.5  # line widths in points: of the curve in front, and what each one behind it has more
PLAIN_DECADES, TICKED_DECADES = 1.0, 3.0  # an axis that spans less is linear, or has ticks at 1, 2 and 5
PLAIN_TICKS = 1e-3, 1e5  # numbers on a logarithmic axis that are written out
LEGEND_GAP = 0.03  # of the axes' height, between a legend and the curves
LONGEST_BASE = 2  # letters of a symbol before its index
LABEL_GAP = 6.0  # dots by which a label may be longer than its panel
LEAST_FONT, LEAST_LETTERS = 7.0, 8  # points, and what a shortened label keeps
LONGEST_IN_S, LONGEST_IN_MIN = 3000.0, 30_000.0  # [s] of a picture whose axis counts seconds, minutes


Draw = Callable[[Evidence], Canvas]
"""Draws what was measured; raises NotMeasuredError where that is missing, and there is no picture."""


@dataclass(frozen=True, slots=True)
class CasePicture:
    """A picture that only one case has: figures/<name>.png, below its title."""

    name: str
    title: str
    draw: Draw


def colour_of(law: str, laws: Iterable[str], baseline: str) -> str:
    """The law's colour among all of its case, whose ``baseline`` is grey."""
    if law == baseline:
        return BASELINE_COLOUR
    others = [name for name in laws if name != baseline]
    return PALETTE[others.index(law) % len(PALETTE)] if law in others else OTHER_COLOUR


def time_axis(time_s: Array) -> tuple[Array, str]:
    """Times (n,) in the unit that reads best over this span, and the axis's label."""
    if time_s[-1] <= LONGEST_IN_S:
        return time_s, "time [s]"
    if time_s[-1] <= LONGEST_IN_MIN:
        return time_s / 60.0, "time [min]"
    return time_s / 3600.0, "time [h]"


def symbol(name: str) -> str:
    """``C_A`` as a formula; a tag, such as TIC-101.PV or reactor_temperature, as it is."""
    base, _, index = name.partition("_")
    if not (base + index).isalnum() or len(base) > (LONGEST_BASE if index else 1):
        return name.replace("$", r"\$")
    return f"${base}_{{{index}}}$" if index else f"${base}$"


def axis_label(words: str, unit: str) -> str:
    """``words [unit]``; a number without a unit stands alone."""
    return words if unit in NO_UNIT else f"{words} [{unit.replace('deg', '°')}]"


def signal_label(signal: Signal) -> str:
    """A signal as a formula, with its unit."""
    return axis_label(symbol(signal.name), signal.unit)


def ratio_unit(top: str, bottom: str) -> str:
    """Unit of a quotient."""
    if bottom in NO_UNIT:
        return top
    below = f"({bottom})" if "/" in bottom else bottom
    return f"{'1' if top in NO_UNIT else top}/{below}"


def gain_unit(output: Signal, given: Signal, rate: bool) -> str:
    """Unit of the gain of an output; of one that integrates it is a rate."""
    return f"{ratio_unit(output.unit, given.unit)} a period".strip() if rate else ratio_unit(output.unit, given.unit)


def layer(rank: int) -> dict[str, Any]:
    """Line width and z-order of a curve; rank 0 lies in front.

    A curve behind another one is wider, so that both are seen where they coincide.
    """
    return {"linewidth": FRONT + STEP_BACK * rank, "zorder": 4.0 - 0.1 * rank}


def scale(axis: Axis, values: Array) -> None:
    """Give ``axis`` the scale and the ticks for ``values`` (n,): logarithmic where the positive span a decade."""
    set_scale = axis.axes.set_xscale if axis is axis.axes.xaxis else axis.axes.set_yscale
    positive = values[np.isfinite(values) & (values > 0)]
    decades = float(np.ptp(np.log10(positive))) if len(positive) else 0.0
    if decades < PLAIN_DECADES:
        set_scale("linear")
        axis.set_major_formatter(ScalarFormatter(useOffset=False))
        return
    set_scale("log", nonpositive="mask")
    if decades < TICKED_DECADES:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(_tick))
    axis.set_minor_formatter(NullFormatter())


def _tick(value: float, _place: float) -> str:
    if PLAIN_TICKS[0] <= value < PLAIN_TICKS[1]:
        return f"{value:g}"
    digits, _, power = f"{value:.0e}".partition("e")
    factor = "" if digits == "1" else rf"{digits} \cdot "
    return f"${factor}10^{{{int(power)}}}$"


def legend_below(
    canvas: Canvas, handles: Sequence[Any] = (), labels: Sequence[str] = (), most: int = 4, **options: Any
) -> Legend:
    """A legend below all panels, in as many columns as fit, at most ``most``; of ``labels`` or all there are."""
    if not labels:
        found = [axes.get_legend_handles_labels() for axes in canvas.axes]
        handles, labels = [h for row, _ in found for h in row], [text for _, row in found for text in row]
    for columns in range(min(most, len(labels)), 0, -1):
        legend: Legend = canvas.legend(handles, labels, loc="outside lower center", ncols=columns, **options)
        if columns == 1 or legend.get_window_extent().width <= canvas.bbox.width:
            break
        legend.remove()
    return legend


def lay_out(canvas: Canvas) -> None:
    """Give the panels their places, without a line drawn."""
    engine = canvas.get_layout_engine()
    if engine is not None:
        engine.execute(canvas)


def fit_labels(canvas: Canvas, titles: Iterable[Text] = ()) -> None:
    """Make the axes' labels and these panels' titles as short as their panels, so that no two run into each other.

    A label beside a panel breaks before its unit; then the letters become smaller; at last the middle is left out.
    """
    lay_out(canvas)
    fits = [_fit(axes.yaxis.label, axes, upright=True) for axes in canvas.axes]
    fits += [_fit(axes.xaxis.label, axes) for axes in canvas.axes]
    fits += [_fit(title, title.axes) for title in titles if title.axes is not None]
    if all(fits):
        canvas.set_layout_engine(None)  # nothing changed: the panels keep their places


def _fit(text: Any, axes: Any, upright: bool = False) -> bool:
    """Whether the text was short enough as it was."""
    side = "height" if upright else "width"
    room = getattr(axes.get_window_extent(), side) + LABEL_GAP

    def excess() -> float:
        return float(getattr(text.get_window_extent(), side)) / room

    if excess() <= 1:
        return True
    if upright and "\n" not in text.get_text():
        text.set_text(text.get_text().replace(" [", "\n["))
    if excess() > 1:
        text.set_fontsize(max(LEAST_FONT, text.get_fontsize() / excess()))
    words = text.get_text()
    if "$" in words:  # a formula cannot be cut
        return False
    name, end, unit = words.partition("\n")
    for kept in range(len(name) - 1, LEAST_LETTERS - 1, -1):
        if excess() <= 1:
            break
        text.set_text(f"{name[: kept // 2]}…{name[len(name) - (kept - kept // 2) :]}{end}{unit}")
    return False


def covers(legend: Legend, axes: Axes) -> bool:
    """Whether a legend's box lies over a line or a mark of ``axes``; the canvas has been drawn before."""
    box = legend.get_window_extent()
    for line in axes.lines:
        points = line.get_transform().transform(np.column_stack([line.get_xdata(), line.get_ydata()]))
        inside = axes.bbox.contains
        near = [p for p in points if np.isfinite(p).all()]
        if any(box.contains(*p) and inside(*p) for p in near):
            return True
        # Only between the marks of a line is there something drawn.
        if line.get_linestyle() != "None" and len(near) > 1 and Outline(near).intersects_bbox(box, filled=False):
            return True
    return False


def clear_legend(axes: Axes, **options: Any) -> Legend:
    """A legend inside ``axes`` that covers no curve: where there is no free corner, the y axis grows upwards.

    The axes belong to a canvas with a layout; ``options`` are those of ``Axes.legend``.
    """
    canvas: Any = axes.figure
    legend = axes.legend(loc="best", **options)
    canvas.draw_without_rendering()
    if not covers(legend, axes):
        return legend
    legend = axes.legend(loc="upper center", **options)
    canvas.draw_without_rendering()
    taken = legend.get_window_extent().height / axes.bbox.height + LEGEND_GAP
    to_scale = axes.yaxis.get_transform()
    low, high = to_scale.transform(np.array(axes.get_ylim()))
    # The present range keeps the part of the height that the legend leaves.
    top = low + (high - low) / max(1.0 - taken, 0.2)
    axes.set_ylim(axes.get_ylim()[0], float(to_scale.inverted().transform(np.array([top]))[0]))
    return legend


DPI = 100.0  # MLflow shows pictures in their own size


def png(canvas: Canvas) -> bytes:
    """The picture as a PNG; without date and version inside, so that equal data give equal files."""
    canvas.dpi = DPI
    # Matplotlib draws a canvas with a layout twice, the first time only to find it.
    lay_out(canvas)
    canvas.set_layout_engine(None)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def save(canvas: Canvas, path: Path) -> None:
    """Write the PNG whole or not at all."""
    write_bytes(path, png(canvas))
