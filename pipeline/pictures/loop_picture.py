"""The results of a simulated run: a picture, a table of samples, a line of figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.evaluation.metric import METRICS, Metric
from loopwright.pipeline.files import draft_of
from loopwright.pipeline.metrics import mv_travel
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.serving.manifest import OperateEntry, Signal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
STAYING_PART = 10  # an error stays that is there over the last tenth of a run
# of a range: an error that counts, and the distance of an MV that rests at an end
STAYING_ERROR, RESTING_AT_END = 0.002, 0.001
RUN_DPI = 120.0  # dots an inch of a file; those of reports are MLflow's
FEW_COLOURS = 128  # lines in some colours, each with the shades of its edges
DISCRETE_SHARE = 0.35  # height of a discrete MV's panel, where a continuous one's is 1


@dataclass(slots=True, eq=False)
class History:
    """A run, one entry a scan."""

    time_s: list[float] = field(default_factory=list)
    mode: list[str] = field(default_factory=list)
    sp: list[Array] = field(default_factory=list)
    pv: list[Array] = field(default_factory=list)  # true
    measured: list[Array] = field(default_factory=list)
    mv: list[Array] = field(default_factory=list)
    reason: list[str] = field(default_factory=list)
    mv0: Array | None = None  # (n_mv,) before the first scan
    entries: tuple[OperateEntry, ...] = ()  # of what operators may change of the law
    operate: list[Array] = field(default_factory=list)  # (n_operate,) a scan; empty without such entries

    def of_entry(self, name: str) -> Array | None:
        """The course (n,) of an entry of ``operate``, as ``TIC-1.track``; None where the law has no such entry."""
        places = {entry.name: i for i, entry in enumerate(self.entries)}
        return np.array(self.operate)[:, places[name]] if self.operate and name in places else None


def summary(plant: Simulator, history: History, metric: Metric = METRICS["mae"]) -> str:
    """The error of each controlled variable in the case's metric and at the end, MV travel, faults; one line each."""
    sp, pv, mv = np.array(history.sp), np.array(history.pv), np.array(history.mv)
    lines = []
    for i, s in enumerate(plant.sp_signals):
        unit = "" if s.unit == "-" else f" {s.unit}"
        follows = _follows(history, s)
        if not follows.all():
            part = 100 * float(np.mean(~follows))
            lines.append(f"{s.name} follows no set point for {part:.3g} % of the time, which is no error")
            if not follows.any():
                continue
        r, y = sp[follows, i], pv[follows, i]
        errors = [
            f"{m.short} {s.name} {m.of(r, y):.{6 if m.squared else 4}g} {m.unit_of(s.unit)}".rstrip()
            for m in dict.fromkeys((metric, METRICS["mae"]))
            if m.of is not None
        ]
        lines.append(f"{', '.join(errors)}, final error {r[-1] - y[-1]:.3g}{unit}")
    for i, s in enumerate(plant.mv_signals):
        if s.values is None:
            lines.append(
                f"travel of {s.name} {_travel(mv[:, i], history, i):.5g}" + ("" if s.unit == "-" else f" {s.unit}")
            )
        else:
            lines.append(f"changes of {s.name} {np.count_nonzero(np.diff(mv[:, i]))}")
    followed = np.column_stack([_follows(history, s) for s in plant.sp_signals])
    lines += _jammed(plant, np.where(followed, pv[:, : sp.shape[1]] - sp, 0.0), mv)
    faults = sum(map(bool, history.reason))
    if faults:
        lines.append(f"{faults} scans with a fault, the last one: {next(r for r in reversed(history.reason) if r)}")
    return "\n".join(lines)


def _follows(history: History, s: Signal) -> NDArray[np.bool_]:
    """Scans (n,) at which a PV follows its set point: all of them, unless operators let it go."""
    found = np.ones(len(history.sp), dtype=bool)
    for what in ("use", "track"):
        course = history.of_entry(f"{s.name}.{what}")
        if course is not None:
            found &= course > 0
    return found


def _travel(mv: Array, history: History, i: int) -> float:
    """Travel of an MV (n,), with its first move where it is known from where."""
    return mv_travel(mv if history.mv0 is None else np.concatenate([history.mv0[i : i + 1], mv]))


def _jammed(plant: Simulator, error: Array, mv: Array) -> list[str]:
    """A line on MVs (n, n_mv) that rest at an end of their range while an error (n, n_cv) stays; else none."""
    late = len(mv) // STAYING_PART + 1
    spans = np.array([s.high - s.low for s in plant.sp_signals])
    if not np.any(np.abs(error[-late:].mean(axis=0)) > STAYING_ERROR * spans):
        return []
    ends = [
        f"{s.name} at {end:g}" + ("" if s.unit == "-" else f" {s.unit}")
        for s, values in zip(plant.mv_signals, mv[-late:].T, strict=True)
        for end in (s.low, s.high)
        if s.values is None and np.all(np.abs(values - end) <= RESTING_AT_END * (s.high - s.low))
    ]
    if not ends:
        return []
    return [f"an error stays with {' and '.join(ends)}, an end of its range: these set points may be out of reach"]


def write_csv(path: Path, plant: Simulator, history: History) -> None:
    """One row a sample, columns ``NAME [unit]``; PipelineError where the file cannot be written."""
    header = ["time_s", "mode"]
    header += [f"SP {s.name} [{s.unit}]" for s in plant.sp_signals]
    header += [f"{s.name} [{s.unit}]" for s in plant.pv_signals]
    header += [f"measured {s.name} [{s.unit}]" for s in plant.pv_signals]
    header += [*(f"{s.name} [{s.unit}]" for s in plant.mv_signals), "reason"]

    def write(draft: Path) -> None:
        with draft.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            for i, time_s in enumerate(history.time_s):
                numbers = np.concatenate([history.sp[i], history.pv[i], history.measured[i], history.mv[i]])
                writer.writerow([f"{time_s:.9g}", history.mode[i], *(f"{v:.9g}" for v in numbers), history.reason[i]])

    _replace(path, write)


def draw(
    path: Path, plant: Simulator, history: History, title: str, marks: Mapping[float, str], dpi: float = RUN_DPI
) -> None:
    """Controlled variables with their set points, MVs, events and modes; PipelineError where it cannot be written.

    It shows ranges and operators' limits as bands, resting values, and what is out of use, of a law with ``operate``.
    """
    figure = drawn(plant, history, title, marks)
    _replace(path, lambda draft: figure.savefig(draft, format=path.suffix.lstrip(".") or "png", dpi=dpi))


def drawn(plant: Simulator, history: History, title: str, marks: Mapping[float, str]) -> Figure:
    """The picture that ``draw`` writes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    time_s = np.array(history.time_s)
    sp, pv, mv = np.array(history.sp), np.array(history.pv), np.array(history.mv)
    shown = [(i, s) for i, s in enumerate(plant.pv_signals) if i < sp.shape[1] or _ranged(history, s).any()]
    heights = [1.0] * len(shown) + [1.0 if s.values is None else DISCRETE_SHARE for s in plant.mv_signals]
    figure = Figure(figsize=(9, 1.0 + 2.4 * sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    figure.suptitle(title)
    for ax, (i, s) in zip(axes, shown, strict=False):
        if i < sp.shape[1]:
            followed = np.where(_follows(history, s), sp[:, i], np.nan)
            ax.step(time_s, followed, where="post", color="0.35", linestyle="--", linewidth=1, label="set point")
        ax.plot(time_s, pv[:, i], color="C0", linewidth=1.3, label="controlled variable")
        ax.set_ylabel(_label(s))
        _draw_range(ax, history, s)
    for i, s in enumerate(plant.mv_signals):
        ax = axes[len(shown) + i]
        ax.step(time_s, mv[:, i], where="post", color="C3", linewidth=1)
        ax.set_ylabel(_label(s))
        if s.values is not None:
            room = 0.3 * (s.high - s.low)
            ax.set_yticks(s.values, [f"{v:g}" for v in s.values])
            ax.set_ylim(s.low - room, s.high + room)
        _draw_range(ax, history, s)
        _draw_rest(ax, history, s)
    for ax in axes:
        ax.grid(alpha=0.3)
        for at in marks:
            ax.axvline(at, color="C1", linestyle=":", linewidth=1)
        for mode, color in (("MANUAL", "gold"), ("HOLD", "red")):
            inside = np.array([m == mode for m in history.mode])
            if inside.any():
                ax.fill_between(
                    time_s, 0, 1, where=inside, step="post", color=color, alpha=0.15,
                    transform=ax.get_xaxis_transform(), label=mode,
                )  # fmt: skip
    for k, (at, text) in enumerate(sorted(marks.items())):
        # Above the panel, in two rows by turns: on the curves, or beside its neighbour, a text cannot be read.
        axes[0].annotate(
            text, (at, 1), xycoords=("data", "axes fraction"), xytext=(0, 3 + 9 * (k % 2)), textcoords="offset points",
            va="bottom", fontsize="x-small", color="C1",
        )  # fmt: skip
    named = {text: handle for ax in axes for handle, text in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(
        named.values(), named, loc="outside lower center", ncols=min(len(named), 4), fontsize="small", frameon=False
    )
    axes[-1].set_xlabel("time [s]")
    return figure


def _ranged(history: History, s: Signal) -> NDArray[np.bool_]:
    """Scans (n,) at which operators have a signal in use within less than its own range."""
    low, high, used = (history.of_entry(f"{s.name}.{what}") for what in ("low", "high", "use"))
    if low is None or high is None or used is None:
        return np.zeros(len(history.sp), dtype=np.bool_)
    return (used > 0) & ((low > s.low) | (high < s.high))


def _draw_range(ax: Axes, history: History, s: Signal) -> None:
    """The range of a PV or operators' limits of an MV as a band, where there are any, and the time out of use."""
    from loopwright.pipeline.pictures.operated_pictures import IN_RANGE, OUT_OF_USE

    ranged, used = _ranged(history, s), history.of_entry(f"{s.name}.use")
    if ranged.any():
        low, high = (np.asarray(history.of_entry(f"{s.name}.{what}")) for what in ("low", "high"))
        ax.fill_between(history.time_s, low, high, where=ranged, step="post", zorder=1, label="range", **IN_RANGE)
    if used is not None and not used.all():
        ax.fill_between(
            history.time_s, 0, 1, where=used == 0, step="post", transform=ax.get_xaxis_transform(),
            label="out of use", **OUT_OF_USE,
        )  # fmt: skip


def _draw_rest(ax: Axes, history: History, s: Signal) -> None:
    """The resting value of an MV while it has one."""
    from loopwright.pipeline.pictures.operated_pictures import RESTING

    rest, used = (history.of_entry(f"{s.name}.{what}") for what in ("rest", "rest_use"))
    if rest is not None and used is not None and used.any():
        ax.step(history.time_s, np.where(used > 0, rest, np.nan), where="post", label="resting value", **RESTING)


def _label(signal: Signal) -> str:
    return signal.name if signal.unit == "-" else f"{signal.name} [{signal.unit.replace('deg', '°')}]"


def _replace(path: Path, write: Callable[[Path], None]) -> None:
    """Write a file whole or not at all; PipelineError where it cannot be written."""
    try:
        with draft_of(path) as draft:
            write(draft)
    except (OSError, ValueError) as error:
        raise PipelineError(f"{path} cannot be written: {' '.join(str(error).split())}") from error


def fewer_colours(picture: bytes) -> bytes:
    """A PNG in FEW_COLOURS colours, in a third of its bytes: for a page or a notebook that holds it within.

    Maximum coverage keeps the colours of thin lines and small patches; the usual median cut mixes them.
    """
    few = (
        Image.open(io.BytesIO(picture))
        .convert("RGB")
        .quantize(FEW_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    )
    buffer = io.BytesIO()
    few.save(buffer, format="png", optimize=True)
    return buffer.getvalue()
