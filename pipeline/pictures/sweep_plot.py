"""The picture of a partition sweep."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from loopwright.pipeline.files import draft_of

if TYPE_CHECKING:
    from loopwright.pipeline.models.static.sweep import SweepResult


def draw(result: SweepResult, path: Path) -> None:
    """RMSE overall and per region above, the number of centres below, the chosen partitions marked."""
    c = [row.partitions for row in result.rows]
    best = result.best
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    error, size = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    error.plot(c, [row.validation.rmse for row in result.rows], color="black", lw=2, label="validation")
    error.plot(c, [row.train.rmse for row in result.rows], color="0.6", lw=2, label="training")
    names = dict.fromkeys(name for row in result.rows for name in row.validation.regions)
    for i, name in enumerate(names):
        values = [row.validation.regions.get(name, float("nan")) for row in result.rows]
        error.plot(c, values, color=f"C{i}", lw=1, label=f"validation, {name}")
    error.plot([best.partitions], [best.validation.rmse], "o", color="C3", ms=7)
    error.set_title(
        f"best: c = {best.partitions}, {best.centres} centres, RMSE {best.validation.rmse:.3g} {result.unit}"
    )
    error.set_yscale("log")
    error.set_ylabel("RMSE" + (f" [{result.unit}]" if result.unit else ""))
    figure.legend(loc="outside lower center", frameon=False, ncols=3)
    size.plot(c, [row.centres for row in result.rows], color="black")
    size.set_ylabel("centres")
    size.set_xlabel("partitions c of each input")
    for axes in (error, size):
        axes.axvline(best.partitions, color="C3", lw=0.8, ls=":")
        axes.grid(alpha=0.3)
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=120, format=path.suffix.lstrip(".") or "png")
