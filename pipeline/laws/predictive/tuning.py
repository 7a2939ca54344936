"""The predictive law's numbers from closed loops over its own model with errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipeline.laws.base import ControlLaw
from pipeline.laws.predictive.side_by_side import side_by_side
from pipeline.laws.predictive.trials import Outcome
from pipeline.plants.simulator import Array

WORST = 0.3  # weight of the worst loop beyond the mean
TRAVEL = 0.03  # of J: what a travel of 1 % of the MVs' range a sample costs, at set points and after loads
Numbers = dict[str, float]
"""Factors of ``speed`` and ``caution``, ``q_x`` and ``horizon``."""

COARSE = [(s, c) for s in (0.5, 1.0, 2.0) for c in (0.4, 1.0, 2.5)]  # factors of speed and caution
FINE = [(s, c) for s in (0.7, 1.0, 1.4) for c in (0.6, 1.0, 1.6)]
HORIZONS = (0.7, 1.3)
Q_X = (0.1, 10.0)


@dataclass(frozen=True, slots=True)
class Candidate:
    """Numbers that were tried, and their cost J."""

    numbers: Numbers
    cost: float


class Tries(Protocol):
    """What runs laws side by side: ``Trials``."""

    def run(self, laws: ControlLaw, count: int) -> Outcome:
        """The loops of ``count`` laws."""


def costs(outcome: Outcome, given: Outcome) -> Array:
    """J (C,) of each law beside the ``given`` one's first, whose J is 1 and its travel.

        J = (E_sp/E_sp0 + E_load/E_load0)/2 + .03 (T_sp + T_load)/2

    E is the mean error of the loops and .3 of what the worst has more, T the MVs' travel [% of their range a sample].
    Set points have by far the larger errors; so each part counts by what it gains.
    """
    parts = []
    for name in ("set_points", "loads"):
        of, first = (_robust(getattr(o, name)) for o in (outcome, given))
        parts.append(of / first[0])
    return np.asarray(0.5 * (parts[0] + parts[1]) + TRAVEL * outcome.travel.mean(axis=-1), dtype=np.float64)


def _robust(error: Array) -> Array:
    """(C,) of errors (C, loops)."""
    return np.asarray((1 - WORST) * error.mean(axis=-1) + WORST * error.max(axis=-1), dtype=np.float64)


def searched(
    trials: Tries, law_of: Callable[[Mapping[str, float]], ControlLaw], start: Numbers
) -> tuple[Candidate, list[Candidate]]:
    """The best numbers by a search from ``start``, and all that were tried, the start first.

    Speed and caution together on a coarse grid, then the horizon, then the model's error, then a finer grid.
    """
    given = trials.run(side_by_side([law_of(start)]), 1)
    best = Candidate(dict(start), float(costs(given, given)[0]))
    tried = [best]

    def tried_all(changes: Sequence[Numbers]) -> None:
        nonlocal best
        new = [{**best.numbers, **change} for change in changes]
        new = [n for n in new if not any(n == c.numbers for c in tried)]
        if new:
            outcome = trials.run(side_by_side([law_of(n) for n in new]), len(new))
            found = costs(outcome, given)
            tried.extend(Candidate(n, float(j)) for n, j in zip(new, found, strict=True) if np.isfinite(j))
        best = min(tried, key=lambda c: c.cost)

    def grid(factors: Sequence[tuple[float, float]]) -> list[Numbers]:
        at = best.numbers
        return [{"speed": at["speed"] * s, "caution": at["caution"] * c} for s, c in factors]

    tried_all(grid(COARSE))
    at = best.numbers
    for factor in HORIZONS:  # each its own simulation: a plan has another length
        tried_all([{"horizon": float(np.clip(round(at["horizon"] * factor), 8, 60))}])
    tried_all([{"q_x": at["q_x"] * factor} for factor in Q_X])
    tried_all(grid(FINE))
    return best, tried
