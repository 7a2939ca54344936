"""Ours with each quadratic problem solved to its end, in place of two changes: what the solver costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from figures import Figures, figures_of, run_day
from from_record import Fit, Served, controller_of, law_of
from operated_plant import OperatedPlant

from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving import Controller

CHANGES = 60  # of what lies at a bound: all that a day of these plants asks for, and more


class Solved(Served):
    """The law itself through a day, its problems solved to their end."""

    def __init__(self, controller: Controller, law: Predictive, passes: int) -> None:
        super().__init__(controller)
        self.law = law
        assert law.planner.bounded is not None  # a law with `operate`
        law.planner.passes, law.planner.bounded.changes = passes, CHANGES

    def __call__(self, sp: Array, pv: Array, dv: Array, mv: Array, fresh: Array) -> Array:
        """The MVs until the next sample."""
        first = np.ones_like(fresh) if not self.state.any() else fresh
        given = (sp, pv, dv, mv, self.state, self.operate, first)
        with torch.no_grad():
            answer, state, *_ = self.law(*(torch.from_numpy(np.asarray(v, dtype=np.float64)) for v in given))
        self.state = state.numpy()
        return np.asarray(answer.numpy(), dtype=np.float64)


def solved_figures(
    plant: OperatedPlant, fit: Fit, seeds: Sequence[int], samples: int, passes: Sequence[int]
) -> dict[str, Figures]:
    """Figures of the file as it is shipped, and of the law with so many passes, each solved to its end."""
    model, _ = fit.model(plant)
    law = law_of(plant, model)
    controller = controller_of(plant, law)
    days = [plant.day(seed, samples) for seed in seeds]
    found = {"file": figures_of(plant, days, [run_day(plant, Served(controller), day) for day in days])}
    for count in passes:
        runs = [run_day(plant, Solved(controller, law, count), day) for day in days]
        found[f"{count} passes"] = figures_of(plant, days, runs)
    return found


def solved_rows(plant: OperatedPlant, fit: Fit, seeds: Sequence[int], samples: int) -> str:
    """The figures of one plant in words, a line a solver."""
    rows = []
    for name, f in solved_figures(plant, fit, seeds, samples, (2, 4)).items():
        rows.append(
            f"{plant.name:12} {name:9} error {f.error:6.3f} %  in range {f.inside:5.1f} %  beyond {f.beyond:.4f} %"
            f"  profit {f.profit:9.2f} an hour  travel {f.travel:5.2f} %"
        )
    return "\n".join(rows)
