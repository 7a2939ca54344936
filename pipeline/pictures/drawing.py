"""What all pictures share: size, style, colours, labels, the time axis, and the file that is written."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure as Canvas

from pipeline.evaluation.law_evidence import Array
from pipeline.evaluation.metric import NO_UNIT

BASELINE, BASELINE_COLOUR = "pid", "#7f7f7f"
PALETTE = ("#d55e00", "#0072b2", "#cc79a7", "#009e73", "#56b4e9", "#e69f00", "#8c564b", "#332288")
"""Of the other laws of a case, in their order; told apart also by the colour-blind."""
SHADES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
"""Of several settings of one law."""
OTHER_COLOUR = "#444444"
SIZE = (8.4, 5.2)  # inches; 100 dots each: MLflow shows pictures in their own size
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
LONGEST_IN_S, LONGEST_IN_MIN = 3000.0, 30_000.0  # [s] of a picture whose axis counts seconds, minutes


def colour_of(law: str, laws: Iterable[str]) -> str:
    """The law's colour among all of its case."""
    if law == BASELINE:
        return BASELINE_COLOUR
    others = [name for name in laws if name != BASELINE]
    return PALETTE[others.index(law) % len(PALETTE)] if law in others else OTHER_COLOUR


def time_axis(time_s: Array) -> tuple[Array, str]:
    """Times (n,) in the unit that reads best over this span, and the axis's label."""
    if time_s[-1] <= LONGEST_IN_S:
        return time_s, "time [s]"
    if time_s[-1] <= LONGEST_IN_MIN:
        return time_s / 60.0, "time [min]"
    return time_s / 3600.0, "time [h]"


def symbol(name: str) -> str:
    """``C_A`` as a formula."""
    base, _, index = name.partition("_")
    if len(base) > 1 and not index:
        return name
    return f"${base}_{{{index}}}$" if index else f"${base}$"


def axis_label(words: str, unit: str) -> str:
    """``words [unit]``; a number without a unit stands alone."""
    return words if unit in NO_UNIT else f"{words} [{unit.replace('deg', '°')}]"


def ratio_unit(top: str, bottom: str) -> str:
    """Unit of a quotient."""
    if bottom in NO_UNIT:
        return top
    below = f"({bottom})" if "/" in bottom else bottom
    return f"{'1' if top in NO_UNIT else top}/{below}"


def save(canvas: Canvas, path: Path) -> None:
    """Write the PNG by renaming a draft; without date and version inside, so that equal data give equal files."""
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=100, facecolor="white", metadata={"Software": None})
    draft = path.with_suffix(".draft")
    draft.write_bytes(buffer.getvalue())
    os.replace(draft, path)
