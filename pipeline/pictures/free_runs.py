"""One step ahead and running free: a plant network's two errors beside each other, as a picture and as checks."""

from __future__ import annotations

import statistics
from contextlib import suppress
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.verdicts import Check, CheckOutcome
from loopwright.pipeline.pictures.drawing import PALETTE, PICTURE_SIZE, Draw, clear_legend, scale
from loopwright.pipeline.pictures.numbers import number

TRAINED = {"one_step_trained": ("one step", "s"), "free_run_trained": ("free runs", "o")}
"""Metrics of a part: the objective of the network's last training, and its mark."""
NETWORKS = {"nnarx": ("NNARX", PALETTE[0]), "state_space": ("state space", PALETTE[1])}

Figures = dict[str, list[float]]  # one_step_rmse, free_run_rmse, free_run_fit -> one value a data seed


def free_run_figures(evidence: Evidence, model_set: str, kind: str, trained: str, pv: str) -> Figures:
    """Figures of one PV over the data seeds, from fits of ``kind``; raises NotMeasuredError without any."""
    parts = (evidence.models.get(model_set, {}).get("parts") or {}).values()
    rows = [row for part in parts for row in (part.get("per_seed") or {}).values()]
    found = [row[kind][trained][pv] for row in rows if pv in ((row.get(kind) or {}).get(trained) or {})]
    if not found:
        raise NotMeasuredError
    return {key: [float(row[key]) for row in found] for key in found[0]}


def free_run_picture(model_set: str, pv: str, unit: str) -> Draw:
    """Error one step ahead against error running free, a point a data seed; a line joins a network's two trainings."""

    def draw(evidence: Evidence) -> Canvas:
        canvas = Canvas(figsize=(PICTURE_SIZE[0], 4.4), layout="constrained")
        axes = canvas.subplots()
        known: list[Figures] = []
        for kind, (name, colour) in NETWORKS.items():
            stages: list[Figures] = []
            for trained, (words, mark) in TRAINED.items():
                with suppress(NotMeasuredError):
                    found = free_run_figures(evidence, model_set, kind, trained, pv)
                    stages.append(found)
                    label = f"{name}, trained on {words}: fit {statistics.median(found['free_run_fit']):.2f} %"
                    style: Any = {"color": colour, "fillstyle": "full" if mark == "o" else "none", "zorder": 3}
                    axes.plot(found["one_step_rmse"], found["free_run_rmse"], mark, label=label, **style)
            for first, then in pairwise(stages):
                for key in range(len(first["one_step_rmse"])):
                    ends = [(run["one_step_rmse"][key], run["free_run_rmse"][key]) for run in (first, then)]
                    axes.plot(*zip(*ends, strict=True), color=colour, linewidth=0.8, alpha=0.6, zorder=2)
            known += stages
        if not known:
            raise NotMeasuredError
        for axis, metric in ((axes.xaxis, "one_step_rmse"), (axes.yaxis, "free_run_rmse")):
            scale(axis, np.array([v for found in known for v in found[metric]]))
        axes.set_xlabel(f"RMSE one step ahead [{unit}]")
        axes.set_ylabel(f"RMSE running free [{unit}]")
        clear_legend(axes, title="median fit of the free run")
        return canvas

    return draw


def free_run_fit_at_least(limit: float, model_set: str, kind: str, *pvs: str) -> Check:
    """A check that the kept network's long free run fits to ``limit`` [%] in every named PV, for every data seed."""

    def measure(evidence: Evidence) -> CheckOutcome:
        kept = {pv: free_run_figures(evidence, model_set, kind, "free_run_trained", pv) for pv in pvs}
        worst = {pv: min(found["free_run_fit"]) for pv, found in kept.items()}
        return CheckOutcome(", ".join(f"{pv} {fit:.2f} %" for pv, fit in worst.items()), min(worst.values()) >= limit)

    what = f"free-run fit of the {NETWORKS[kind][0]} network"
    return Check(what, measure, f"at least {limit:g} % of {' and '.join(pvs)}, whatever the data seed")


def one_step_says_little(model_set: str, kind: str, pv: str, unit: str, evidence: Evidence) -> CheckOutcome:
    """Whether of a network's two trainings the one more accurate one step ahead runs free the worse."""
    runs = [free_run_figures(evidence, model_set, kind, trained, pv) for trained in TRAINED]
    near, far = ([statistics.median(run[key]) for run in runs] for key in ("one_step_rmse", "free_run_fit"))
    shown = (
        f"one step ahead {number(near[0])}, then {number(near[1])} {unit}; "
        f"free-run fit {far[0]:.1f} %, then {far[1]:.1f} %"
    )
    limit = "trained on free runs: a larger error one step ahead, a smaller one running free (medians)"
    return CheckOutcome(shown, near[1] > near[0] and far[1] > far[0], limit)
