"""A picture of one day of a plant: PVs with set points and ranges, MVs with limits, by controller."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from contest import Contest
from matplotlib.figure import Figure
from operated_plant import PERIOD_S, Day

COLOURS = {"ours": "tab:blue", "PID": "tab:orange", "NMPC": "0.4"}


def drawn(contest: Contest, day: Day, path: Path) -> None:
    """Write the picture."""
    plant, hours = contest.plant, np.arange(len(day.sp)) * PERIOD_S / 3600
    n = max(len(plant.pv), len(plant.mv))
    figure = Figure(figsize=(11, 2.1 * n), layout="constrained")
    axes = figure.subplots(n, 2, sharex=True, squeeze=False)
    for i, s in enumerate(plant.pv):
        axis = axes[i, 0]
        for name, run in contest.first.items():
            axis.plot(hours, run.pv[:, i], color=COLOURS[name], lw=0.9, label=name)
        if plant.tracked(i):
            axis.plot(hours, day.sp[:, i], color="k", lw=0.8, ls="--", label="set point")
        for end in set(plant.range_of(i)) - {s.low, s.high}:
            axis.axhline(end, color="tab:red", lw=0.8, ls=":")
        axis.set_ylabel(f"{s.name} [{s.unit}]")
    for i, s in enumerate(plant.mv):
        axis = axes[i, 1]
        for name, run in contest.first.items():
            axis.step(hours, run.mv[:, i], where="post", color=COLOURS[name], lw=0.9)
        for end in {end[i] for end in plant.mv_ends()} - {s.low, s.high}:
            axis.axhline(end, color="tab:red", lw=0.8, ls=":")
        axis.set_ylabel(f"{s.name} [{s.unit}]")
    for column, signals in enumerate((plant.pv, plant.mv)):
        for i in range(len(signals), n):
            axes[i, column].set_visible(False)
        last = axes[len(signals) - 1, column]
        last.set_xlabel("time [h]")
        last.tick_params(labelbottom=True)
    axes[0, 0].legend(loc="upper right", ncols=4, fontsize="small", frameon=False)
    axes[0, 0].set_title(plant.title, loc="left", fontsize="medium")
    figure.savefig(path)
