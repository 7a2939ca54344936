"""The replay of a law over a record drawn: what it would have asked beside what was done."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.pictures.drawing import (
    SET_POINT,
    SIZE,
    colour_of,
    fit_labels,
    legend_below,
    signal_label,
    time_axis,
)
from loopwright.pipeline.pictures.words import law_name

DONE = "#56b4e9"  # neither the baseline's grey nor the first law's colour
MOST = 600  # rows: more cannot be told apart
CV_HEIGHT, MV_HEIGHT, ROOM = 1.7, 1.9, 1.0  # inches


def replay_picture(evidence: Evidence, law: str) -> Canvas:
    """Each controlled variable with what the law was given as its set point, each MV as asked and as done."""
    loop = evidence.laws[law].replay()
    if not loop:
        raise NotMeasuredError
    plant = evidence.case.plant_class
    cvs, mvs = plant.sp_signals, plant.mv_signals
    heights = [CV_HEIGHT] * len(cvs) + [MV_HEIGHT] * len(mvs)
    canvas = Canvas(figsize=(SIZE[0], ROOM + sum(heights)), layout="constrained")
    panels = list(np.atleast_1d(canvas.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights})))
    rows = {name: values[-MOST:] for name, values in loop.items()}
    time, words = time_axis(rows["time_s"])
    for i, (axes, signal) in enumerate(zip(panels, cvs, strict=False)):
        axes.plot(time, rows["pv"][:, i], color="black", linewidth=0.9, label="recorded")
        axes.plot(time, rows["sp"][:, i], label="set point of the replay: where the operation went", **SET_POINT)
        axes.set_ylabel(signal_label(signal))
    colour = colour_of(law, evidence.laws, evidence.case.baseline)
    for i, (axes, signal) in enumerate(zip(panels[len(cvs) :], mvs, strict=True)):
        axes.step(time, rows["done"][:, i], where="post", color=DONE, linewidth=1.6, label="done")
        axes.step(time, rows["asked"][:, i], where="post", color=colour, linewidth=1.0, label="asked by the law")
        axes.set_ylabel(signal_label(signal))
    panels[0].set_title(f"{law_name(law)} over the record, nothing fed back")
    panels[-1].set_xlabel(f"{words}, counted over the rows shown; gaps of the record are closed")
    panels[-1].margins(x=0.01)
    canvas.align_ylabels(panels)
    found = [axes.get_legend_handles_labels() for axes in (panels[0], panels[-1])]
    legend_below(canvas, [h for row, _ in found for h in row], [text for _, row in found for text in row], most=2)
    fit_labels(canvas)
    return canvas
