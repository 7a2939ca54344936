"""The reference models that a search found, beside those of the classic tables: a picture and a check."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.verdicts import Outcome
from loopwright.pipeline.pictures.drawing import SHADES, SIZE
from loopwright.pipeline.tuning.reference_model import CLASSIC, ORDERS, ReferenceModel

SPAN, STEP = 13.0, 0.02  # of the time wn t that is drawn
HEAD = ("order", "found: coefficients of $s^{n-1}..s^1$", "ITAE", "classic table", "ITAE")


def reference_models_picture(evidence: Evidence) -> Canvas:
    """Step responses of orders 1 to 6, found and classic, and the table of their coefficients and ITAE."""
    canvas = Canvas(figsize=(SIZE[0], 6.4), layout="constrained")
    responses, table = canvas.subplots(2, 1, height_ratios=(2.2, 1))
    for order, colour in zip(ORDERS, SHADES, strict=True):
        for model, line in ((ReferenceModel.optimal(order), "-"), (ReferenceModel.classic(order), ":")):
            time, y = _step(model)
            responses.plot(time, y, line, color=colour, linewidth=1.3, label=f"n = {order}" if line == "-" else None)
    responses.plot([], [], ":", color="black", linewidth=1.3, label="classic table")
    responses.set_xlabel(r"time $\omega_n t$")
    responses.set_ylabel("response to a unit step")
    responses.legend(loc="lower right", ncols=2)
    _table(table)
    return canvas


def _step(model: ReferenceModel) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], ...]:
    time = np.arange(0.0, SPAN, STEP)
    # At rest at 0 before the step, which is there from the first sample on.
    levels = np.concatenate([[0.0], np.ones(len(time))])
    return time, model.response(levels, STEP)[1:, 0]


def _table(axes: Axes) -> None:
    kinds = (ReferenceModel.optimal, ReferenceModel.classic)
    cells = {n: [(_words(kind(n)), f"{kind(n).itae():.3f}") for kind in kinds] for n in ORDERS}
    rows = [[f"{order}", *ours, *classic] for order, (ours, classic) in cells.items()]
    axes.axis("off")
    drawn = axes.table(rows, colLabels=HEAD, cellLoc="left", loc="center", colWidths=(0.07, 0.37, 0.09, 0.33, 0.09))
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    for cell in drawn.get_celld().values():
        cell.set_edgecolor("#cccccc")


def _words(model: ReferenceModel) -> str:
    return "   ".join(f"{c:.3f}" for c in model.coefficients) or "–"


def beats_the_classic_tables(evidence: Evidence) -> Outcome:
    """Whether the search's ITAE is below the classic table's for every order from 2."""
    pairs = {n: (ReferenceModel.optimal(n).itae(), ReferenceModel.classic(n).itae()) for n in CLASSIC if n > 1}
    shown = ", ".join(f"n = {n}: {ours:.3f} against {classic:.3f}" for n, (ours, classic) in pairs.items())
    return Outcome(shown, all(ours < classic for ours, classic in pairs.values()))
