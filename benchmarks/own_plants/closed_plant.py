"""A plant as a historian sees it: old loops hold it, loads wander that nobody measures, some disturbances are measured.

Each wandering load and each measured disturbance is a parameter of the equations. It goes on in use as in the record.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from loops import HELD_OUT, LoopTest, tests_of
from plant import OwnPlant

from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.scenario import Scenario

MOST = 2.2  # standard deviations that a wandering load reaches
DAY = 1_500  # samples of a day's operation
SET_POINT_SD = 0.16  # of a set point's range: an operator's set points about its middle
STEP = 0.01  # of a set point's range: an operator's set points are multiples of it


@dataclass(frozen=True, slots=True)
class OldLoop:
    """The controller that a loop has had for years: a sluggish PI, and the ends of its output [%]."""

    tag: str
    kc: float  # [% of the valve / unit of the PV]
    ti_s: float
    low: float = 0.0
    high: float = 100.0


@dataclass(frozen=True, slots=True)
class Wander:
    """A load that nobody measures: coloured noise of first order, in the unit of the parameter that it is."""

    parameter: str
    sd: float
    samples: float  # time constant


@dataclass(frozen=True, slots=True)
class Measured:
    """A disturbance with a transmitter: levels that others set, each reached through a lag, and measurement noise."""

    parameter: str
    tag: str
    unit: str
    low: float
    high: float
    every: float  # samples of a level, in the mean
    lag: float  # samples
    noise: float


@dataclass(frozen=True)
class ClosedPlant(OwnPlant):
    """A plant in the hand of its old loops, one for each CV and the MV of the same place."""

    loops: ClassVar[tuple[OldLoop, ...]]
    wanders: ClassVar[tuple[Wander, ...]]
    measured_disturbances: ClassVar[tuple[Measured, ...]] = ()
    every: ClassVar[float]  # samples from one set point of the operator to the next, in the mean
    in_manual: ClassVar[tuple[int, int]] = (35, 120)  # fewest and most samples of one time in manual
    hand_moves: ClassVar[tuple[float, float]] = (2.0, 6.0)  # [%] of the MV in manual

    @property
    def bounding(self) -> ClosedPlant:
        """The plant of the NMPC that no controller can beat: this one, or one that can do whatever this can."""
        return self

    def drift(self, n: int, rng: np.random.Generator) -> dict[str, Array]:
        """The courses (n,) of what moves by itself."""
        wandering = {w.parameter: getattr(self, w.parameter) + wandered(w, n, rng) for w in self.wanders}
        return wandering | {m.parameter: led(m, n, rng) for m in self.measured_disturbances}

    def known(self, scenario: Scenario) -> Array:
        """The measured disturbances of a test (n, n_dv), with their transmitters' noise."""
        return self.shown(scenario.changes, scenario.samples, np.random.default_rng((scenario.seed or 0) + 2))

    def shown(self, courses: Mapping[str, Array], n: int, rng: np.random.Generator) -> Array:
        """What the transmitters show of the measured disturbances among courses by parameter, (n, n_dv)."""
        noise = rng.standard_normal((n, len(self.measured_disturbances)))
        found = [courses[m.parameter] + m.noise * noise[:, i] for i, m in enumerate(self.measured_disturbances)]
        return np.column_stack(found) if found else np.empty((n, 0))


def wandered(of: Wander, n: int, rng: np.random.Generator) -> Array:
    """A course (n,) about 0."""
    kept = np.exp(-1 / of.samples)
    pushes = rng.standard_normal(n) * np.sqrt(1 - kept**2)
    course, at = np.empty(n), float(np.clip(rng.standard_normal(), -1, 1))
    for k in range(n):
        course[k] = at
        at = kept * at + pushes[k]
    return of.sd * np.clip(course, -MOST, MOST)


def led(of: Measured, n: int, rng: np.random.Generator) -> Array:
    """A course (n,) of levels within the inner half of the transmitter's range."""
    quarter = (of.high - of.low) / 4
    at = level = (of.low + of.high) / 2
    course, share = np.empty(n), 1 - np.exp(-1 / of.lag)
    changes, levels = rng.uniform(size=n) < 1 / of.every, rng.uniform(of.low + quarter, of.high - quarter, n)
    for k in range(n):
        level = levels[k] if changes[k] else level
        course[k] = at
        at += share * (level - at)
    return course


def operated(plant: ClosedPlant, n: int, rng: np.random.Generator) -> Array:
    """Set points (n, n_cv) as operators choose them: rare, about the middle, in round numbers, one loop at a time."""
    low, high = (np.array([getattr(s, end) for s in plant.sp_signals]) for end in ("low", "high"))
    span = high - low
    sp = np.tile((low + high) / 2, (n, 1))
    for i in range(len(low)):
        wishes = np.clip(0.5 + SET_POINT_SD * rng.standard_normal(n), 0.02, 0.98)
        changed = np.flatnonzero(rng.uniform(size=n) < 1 / plant.every)
        for at in changed:
            sp[at:, i] = low[i] + span[i] * STEP * round(wishes[at] / STEP)
    return sp


def closed_tests_of(plant: ClosedPlant) -> dict[str, list[LoopTest]]:
    """Random set points, steps of a load at each MV, and a day of operation: loads wander in all of them."""
    found = tests_of(plant)
    return {"set points": found["set points"], "loads": found["loads"], "day": list(_days(plant))}


def _days(plant: ClosedPlant) -> Iterator[LoopTest]:
    for seed in HELD_OUT:
        rng = np.random.default_rng(seed)
        sp, drift = operated(plant, DAY, rng), plant.drift(DAY, rng)
        first = plant.with_parameters({key: float(values[0]) for key, values in drift.items()})
        scenario = Scenario("day", "", sp, *first.rest(sp[0]), changes=drift, hold=plant.hold, seed=seed)
        yield LoopTest(scenario, np.zeros_like(sp))
