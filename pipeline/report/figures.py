"""The closed-loop figures, drawn from the trajectories that validate left."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from pipeline.cases.base import Case, Curve, Figure
from pipeline.report.evidence import Array, Evidence, Loop

COLOURS = {
    "inc": "#d55e00",
    "incad": "#0072b2",
    "incadec": "#cc79a7",
    "pid": "#7f7f7f",
    "inverse_dob": "#009e73",
    "forward_dob": "#56b4e9",
}
SHADES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
"""Of several settings of one law."""
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


def draw_all(evidence: Evidence, folder: Path, models: Path) -> dict[str, str]:
    """Draw every figure that the evidence has trajectories for; returns file name -> caption.

    The case's own figures are ``figure_05.png`` and so on, with the best controller added;
    ``closed_loop_<law>.png`` shows each law on a held-out sequence beside the PID, and
    ``closed_loop.png`` the best one. ``models`` is work/<case>/models.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, str] = {}
    with mpl.rc_context(STYLE):
        for figure in evidence.case.figures:
            canvas = (
                _predictions(evidence.case, figure, models) if figure.scenario is None else _loops(evidence, figure)
            )
            if canvas is not None:
                name = f"figure_{figure.number:02d}.png"
                _save(canvas, folder / name)
                drawn[name] = f"Figure {figure.number}. {figure.title}"
        for law in evidence.laws:
            canvas = _overview(evidence, law)
            if canvas is None:
                continue
            name = f"closed_loop_{law}.png"
            _save(canvas, folder / name)
            drawn[name] = f"{evidence.laws[law].title} on a held-out sequence"
            if law == evidence.best:
                _save(canvas, folder / "closed_loop.png")
                drawn["closed_loop.png"] = f"{evidence.laws[law].title} on set points that nothing was tuned on"
    for path in sorted(models.glob("*/sweep.png")):
        name = f"sweep_{path.parent.name}.png"
        shutil.copyfile(path, folder / name)
        drawn[name] = f"Partition sweep of the model {path.parent.name}"
    return drawn


def _save(canvas: Canvas, path: Path) -> None:
    """Write the PNG by renaming a draft; without date and version inside, so that equal data give equal files."""
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=100, facecolor="white", metadata={"Software": None})
    draft = path.with_suffix(".draft")
    draft.write_bytes(buffer.getvalue())
    os.replace(draft, path)


def _panels(case: Case, title: str) -> tuple[Canvas, Axes, Axes]:
    canvas = Canvas(figsize=SIZE, layout="constrained")
    top, bottom = canvas.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (3, 2)})
    cv, mv = case.plant_class.sp_signals[0], case.plant_class.mv_signals[0]
    top.set_title(title)
    top.set_ylabel(f"{_symbol(cv.name)} [{cv.unit}]")
    bottom.set_ylabel(f"{_symbol(mv.name)} [{mv.unit}]")
    bottom.set_xlabel("time [s]")
    return canvas, top, bottom


def _symbol(name: str) -> str:
    """``C_A`` as a formula."""
    base, _, index = name.partition("_")
    return f"${base}_{{{index}}}$" if index else f"${base}$"


def _add(top: Axes, bottom: Axes, loop: Loop, label: str, colour: str, strong: bool = False) -> None:
    # Each move acts over the period after its sample: a staircase that begins there.
    order = 4.0 if strong else 3.0
    wide = 1.9 if strong else 1.2
    top.plot(loop["time_s"], _first(loop["pv"]), label=label, color=colour, linewidth=wide, zorder=order)
    mv = _first(loop["mv"])
    # Laws that ring fill the panel: behind the strong curve they are only hinted at.
    faint = 1.0 if strong else 0.5
    bottom.step(loop["time_s"], mv, where="post", color=colour, linewidth=0.6 * wide, zorder=order, alpha=faint)


def _first(values: Array) -> Array:
    return values if values.ndim == 1 else values[:, 0]


def _finish(canvas: Canvas, top: Axes, loop: Loop) -> None:
    top.plot(loop["time_s"], _first(loop["sp"]), "--", color="black", linewidth=0.9, label="set point", zorder=2)
    top.margins(x=0.01)
    labels = top.get_legend_handles_labels()[1]
    canvas.legend(loc="outside lower center", ncols=min(4, len(labels)))


def _loops(evidence: Evidence, figure: Figure) -> Canvas | None:
    """A figure of the paper: its curves, and our best controller with them."""
    curves: Sequence[Curve] = figure.curves
    best = None if evidence.best is None else Curve(evidence.best)
    if best is not None and best.law not in {c.law for c in curves}:
        curves = (*curves, best)
    scenario = figure.scenario or ""
    found = [(c, loop) for c in curves if (loop := evidence.loop(c, scenario, figure.hold)) is not None]
    if not found:
        return None
    canvas, top, bottom = _panels(evidence.case, f"Figure {figure.number}. {figure.title}")
    one_law = len({c.law for c in figure.curves}) == 1
    for i, (curve, loop) in enumerate(found):
        ours = curve is best
        colour = SHADES[i % len(SHADES)] if one_law and not ours else _colour(curve.law)
        _add(top, bottom, loop, curve.label + (" (ours, best)" if ours else ""), "black" if ours else colour, ours)
    _finish(canvas, top, found[0][1])
    return canvas


def _colour(law: str) -> str:
    return COLOURS.get(law, "#444444")


def _overview(evidence: Evidence, law: str) -> Canvas | None:
    """A law beside the PID on the test that weighs most in the gate (its first sequence), with the figures over all."""
    scenario = max(evidence.case.gate, key=lambda name: evidence.case.gate[name])
    own = evidence.loop(Curve(law), scenario)
    if own is None:
        return None
    mae, bound = evidence.figure(law, scenario), evidence.bound(scenario)
    beside = "" if not bound or mae is None else f", {mae / bound:.2f} × perfect-model NMPC"
    canvas, top, bottom = _panels(evidence.case, f"{evidence.laws[law].title}\nMAE {mae:.4f}{beside}")
    baseline = evidence.loop(Curve("pid"), scenario) if law != "pid" else None
    if baseline is not None:
        _add(top, bottom, baseline, f"PID, MAE {evidence.figure('pid', scenario):.4f}", COLOURS["pid"])
    _add(top, bottom, own, law, _colour(law), strong=True)
    _finish(canvas, top, own)
    return canvas


def _predictions(case: Case, figure: Figure, models: Path) -> Canvas | None:
    """The inverse model's MV beside the real one over some validation samples."""
    found = sorted(models.glob("*/predictions.npz"))
    if not found:
        return None
    with np.load(found[0], allow_pickle=False) as file:
        time_s, actual, predicted = (np.ravel(file[k]) for k in ("time_s", "actual", "predicted"))
    canvas = Canvas(figsize=(SIZE[0], 4.2), layout="constrained")
    axes = canvas.subplots(1, 2, gridspec_kw={"width_ratios": (2.4, 1)})
    n = min(len(actual), 100)
    # No line: a random split leaves samples that do not follow one another.
    axes[0].plot(time_s[:n], actual[:n], "o", color="black", markersize=5, fillstyle="none", label="applied")
    axes[0].plot(time_s[:n], predicted[:n], ".", color=COLOURS["incad"], markersize=4, label="predicted")
    axes[0].set_title(f"Figure {figure.number}. {figure.title}")
    axes[0].set_xlabel("time [s]")
    mv = case.plant_class.mv_signals[0]
    axes[0].set_ylabel(f"{_symbol(mv.name)} [{mv.unit}]")
    canvas.legend(loc="outside lower center", ncols=2)
    axes[1].plot(actual, predicted, ".", color=COLOURS["incad"], markersize=3)
    ends = [float(min(actual.min(), predicted.min())), float(max(actual.max(), predicted.max()))]
    axes[1].plot(ends, ends, color="black", linewidth=0.8)
    axes[1].set_xlabel(f"applied [{mv.unit}]")
    axes[1].set_ylabel(f"predicted [{mv.unit}]")
    axes[1].set_aspect("equal", adjustable="box")
    return canvas
