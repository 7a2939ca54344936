"""One step ahead and running free: a plant network's two errors beside each other, as a picture and as checks."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure as Canvas

from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.verdicts import Check, Verdict
from pipeline.pictures.drawing import PALETTE, SIZE, clear_legend, scale
from pipeline.pictures.words import number

TRAINED = {"one_step_trained": ("one step", "s"), "free_run_trained": ("free runs", "o")}
"""Of the metrics of a part: what the network was trained on last, and its mark."""
NETWORKS = {"nnarx": ("NNARX", PALETTE[0]), "state_space": ("state space", PALETTE[1])}

Figures = dict[str, list[float]]  # one_step_rmse, free_run_rmse, free_run_fit -> one value a data seed


def free_run_figures(evidence: Evidence, model_set: str, kind: str, trained: str, pv: str) -> Figures:
    """What the fits of ``kind`` measured of one PV over the data seeds; empty where there is none."""
    parts = (evidence.models.get(model_set, {}).get("parts") or {}).values()
    rows = [row for part in parts for row in (part.get("per_seed") or {}).values()]
    found = [row[kind][trained][pv] for row in rows if pv in ((row.get(kind) or {}).get(trained) or {})]
    return {key: [float(row[key]) for row in found] for key in found[0]} if found else {}


def free_run_picture(model_set: str, pv: str, unit: str) -> Callable[[Evidence], Canvas | None]:
    """Error one step ahead against error running free, a point a data seed; a line joins a network's two trainings."""

    def draw(evidence: Evidence) -> Canvas | None:
        known = {
            kind: {t: f for t in TRAINED if (f := free_run_figures(evidence, model_set, kind, t, pv))}
            for kind in NETWORKS
        }
        if not any(known.values()):
            return None
        canvas = Canvas(figsize=(SIZE[0], 4.4), layout="constrained")
        axes = canvas.subplots()
        for kind, stages in known.items():
            name, colour = NETWORKS[kind]
            for trained, found in stages.items():
                words, mark = TRAINED[trained]
                x, y = found["one_step_rmse"], found["free_run_rmse"]
                label = f"{name}, trained on {words}: fit {statistics.median(found['free_run_fit']):.2f} %"
                axes.plot(x, y, mark, color=colour, fillstyle="full" if mark == "o" else "none", label=label, zorder=3)
            for first, then in pairwise(stages.values()):
                for key in range(len(first["one_step_rmse"])):
                    ends = [(run["one_step_rmse"][key], run["free_run_rmse"][key]) for run in (first, then)]
                    axes.plot(*zip(*ends, strict=True), color=colour, linewidth=0.8, alpha=0.6, zorder=2)
        for axis, metric in ((axes.xaxis, "one_step_rmse"), (axes.yaxis, "free_run_rmse")):
            scale(axis, np.array([v for stages in known.values() for found in stages.values() for v in found[metric]]))
        axes.set_xlabel(f"RMSE one step ahead [{unit}]")
        axes.set_ylabel(f"RMSE running free [{unit}]")
        clear_legend(axes, title="median fit of the free run")
        return canvas

    return draw


def free_run_fit_at_least(limit: float, model_set: str, kind: str, *pvs: str) -> Check:
    """A check that the kept network's long free run fits to ``limit`` [%] in every named PV, for every data seed."""

    def check(evidence: Evidence) -> Verdict:
        kept = [free_run_figures(evidence, model_set, kind, "free_run_trained", pv) for pv in pvs]
        what, least = f"free-run fit of the {NETWORKS[kind][0]} network", f"at least {limit:g} % of {' and '.join(pvs)}"
        if not all(kept):
            return Verdict(what, least, "not measured", None)
        worst = [min(found["free_run_fit"]) for found in kept]
        shown = ", ".join(f"{pv} {fit:.2f} %" for pv, fit in zip(pvs, worst, strict=True))
        return Verdict(what, f"{least}, whatever the data seed", shown, min(worst) >= limit)

    return check


def one_step_says_little(model_set: str, kind: str, pv: str, unit: str) -> Check:
    """A check that of a network's two trainings the one more accurate one step ahead runs free the worse."""

    def check(evidence: Evidence) -> Verdict:
        first, then = (free_run_figures(evidence, model_set, kind, trained, pv) for trained in TRAINED)
        what = f"one-step accuracy says little ({NETWORKS[kind][0]} network)"
        limit = "trained on free runs: a larger error one step ahead, a smaller one running free (medians)"
        if not (first and then):
            return Verdict(what, limit, "not measured", None)
        near, far = (
            [statistics.median(run[key]) for run in (first, then)] for key in ("one_step_rmse", "free_run_fit")
        )
        shown = (
            f"one step ahead {number(near[0])}, then {number(near[1])} {unit}; "
            f"free-run fit {far[0]:.1f} %, then {far[1]:.1f} %"
        )
        return Verdict(what, limit, shown, near[1] > near[0] and far[1] > far[0])

    return check
