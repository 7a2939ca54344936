"""Who gives way where ranges are at odds, and how far MVs jump at changes of ``operate``, on exported files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from figures import Run, run_day
from from_record import Fit, Served, controller_of, law_of, params_of
from operated_plant import Day, OperatedPlant

from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Array
from loopwright.serving import Controller
from loopwright.serving.errors import ContractError
from loopwright.serving.operating import Operate

QUIET = 600  # samples without noise until all rests
CHANGES = 60  # random changes, drawn by seed 0
CONVERGED = {"passes": 12, "changes": 40}  # of the law's own problem: what the new optimum asks


@dataclass(frozen=True, slots=True)
class AtOdds:
    """Two ends of ranges that no MVs keep together, with what makes it so; ``first`` and ``second`` are PVs.

    The furnace's oxygen ranks before both: with an outlet that ranks first a plan which keeps it burns all oxygen.
    """

    first: str
    second: str
    values: Mapping[str, float]


AT_ODDS = {
    "column": AtOdds("AB", "PD", {"AT.track": 0.0, "AB.high": 1.2, "PD.high": 30.0, "reflux.low": 45.0}),
    "furnace": AtOdds("TO", "TS", {"TO.track": 0.0, "TO.low": 380.0, "TS.high": 490.0, "O2.rank": 1.0}),
    "exchanger": AtOdds("TM", "TS", {"TM.track": 0.0, "TM.low": 80.0, "TS.high": 105.0}),
}


def quiet_day(plant: OperatedPlant, samples: int) -> Day:
    """A day on which nothing happens."""
    return Day(
        np.tile(plant.sp0, (samples, 1)),
        np.tile(plant.dv0, (samples, 1)),
        np.tile(plant.w0, (samples, 1)),
        np.zeros((samples, len(plant.pv))),
        plant.day(0, samples).fresh,
    )


def violation(plant: OperatedPlant, values: Mapping[str, float], pv: str, run: Run) -> float:
    """What lies outside a range in the last quarter of a run, in the mean, in shares of the signal's range."""
    i = next(i for i, s in enumerate(plant.pv) if s.name == pv)
    low, high = (values.get(f"{pv}.{end}", getattr(plant.pv[i], end)) for end in ("low", "high"))
    y = run.pv[-len(run.pv) // 4 :, i]
    outside = np.maximum(low - y, 0) + np.maximum(y - high, 0)
    return float(outside.mean() / (plant.pv[i].high - plant.pv[i].low))


def shares(plant: OperatedPlant, controller: Controller, odds: AtOdds) -> tuple[float, float]:
    """Share [%] of the violation with the lower rank, with ``first`` ranked higher and with ``second``."""
    found = []
    for high, low in ((odds.first, odds.second), (odds.second, odds.first)):
        values = {**odds.values, f"{high}.rank": 2.0, f"{low}.rank": 4.0}
        served = Served(controller)
        served.operate = Operate(controller.manifest.operate).with_values(values)
        run = run_day(plant, served, quiet_day(plant, QUIET))
        kept, given = (violation(plant, values, pv, run) for pv in (high, low))
        found.append(100 * given / max(given + kept, 1e-12))
    return found[0], found[1]


class AtRest:
    """A file at rest under its own ``operate``: what it does at the next sample under another one."""

    def __init__(self, plant: OperatedPlant, controller: Controller) -> None:
        self.plant, self.controller, self.day = plant, controller, quiet_day(plant, QUIET)
        self.operate = Operate(controller.manifest.operate)
        served = Served(controller)
        run = run_day(plant, served, self.day)
        self.state, self.mv = served.state, run.mv[-1]
        self.pv, self.reach = run.pv[-1], np.array([s.high - s.low for s in plant.mv])

    def mvs(self, *changes: Mapping[str, float]) -> Array:
        """The MVs after as many samples as ``changes``, one ``operate`` each, the PVs staying as they are."""
        state, mv = self.state, self.mv
        for values in changes:
            step = self.controller.step(
                sp=self.day.sp[-1], pv=self.pv, dv=self.day.dv[-1], mv_applied=mv, state=state,
                operate=self.operate.with_values(values), fresh=np.ones(len(self.pv)),
            )  # fmt: skip
            state, mv = step.state, np.asarray(step.mv)
        return mv

    def optimum(self, law: Predictive, values: Mapping[str, float]) -> Array:
        """What a solver that comes to its end asks for at the next sample."""
        given = (self.day.sp[-1], self.pv, self.day.dv[-1], self.mv, self.state, self.operate.with_values(values))
        with torch.no_grad():
            mv, *_ = law(*(torch.from_numpy(np.asarray(v)) for v in given), torch.ones(len(self.pv)).double())
        return mv.numpy()

    def off(self, found: Array, wanted: Array) -> float:
        """Largest difference in shares of the MVs' ranges."""
        return float((np.abs(found - wanted) / self.reach).max())


def bumps(plant: OperatedPlant, controller: Controller, law: Predictive, model: Identified) -> dict[str, float]:
    """Differences of MVs, in shares of their ranges, by kind of change."""
    rest = AtRest(plant, controller)
    same = rest.mvs({})
    here = dict(zip(rest.operate.places, rest.operate.default, strict=True))
    wide = {
        f"{s.name}.{end}": getattr(s, end) + by * 0.001 * (s.high - s.low)
        for i, s in enumerate(plant.pv)
        for end, by in (("low", 1), ("high", -1))
        if plant.range_of(i)[end == "high"] == getattr(s, end)
    }
    found = {
        "moves by itself": rest.off(same, rest.mv),
        "same value": rest.off(rest.mvs(here), same),
        "range nothing is near": max(rest.off(rest.mvs({n: v}), same) for n, v in wide.items()),
        "use off and on": max(
            rest.off(rest.mvs({f"{s.name}.use": 0.0}, {}), rest.mvs({}, {})) for s in plant.mv
        ),
    }  # fmt: skip
    best = Predictive(law.signals, model, replace(params_of(plant), **CONVERGED)).eval()
    beyond = 0.0
    for values in random_changes(rest, CHANGES):
        asked, move = rest.optimum(best, values) - rest.mv, rest.mvs(values) - rest.mv
        over = np.where(asked >= 0, move - np.maximum(asked, 0), np.minimum(asked, 0) - move)
        beyond = max(beyond, float((over / rest.reach).max()))
    return found | {"beyond the new optimum": beyond}


def random_changes(rest: AtRest, count: int) -> list[dict[str, float]]:
    """One entry each, anywhere in its engineered range where the pair of ends allows it."""
    rng, found = np.random.default_rng(0), []
    while len(found) < count:
        e = rest.operate.entries[rng.integers(len(rest.operate.entries))]
        values = {
            e.name: float(rng.integers(2)) if e.what in ("use", "track", "rest_use") else rng.uniform(e.low, e.high)
        }
        if e.low < e.high and _allowed(rest.operate, values):
            found.append(values)
    return found


def _allowed(operate: Operate, values: Mapping[str, float]) -> bool:
    try:
        operate.with_values(values)
    except ContractError:
        return False
    return True


def operating_rows(plant: OperatedPlant, fit: Fit) -> str:
    """The figures of one plant in words."""
    model, _ = fit.model(plant)
    law = law_of(plant, model, tuning="given")  # by which the converged one is made, too
    controller = controller_of(plant, law)
    parts = [plant.name]
    if plant.name in AT_ODDS:
        odds = AT_ODDS[plant.name]
        first, second = shares(plant, controller, odds)
        parts.append(
            f"{odds.first} and {odds.second} at odds: {first:.2f} % of the violation with {odds.second} where it ranks"
            f" lower, {second:.2f} % with {odds.first}"
        )
    parts += [f"{name}: {value:.1e}" for name, value in bumps(plant, controller, law, model).items()]
    return "; ".join(parts)
