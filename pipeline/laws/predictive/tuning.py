"""The predictive law's numbers from closed loops over its own model with errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from loopwright.pipeline.engine.progress import steps
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.pipeline.laws.predictive.params import PredictiveParams, loads_at
from loopwright.pipeline.laws.predictive.tuning_loops import LoopErrors, TuningLoops, side_by_side
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.tuning.calm_choice import CALM_COST, calmest

TRAVEL_COST = 0.05  # of J: what a travel of 1 % of the MVs' range a sample costs
DEPARTURE_COST = 0.02  # of J: what a number that is e times as large as at first costs, or an e-th of it
COARSE = [(s, c) for s in (0.5, 1.0, 2.0) for c in (0.4, 1.0, 2.5)]  # factors of speed and caution
FINE = [(s, c) for s in (0.7, 1.0, 1.4) for c in (0.6, 1.0, 1.6)]
HORIZONS = (0.7, 1.3)  # factors of the horizon that are tried
JUMPS = (0.3, 0.1, 0.03)  # factors of the observer's jumps that are tried
TRIED_DAMPINGS = (0.1, 0.25, 0.5, 1.0)  # less costs digits and calm, more costs speed
FORGETS = 100.0  # growth of a small difference up to which a loop forgets it; most stay below 20
# Of the searched numbers, for a plant on which they do not hold:
CALM_SPEED = 0.3  # moves weigh eleven times as much
CALM_JUMPS = 0.1  # the observer takes a swing of its own loop for steps of a load less

Numbers = dict[str, float]
"""``speed``, ``caution``, ``jumps`` and ``horizon``."""


@dataclass(frozen=True, slots=True)
class TriedNumbers:
    """Numbers that were tried, their cost J, and what it is made of: errors over the first ones', and travel."""

    numbers: Numbers
    cost: float
    set_points: float = 1.0
    loads: float = 1.0
    travel: float = 0.0  # [% of the MVs' range a sample]

    @property
    def error(self) -> float:
        """J without its travel: the errors, and the price of numbers far from the first."""
        return self.cost - TRAVEL_COST * self.travel

    def row(self) -> dict[str, float]:
        """Its numbers, what they gave, and its cost, by name."""
        return {**self.numbers, **{n: getattr(self, n) for n in ("set_points", "loads", "travel", "error", "cost")}}


class Tries(Protocol):
    """Loops of laws side by side: ``Trials``."""

    def run(self, laws: ControlLaw, count: int) -> LoopErrors:
        """The loops of ``count`` laws."""

    def growth(self, law: ControlLaw) -> float:
        """How far a small difference grows in the loops of one law."""


def judged(outcome: LoopErrors, given: LoopErrors, numbers: Sequence[Numbers]) -> list[TriedNumbers]:
    """Each law with its ``numbers`` beside the ``given`` one's first, whose errors count 1.

        J = (E_sp/E_sp0 + E_load/E_load0)/2 + .05 (T_sp + T_load)/2

    E is the mean error of the loops, T the MVs' travel [% of their range a sample]. Set points have by far the larger
    errors; so each part counts by what it gains. A worst loop does not count by itself, which made J jump.
    """
    sp, loads = (getattr(outcome, n).mean(axis=-1) / getattr(given, n).mean() for n in ("set_points", "loads"))
    travel = outcome.travel.mean(axis=-1)
    rows = zip(numbers, 0.5 * (sp + loads) + TRAVEL_COST * travel, sp, loads, travel, strict=True)
    return [TriedNumbers(dict(n), *map(float, figures)) for n, *figures in rows]


def searched(
    trials: Tries, law_of: Callable[[Mapping[str, float]], ControlLaw], start: Numbers
) -> tuple[TriedNumbers, list[TriedNumbers]]:
    """The calmest of the best numbers by a search from ``start``, and all that were tried, the start first.

    Speed and caution together on a coarse grid, then the horizon, then the jumps, then a finer grid. Numbers far from
    the start must gain more: the loops' model is the law's own, and what they gain by little may be lost on the plant.
    """
    show = steps("tuning in closed loops on the model with errors", 1 + sum(map(len, (COARSE, HORIZONS, JUMPS, FINE))))
    given = trials.run(side_by_side([law_of(start)]), 1)
    tried = judged(given, given, [start])
    if not np.isfinite(tried[0].cost):
        raise LawError(
            "its loops are not stable on its own model with the errors that the record leaves open; choose another "
            "law, or record more"
        )
    best = tried[0]

    def tried_all(changes: Sequence[Numbers]) -> None:
        nonlocal best
        new = [{**best.numbers, **change} for change in changes]
        new = [n for n in new if not any(n == c.numbers for c in tried)]
        if new:
            outcome = trials.run(side_by_side([law_of(n) for n in new]), len(new))
            found = [
                replace(c, cost=c.cost + DEPARTURE_COST * _distance(c.numbers, start))
                for c in judged(outcome, given, new)
            ]
            tried.extend(c for c in found if np.isfinite(c.cost))
        best = min(tried, key=lambda c: c.cost)
        show(len(tried))

    def grid(factors: Sequence[tuple[float, float]]) -> list[Numbers]:
        at = best.numbers
        return [{"speed": at["speed"] * s, "caution": at["caution"] * c} for s, c in factors]

    tried_all(grid(COARSE))
    at = dict(best.numbers)
    for factor in HORIZONS:  # each its own simulation: a plan has another length
        tried_all([{"horizon": float(np.clip(round(at["horizon"] * factor), 8, 60))}])
    tried_all([{"jumps": at["jumps"] * factor} for factor in JUMPS])
    tried_all(grid(FINE))
    return calmest(tried), tried


@dataclass(frozen=True, slots=True)
class TunedLaw:
    """Result of a search: the best numbers, the damping of the passes (None: no reason for any), all that it tried."""

    numbers: Numbers
    damping: float | None
    tried: tuple[TriedNumbers, ...]


def tuned(
    trials: Tries,
    law_of: Callable[[Mapping[str, float], float | None], ControlLaw],
    start: Numbers,
    damping: float | None = None,
) -> TunedLaw:
    """The best numbers of the laws ``law_of(numbers, damping)``; without a ``damping`` the least that the loops stand.

    The damping is the least with which a small difference does not grow in the loops. Where it grows with each, the
    model is to blame and not the passes, and the law keeps its own.
    """

    def stood(numbers: Numbers, least: float) -> float | None:
        offers = (d for d in TRIED_DAMPINGS if d >= least)
        return next((d for d in offers if trials.growth(law_of(numbers, d)) <= FORGETS), None)

    first = stood(start, 0.0) if damping is None else damping
    best, tried = searched(trials, lambda numbers: law_of(numbers, first), start)
    last = stood(best.numbers, first) if damping is None and first is not None else first
    return TunedLaw(best.numbers, last, tuple(tried))


def in_words(tried: Sequence[TriedNumbers]) -> str:
    """The numbers that a search tried, its start first, and its gain, for the report."""
    first, least, taken = tried[0].cost, min(c.cost for c in tried), calmest(tried).cost
    costs = f"{first:.3g} with the first numbers, {least:.3g} at the least and {taken:.3g} with those taken"
    return (
        f"{len(tried)} sets of numbers were tried in closed loops over the model with errors of gain, pace and dead "
        f"time, with loads and noise; the cost is {costs}. It is the mean of the errors at "
        "set points and under loads, each over that with the first numbers, .05 for a travel of 1 % of the MVs' range "
        "a sample, and a little for numbers far from the first. Among those within "
        f"{100 * CALM_COST:.0f} % of the least cost without travel, those of the least travel are taken; a higher "
        "`speed` moves the MVs more and follows faster, and the picture shows the price of each."
    )


def _distance(numbers: Numbers, start: Numbers) -> float:
    return float(sum(np.log(numbers[name] / start[name]) ** 2 for name in start))


class SearchedParams(NamedTuple):
    """Outcome of a search: parameters with the best numbers, calmer ones of last resort, and all that was tried."""

    params: PredictiveParams
    calmer: PredictiveParams
    tried: tuple[TriedNumbers, ...]


def searched_params(
    law_of: Callable[[PredictiveParams], ControlLaw],
    model: Identified,
    signals: Signals,
    params: PredictiveParams,
    horizon: int,
) -> SearchedParams:
    """The best numbers of a search that starts from ``params`` and ``horizon``.

    Its set points step over the record's range, so its laws know no soft limits and no recipe. The calmer numbers are
    ``CALM_SPEED`` of the speed and ``CALM_JUMPS`` of the jumps.
    """
    loads = loads_at(model, params)  # without `operate` the laws of the search would have others
    plain = replace(params, cv_low=None, cv_high=None, preview="held", operate=None, changes=None, loads=loads)

    def with_numbers(n: Mapping[str, float], damping: float | None, given: PredictiveParams) -> PredictiveParams:
        numbers: dict[str, Any] = {**n, "horizon": int(n["horizon"]), "damping": damping}
        return replace(given, **numbers)

    start = {n: float(getattr(params, n)) for n in ("speed", "caution", "jumps")} | {"horizon": float(horizon)}
    found = tuned(
        TuningLoops.draw(model, signals, horizon, params.seed),
        lambda n, damping: law_of(with_numbers(n, damping, plain)),
        start,
        params.damping,
    )
    at = found.numbers
    calm = {**at, "speed": CALM_SPEED * at["speed"], "jumps": CALM_JUMPS * at["jumps"]}
    best, calmer = (with_numbers(n, found.damping, params) for n in (at, calm))
    return SearchedParams(best, calmer, found.tried)
