"""Pictures of a verdict: moves, spectra and coherence of each input, and what else the verdict weighs."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.historian.cleaning.findings import InputReport, RecordJudgement
from loopwright.pipeline.historian.cleaning.record_rows import evenly
from loopwright.pipeline.historian.excitation import (
    ALIKE_INPUTS,
    ENOUGH_MOVES,
    FEEDBACK_SHARE,
    ROWS_A_PARAMETER,
    Spectrum,
    moves_of,
    spectra_of,
)
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.pictures.drawing import PICTURE_SIZE, STYLE

POWER, COHERENCE, BAND, LIMIT = "#0072b2", "#d55e00", "#cccccc", "#882255"
MOST_INPUTS = 6  # inputs that have a picture, and pairs of inputs whose correlation is drawn
ROW = 2.1  # inches
HISTOGRAM_BINS = 20  # of a histogram of moves


def inputs(found: Screened) -> Canvas:
    """A row an input: the sizes of its moves, its spectrum and coherence over the plant's band, the step response."""
    record = evenly(found.record)
    reports = found.report.verdict.inputs[:MOST_INPUTS]
    models = found.models
    spectra = spectra_of(record, models)
    u = np.hstack([record.mv, record.dv])
    with rc_context(STYLE):
        canvas = Canvas(figsize=(PICTURE_SIZE[0] * 1.25, 0.5 + ROW * len(reports)), layout="constrained")
        panels = canvas.subplots(len(reports), 3, squeeze=False)
        for i, (row, report) in enumerate(zip(panels, reports, strict=True)):
            _moves(row[0], report, moves_of(u[:, i], record.run))
            _spectrum(row[1], report, {pv: s[i] for pv, s in spectra.items()}, record.period_s)
            answers = {
                pv: m.step_response(i, 200)
                for pv, m in models.items()
                if m and (report.gain.get(pv) or pv in report.rate)
            }
            _answer(row[2], report, answers, record.period_s)
        return canvas


def _moves(axes: Axes, report: InputReport, sizes: Array) -> None:
    if sizes.size:
        axes.hist(sizes, bins=HISTOGRAM_BINS, color=POWER)
    axes.set_title(f"{report.name}: {report.moves} moves, {ENOUGH_MOVES} wanted", fontsize=8.5, parse_math=False)
    axes.set_xlabel(f"size [{report.unit}]" if report.unit else "size", fontsize=8, parse_math=False)
    axes.tick_params(labelsize=7.5)


def _spectrum(axes: Axes, report: InputReport, spectra: dict[str, Spectrum], period_s: float) -> None:
    axes.set_title("spectrum (line), coherence (dots), plant's band", fontsize=8.5)
    axes.set_xlabel("frequency [1/h]", fontsize=8)
    axes.tick_params(labelsize=7.5)
    axes.set_ylim(0, 1.05)
    if not spectra:
        axes.text(0.5, 0.5, "record too short", ha="center", transform=axes.transAxes, fontsize=8.5)
        return
    best = max(spectra, key=lambda pv: report.coherence.get(pv, 0.0))
    s, per_hour = spectra[best], 3600.0 / period_s
    axes.axvspan(s.band[0] * per_hour, s.band[1] * per_hour, color=BAND, alpha=0.5, linewidth=0)
    axes.semilogx(s.frequency * per_hour, s.power / s.power.max(), color=POWER, linewidth=1.0)
    axes.semilogx(s.frequency * per_hour, s.coherence, ".", color=COHERENCE, markersize=3)


def _answer(axes: Axes, report: InputReport, answers: dict[str, Array], period_s: float) -> None:
    axes.set_title("answer to a unit step, quick model", fontsize=8.5)
    axes.set_xlabel("time after the step [s]", fontsize=8)
    axes.tick_params(labelsize=7.5)
    for pv, answer in answers.items():
        axes.plot(np.arange(len(answer)) * period_s, answer, linewidth=1.0, label=pv)
        if pv in report.first_answer_s:
            axes.axvline(report.first_answer_s[pv], color=LIMIT, linewidth=0.8, linestyle=":")
    if answers:
        axes.axhline(0.0, color="#888888", linewidth=0.6)
        legend = axes.legend(fontsize=7.5, loc="lower right")
        for text in legend.get_texts():
            text.set_parse_math(False)
    else:
        axes.text(0.5, 0.5, "no settled answer", ha="center", transform=axes.transAxes, fontsize=8.5)


def verdict(found: Screened) -> Canvas:
    """Feedback of each MV, correlation of each pair of inputs, rows over parameters; dashed: where doubt begins."""
    v = found.report.verdict
    with rc_context(STYLE):
        canvas = Canvas(figsize=(PICTURE_SIZE[0] * 1.25, 2.6), layout="constrained")
        first, second, third = canvas.subplots(1, 3)
        loops = {f"{i.name} after {pv}": 100 * s for i in v.inputs for pv, s in i.follows.items()}
        _bars(first, loops, 100 * FEEDBACK_SHARE, "feedback: share of moves\nthat a PV's past explains [%]", 100.0)
        pairs = dict(sorted(v.correlation.items(), key=lambda p: -abs(p[1]))[:MOST_INPUTS])
        _bars(second, {k: abs(r) for k, r in pairs.items()}, ALIKE_INPUTS, "correlation of two inputs", 1.0)
        rows = {"rows a parameter": v.rows / max(v.parameters, 1)}
        _bars(third, rows, ROWS_A_PARAMETER, _rows_title(v), None)
        return canvas


def _rows_title(v: RecordJudgement) -> str:
    return f"{v.rows} rows, {v.parameters} parameters\nof a plain linear model"


def _bars(axes: Axes, values: dict[str, float], limit: float, title: str, most: float | None) -> None:
    axes.set_title(title, fontsize=8.5)
    axes.tick_params(labelsize=7.5)
    if not values:
        axes.text(0.5, 0.5, "none", ha="center", transform=axes.transAxes, fontsize=8.5)
        axes.set_yticks([])
        return
    axes.barh(range(len(values)), list(values.values()), color=POWER, height=0.6)
    axes.set_yticks(range(len(values)), list(values), parse_math=False)
    axes.invert_yaxis()
    axes.axvline(limit, color=LIMIT, linewidth=1.0, linestyle="--")
    axes.set_xlim(0, most if most is not None else max(*values.values(), 1.3 * limit) * 1.05)
    axes.grid(axis="y", visible=False)
