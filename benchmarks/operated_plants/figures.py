"""One loop of a day over a plant, whatever the controller, and its figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from operated_plant import Day, OperatedPlant

from loopwright.pipeline.plants.simulator import Array

HOUR = 20  # samples
WARM_UP = 40  # samples at the start of a day that are not scored: no controller has a past


class DayController(Protocol):
    """What is asked for MVs each sample."""

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs (n_mv,) until the next sample; ``mv`` acted over the last one, ``fresh`` says which PVs are new."""


@dataclass(frozen=True, slots=True)
class Run:
    """Of a day: true PVs (n, n_pv) and MVs (n, n_mv)."""

    pv: Array
    mv: Array


def run_day(plant: OperatedPlant, controller: DayController, day: Day) -> Run:
    """The plant from its rest through a day. A PV that is not fresh shows its last reading."""
    x, mv = plant.start
    pv, mvs = np.empty((len(day.sp), len(plant.pv))), np.empty((len(day.sp), len(plant.mv)))
    shown = plant.look(x)[1]
    low, high = (np.array([getattr(s, end) for s in plant.mv]) for end in ("low", "high"))
    most = np.array([np.inf if s.max_move is None else s.max_move * (1 + 1e-9) + 1e-9 for s in plant.mv])
    for k in range(len(day.sp)):
        pv[k], measured = plant.look(x)
        shown = np.where(day.fresh[k] > 0, measured + day.noise[k], shown)
        wanted = controller(day.sp[k], shown, day.dv[k], mv, day.fresh[k])
        if not ((wanted >= low - 1e-9) & (wanted <= high + 1e-9) & (np.abs(wanted - mv) <= most)).all():
            raise RuntimeError(f"{plant.name}, sample {k}: the controller asks for {wanted} after {mv}")
        mv = mvs[k] = wanted
        x = plant.step(x, mv, day.dv[k], day.w[k])
    return Run(pv, mvs)


@dataclass(frozen=True, slots=True)
class Figures:
    """Of days: see ``figures_of``."""

    error: float  # % of the set points' ranges, mean absolute; NaN without a set point
    inside: float  # % of the samples in which all PVs are within their ranges
    beyond: float  # % of a range's width, mean over all samples and limited PVs
    profit: float  # an hour, by the costs of `operate`
    travel: float  # % of the MVs' range a sample
    rest: float  # % of the range that an MV with a resting value is off it; NaN without one


def figures_of(plant: OperatedPlant, days: list[Day], runs: list[Run]) -> Figures:
    """The figures over all days, each without its warm-up; of true PVs, without noise."""
    errors, inside, beyond, profit, travel, off = [], [], [], [], [], []
    of_pv, of_mv = plant.costs
    reach = np.array([s.high - s.low for s in plant.mv])
    for day, run in zip(days, runs, strict=True):
        pv, mv = run.pv[WARM_UP:], run.mv[WARM_UP:]
        good, over = np.ones(len(pv), dtype=bool), []
        for i, s in enumerate(plant.pv):
            if plant.tracked(i):
                span = plant.sp[i].high - plant.sp[i].low
                errors.append(np.abs(pv[:, i] - day.sp[WARM_UP:, i]) / span)
            low, high = plant.range_of(i)
            if (low, high) != (s.low, s.high):
                outside = np.maximum(low - pv[:, i], 0) + np.maximum(pv[:, i] - high, 0)
                good &= outside <= 0
                over.append(outside / (high - low))
        inside.append(good)
        beyond += over
        profit.append(-(pv @ of_pv + mv @ of_mv))
        travel.append(np.abs(np.diff(mv, axis=0)) / reach)
        for i, s in enumerate(plant.mv):
            if plant.operate.get(f"{s.name}.rest_use"):
                off.append(np.abs(mv[:, i] - plant.operate[f"{s.name}.rest"]) / reach[i])
    mean = [float(np.mean(v)) if v else np.nan for v in (errors, inside, beyond, profit, travel, off)]
    return Figures(100 * mean[0], 100 * mean[1], 100 * mean[2], HOUR * mean[3], 100 * mean[4], 100 * mean[5])
