"""Identified models drawn: step responses with bands, local gains over the range, free run and its residual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Array
from loopwright.pipeline.evaluation.model_evidence import identified_part
from loopwright.pipeline.pictures.drawing import (
    PALETTE,
    PICTURE_SIZE,
    axis_label,
    fit_labels,
    gain_unit,
    legend_below,
    signal_label,
    symbol,
    time_axis,
)
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.simulation.rests import local_gains
from loopwright.serving.manifest import Signal

LAW, OTHER = PALETTE[1], "#8fb8d6"
GRID_PANEL, WIDEST, LOWEST = (2.9, 1.9), 13.0, 3.2  # inches
AXIS_FONT = 8.0  # points of the numbers at the axes of a grid of panels
GAIN_QUANTILES = (0.1, 0.9)  # of a record's MV: over them the gains are taken, as in the report's table
DRAWN_GAINS = 7  # values of an MV at which a gain is drawn
DRAWN_LAGS = 40  # [samples] largest lag of the residual's correlation with itself that is drawn
HISTOGRAM_TICKS, PLAIN_POWERS = 4, (-2, 4)  # intervals at most; powers of ten between which numbers are written out
WHITE_SDS = 2.58  # standard deviations of a white residual's correlation that 99 % stay within
DRAWN_SAMPLES = 800  # samples of a free run
IN_TABLE = "gain at the middle ± standard deviation, as in the table"
SIGNS = {"+": "rises with", "-": "falls with", "uncertain": "may rise or fall with"}


def _grid(rows: int, columns: int, **shared: Any) -> tuple[Canvas, list[list[Axes]]]:
    width = float(np.clip(columns * GRID_PANEL[0], PICTURE_SIZE[0], WIDEST))
    canvas = Canvas(figsize=(width, max(rows * GRID_PANEL[1] + 1.0, LOWEST)), layout="constrained")
    panels = [list(row) for row in canvas.subplots(rows, columns, squeeze=False, **shared)]
    if columns > 1:
        for axes in (a for row in panels for a in row):
            axes.tick_params(labelsize=AXIS_FONT)
    return canvas, panels


def step_responses_picture(evidence: Evidence) -> Canvas:
    """Answer of each controlled variable to a step of one unit of each input, with the band of all good fits."""
    responses = identified_part(evidence.models).get("step_responses")
    answers: Mapping[str, Any] = identified_part(evidence.models).get("first_answers") or {}
    if not responses:
        raise NotMeasuredError
    plant = evidence.case.plant_class
    inputs, cvs = (*plant.mv_signals, *plant.dv_signals), [s for s in plant.sp_signals if s.name in responses]
    canvas, panels = _grid(len(cvs), len(inputs), sharex=True)
    titles = []
    for row, cv in zip(panels, cvs, strict=True):
        for axes, signal in zip(row, inputs, strict=True):
            found = responses[cv.name][signal.name]
            # A response begins at 0 where the input moves, and is 0 up to the period before its first point.
            periods = [0, found["periods"][0] - 1, *found["periods"]]
            time, words = time_axis(plant.period_s * np.array(periods, dtype=np.float64))
            middle, low, high = (np.array([0.0, 0.0, *found[key]]) for key in ("middle", "low", "high"))
            axes.fill_between(time, low, high, color=LAW, alpha=0.25, linewidth=0, label="band of all good fits")
            axes.plot(time, middle, color=LAW, linewidth=1.4, label="their middle")
            axes.axhline(0.0, color="#888888", linewidth=0.7)
            axes.set_ylim(*_heights(middle, low, high))
            waits = (((answers.get(cv.name) or {}).get(signal.name) or 1) - 1) * plant.period_s
            if waits:
                axes.axvline(time[-1] * waits / (plant.period_s * found["periods"][-1]), color=PALETTE[0],
                             linewidth=0.9, linestyle=":", label="dead time")  # fmt: skip
            if row is panels[0]:
                titles.append(axes.set_title(f"{symbol(signal.name)}\nstep by {_one(signal)}", fontsize=9.5))
            if row is panels[-1]:
                axes.set_xlabel(words)
            axes.margins(x=0.01)
        row[0].set_ylabel(signal_label(cv))
    _legend(canvas, panels)
    fit_labels(canvas, titles)
    return canvas


def _heights(middle: Array, low: Array, high: Array) -> tuple[float, float]:
    """Ends of the axis of a response: its band, as far as that is no wider than the response on either side.

    Some likely fits of an integrator run away in the end, and a band of many powers of ten would hide the response.
    """
    room = float(np.ptp(middle)) or float(np.median(high - low)) or 1.0
    bottom, top = max(low.min(), middle.min() - room), min(high.max(), middle.max() + room)
    return bottom - 0.05 * room, top + 0.05 * room


def gains_picture(evidence: Evidence) -> Canvas:
    """Local gain of each controlled variable over the visited range of each MV, of the law's model and the others.

    The gain of the report's table stands with its spread where it belongs, at the median of the MV.
    """
    if evidence.case.replayed is None or not isinstance(evidence.case.plant, IdentifiedPlant):
        raise NotMeasuredError
    plant, record = evidence.case.plant, evidence.case.replayed[0]
    table: Mapping[str, Any] = identified_part(evidence.models).get("gains") or {}
    others = list({id(t.plant): t.plant for tests in evidence.tests.values() for t in tests if t.plant}.values())
    middle, (low, high) = np.median(record.mv, axis=0), np.quantile(record.mv, GAIN_QUANTILES, axis=0)
    canvas, panels = _grid(len(plant.sp_signals), len(plant.mv_signals), sharex="col")
    titles = []
    for j, mv in enumerate(plant.mv_signals):
        places = np.linspace(low[j], high[j], DRAWN_GAINS)
        found = [local_gains(p, j, places, middle, len(plant.sp_signals)) for p in (*others, plant)]
        for i, cv in enumerate(plant.sp_signals):
            axes, rate = panels[i][j], bool(found[-1][1][:, i].any())
            for k, (gain, _) in enumerate(found):
                own = k == len(found) - 1
                look: dict[str, Any] = {"color": LAW if own else OTHER, "linewidth": 1.7 if own else 1.0}
                axes.plot(places, gain[:, i], label="law's model" if own else "models of the tests", **look)
            axes.axhline(0.0, color="#888888", linewidth=0.7)
            of = (table.get(cv.name) or {}).get(mv.name) or {}
            if of and bool(of.get("rate")) == rate:
                mark: dict[str, Any] = {"fmt": "o", "color": PALETTE[0], "markersize": 4, "capsize": 3, "zorder": 5}
                axes.errorbar(middle[j], of["gain"], yerr=of["spread"], label=IN_TABLE, **mark)
            if i == len(panels) - 1:
                axes.set_xlabel(signal_label(mv))
            words = axis_label("gain", gain_unit(cv, mv, rate))
            axes.set_ylabel(words if j else f"{symbol(cv.name)}\n{words}", fontsize=8.5)
            title = f"{SIGNS.get(of.get('sign', ''), 'answers to')} {symbol(mv.name)}"
            titles.append(axes.set_title(title, fontsize=9.0))
    _legend(canvas, panels)
    fit_labels(canvas, titles)
    return canvas


def free_run_picture(evidence: Evidence) -> Canvas:
    """Measurement and free run over rows that the fit never saw, the residual, and its correlation with itself."""
    sets = (evidence.predictions(name) for name in evidence.models)
    arrays = next((found for found in sets if "free run" in found), {})
    if not {"measured", "free run", "time_s"} <= set(arrays):
        raise NotMeasuredError
    measured, run = (np.reshape(arrays[k], (len(arrays["time_s"]), -1)) for k in ("measured", "free run"))
    cvs = evidence.case.plant_class.sp_signals[: measured.shape[1]]
    canvas = Canvas(figsize=(PICTURE_SIZE[0] * 1.15, 0.9 + 3.0 * len(cvs)), layout="constrained")
    panels = canvas.subplots(2 * len(cvs), 2, squeeze=False, width_ratios=(3, 1), height_ratios=(2, 1) * len(cvs))
    rows = (identified_part(evidence.models).get("structure") or {}).get("rows_ahead")
    label = "free run of the model" if rows is None else f"predicted by the model up to {rows} samples ahead"
    for i, cv in enumerate(cvs):
        _free_run_of(panels[2 * i : 2 * i + 2], arrays["time_s"], measured[:, i], run[:, i], cv, label)
    legend_below(canvas, *panels[0][0].get_legend_handles_labels())
    fit_labels(canvas)
    return canvas


def _free_run_of(panels: Any, time_s: Array, measured: Array, run: Array, cv: Signal, label: str) -> None:
    (above, beside), (below, spread) = panels
    time, words = time_axis(time_s[:DRAWN_SAMPLES])
    residual = measured - run
    above.plot(time, measured[:DRAWN_SAMPLES], color="black", linewidth=0.9, label="measured")
    above.plot(time, run[:DRAWN_SAMPLES], color=PALETTE[0], linewidth=1.2, label=label)
    above.set_ylabel(signal_label(cv))
    below.plot(time, residual[:DRAWN_SAMPLES], color=LAW, linewidth=0.8)
    below.set_ylabel(axis_label("residual", cv.unit), fontsize=8.5)
    below.set_xlabel(f"{words}, counted over the rows held out; gaps of the record are closed", fontsize=8.5)
    for axes in (above, below):
        axes.margins(x=0.01)
    known = residual[np.isfinite(residual)]
    if len(known) > 2 * DRAWN_LAGS:
        centred = known - known.mean()
        lags = np.arange(1, DRAWN_LAGS + 1)
        power = max(float(centred @ centred), 1e-300)
        own = [float(centred[lag:] @ centred[:-lag]) / power for lag in lags]
        beside.axhspan(-WHITE_SDS / np.sqrt(len(known)), WHITE_SDS / np.sqrt(len(known)), color="#dddddd", linewidth=0)
        beside.vlines(lags, 0, own, color=LAW, linewidth=1.2)
        beside.set_title("residual with itself", fontsize=9)
        beside.set_xlabel("lag [samples]", fontsize=8.5)
        spread.hist(known, bins=30, color=LAW, alpha=0.6)
        spread.set_xlabel(axis_label("residual", cv.unit), fontsize=8.5)
        spread.set_yticks([])
        spread.locator_params(axis="x", nbins=HISTOGRAM_TICKS)
        spread.ticklabel_format(axis="x", style="sci", scilimits=PLAIN_POWERS)


def _one(signal: Signal) -> str:
    return f"1 {signal.unit.replace('deg', '°')}".strip()


def _legend(canvas: Canvas, panels: Sequence[Sequence[Axes]]) -> None:
    """One entry a label, whichever panel has it."""
    found = {
        text: handle
        for row in panels
        for axes in row
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    legend_below(canvas, list(found.values()), list(found))
