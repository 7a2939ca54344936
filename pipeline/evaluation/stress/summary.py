"""The loops of a stress test together: spreads, shares, the worst, and what makes the error grow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.evaluation.case import Case, Requirement
from loopwright.pipeline.evaluation.stress.draws import Draw
from loopwright.pipeline.evaluation.stress.loops import LOOP_FAILURES, SWINGS, StressOutcome, figures_of
from loopwright.pipeline.plants.simulator import Array

LOOP_QUANTILES = (0.05, 0.5, 0.9, 0.99, 1.0)  # of a figure over the loops of one test or of all, the largest value last
WORST = 10  # loops that are listed, the worst first
DRAWN_BINS = 5  # equal shares of the loops along a drawn quantity
LEAST_LOOPS = 4  # in a share whose median is shown
NO_FAULT = "none"


@dataclass(frozen=True)
class Spread:
    """A figure over loops: its values at LOOP_QUANTILES; of ``loops`` loops."""

    metric: str
    test: str  # empty: all tests
    loops: int
    values: tuple[float, ...]


@dataclass(frozen=True)
class RequirementShare:
    """A requirement of the case, and the share of the loops over its test that met it."""

    requirement: Requirement
    loops: int
    share: float


@dataclass(frozen=True)
class ErrorGrowth:
    """How the relative error grows along one drawn quantity: its middle, median and 90 % value of each share."""

    name: str
    at: tuple[float, ...] | tuple[str, ...]
    median: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def size(self) -> float:
        """Largest over smallest median; infinite where the loops of a share mostly broke, 1 where those of all did."""
        low, high = min(self.median), max(self.median)
        return 1.0 if low == high else high / max(low, 1e-300)


@dataclass(frozen=True)
class Summary:
    """All loops of a stress test. The relative error is a loop's error over the median one of its test."""

    case: Case
    name: str  # of the controller
    draws: Sequence[Draw]
    outcomes: Sequence[StressOutcome]

    @property
    def counts(self) -> dict[str, int]:
        """Loops that failed, by how, and those that swing; a loop may count several times."""
        return {
            **{name: sum(map(holds, self.outcomes)) for name, holds in LOOP_FAILURES.items()},
            "any of these": sum(o.failed for o in self.outcomes),
            SWINGS: sum(o.swings for o in self.outcomes),
        }

    @cached_property
    def tests(self) -> dict[str, NDArray[np.int64]]:
        """Test -> the places of its loops."""
        names = np.array([draw.test for draw in self.draws])
        return {str(name): np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())}

    @cached_property
    def relative(self) -> Array:
        """The error of each loop in the case's metric over the median of its test, (n,).

        It is infinite where a loop broke. Where most loops of a test broke, its median is that of the others.
        """
        errors, found = figures_of(self.outcomes, self.case.metric), np.empty(len(self.outcomes))
        for places in self.tests.values():
            whole = errors[places][np.isfinite(errors[places])]
            middle = float(np.median(errors[places]))
            if not np.isfinite(middle) and len(whole):
                middle = float(np.median(whole))
            found[places] = errors[places] / (middle if middle > 0 and np.isfinite(middle) else 1.0)
        return found

    def spreads(self) -> list[Spread]:
        """Each common figure over all loops, and the case's metric over each test."""
        names = list(dict.fromkeys(name for o in self.outcomes for name in o.figures))
        everywhere = np.arange(len(self.outcomes))
        return [
            *(self._spread(self.case.metric, test, places) for test, places in self.tests.items()),
            *(self._spread(name, "", everywhere) for name in names),
        ]

    def _spread(self, metric: str, test: str, places: NDArray[np.int64]) -> Spread:
        values = figures_of(self.outcomes, metric)[places]
        values = values[~np.isnan(values)]
        found = tuple(
            float(np.median(values) if q == 0.5 else np.quantile(values, q, method="higher")) for q in LOOP_QUANTILES
        )
        return Spread(metric, test, len(values), found)

    def requirements(self) -> list[RequirementShare]:
        """The case's requirements of a test that count for this controller, without those that need a bound."""
        found = []
        for need in self.case.requirements:
            if need.law not in (None, self.name) or need.setting or need.times or need.scenario not in self.tests:
                continue
            places = self.tests[need.scenario]
            values = figures_of(self.outcomes, need.metric)[places]
            failed = np.array([self.outcomes[i].failed for i in places])
            met = (values >= need.low) & (values <= need.high) & ~failed
            found.append(RequirementShare(need, len(places), float(np.mean(met))))
        return found

    def worst(self, count: int = WORST) -> list[int]:
        """Places of the worst loops: failed ones first, then by the relative error."""
        order = sorted(
            range(len(self.outcomes)), key=lambda i: (-self.outcomes[i].failed, -self.relative[i], self.draws[i].index)
        )
        return order[:count]

    def growths(self) -> list[ErrorGrowth]:
        """How the error grows along each drawn quantity, the strongest first."""
        rows = [draw.quantities() for draw in self.draws]
        names = dict.fromkeys(name for row in rows for name in row)
        found = [self._growth(name, np.array([row.get(name, np.nan) for row in rows])) for name in names]
        found.append(self._by_kind())
        return sorted((g for g in found if g is not None), key=lambda g: -g.size)

    def _growth(self, name: str, values: Array) -> ErrorGrowth | None:
        known = np.flatnonzero(~np.isnan(values))
        distinct = np.unique(values[known])
        if len(distinct) < 2 or len(known) < 2 * LEAST_LOOPS:
            return None
        if len(distinct) <= DRAWN_BINS:
            groups = [known[values[known] == v] for v in distinct]
        else:
            shares = min(DRAWN_BINS, len(known) // LEAST_LOOPS)
            groups = list(np.array_split(known[np.argsort(values[known], kind="stable")], shares))
        return _grown(name, tuple(float(np.median(values[g])) for g in groups), [self.relative[g] for g in groups])

    def _by_kind(self) -> ErrorGrowth | None:
        kinds = np.array([NO_FAULT if d.fault is None else d.fault.kind for d in self.draws])
        names = [k for k in dict.fromkeys(sorted(kinds.tolist())) if np.sum(kinds == k) >= LEAST_LOOPS]
        if len(names) < 2:
            return None
        return _grown("fault of the actuator", tuple(names), [self.relative[kinds == k] for k in names])


def _grown(name: str, at: tuple[float, ...] | tuple[str, ...], groups: Sequence[Array]) -> ErrorGrowth:
    median, high = (tuple(float(np.quantile(g, q, method="lower")) for g in groups) for q in (0.5, 0.9))
    return ErrorGrowth(name, at, median, high)


def table(draws: Sequence[Draw], outcomes: Sequence[StressOutcome]) -> Mapping[str, list[object]]:
    """One row a loop for programs: what was drawn, its figures, and how it failed. None where a test has none."""
    rows: list[dict[str, object]] = []
    for draw, one in zip(draws, outcomes, strict=True):
        fault = draw.fault
        rows.append(
            {
                "index": draw.index,
                "test": draw.test,
                "sequence_seed": draw.scenario.seed,
                **{f"parameter.{k}": v for k, v in draw.parameters.items()},
                "load_share": draw.load,
                "noise_times": draw.noise,
                "dead_time_samples": int(draw.late),
                "fault": NO_FAULT if fault is None else fault.kind,
                "fault_mv": None if fault is None else draw.scenario.plant.mv_signals[fault.mv].name,  # type: ignore[union-attr]
                "fault_size": None if fault is None else fault.size,
                "fault_start": None if fault is None else fault.start,
                "fault_end": None if fault is None else fault.end,
                **{f"figure.{k}": v for k, v in one.figures.items()},
                "locked_up": one.locked_up,
                "left_limits": one.left_limits,
                "swings": one.swings,
                "refused_samples": one.refused,
                "broke": one.broke,
            }
        )
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}
