"""The draw of one loop: the plant, the test, the noise and the actuator's fault.

The kinds of faults are the ones that a control valve shows in the field: it sticks for a while, its zero or its span is
out of adjustment, or its drive is slow. A fault is one of one MV.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import DV_DRAW, noise_draws, noise_of_disturbances
from loopwright.serving.manifest import Signal

STUCK, ZERO, SPAN, SLOW = "stuck", "zero error", "span error", "slow"
KINDS = (STUCK, ZERO, SPAN, SLOW)
STUCK_FROM, STUCK_FOR = (0.1, 0.6), (0.05, 0.3)  # of the test: when it begins to stick, and for how long
MOST_ZERO, MOST_SPAN = 0.02, 0.05  # of the MV's range, and of the travel from its low end
STROKE = (5.0, 30.0)  # periods that a slow actuator takes over the MV's range


@dataclass(frozen=True)
class ActuatorFault:
    """One fault of one actuator.

    ``size`` is the zero error as a share of the MV's range, the span error as a share of the travel, or the periods
    of a full stroke. A stuck one holds its position from sample ``start`` up to, and without, sample ``end``.
    """

    kind: str
    mv: int
    size: float = 0.0
    start: int = 0
    end: int = 0

    def words(self, signals: Sequence[Signal]) -> str:
        """The fault for a person."""
        name = signals[self.mv].name
        if self.kind == STUCK:
            return f"{name} stuck from sample {self.start} to {self.end}"
        if self.kind == SLOW:
            return f"{name} slow: {self.size:.3g} periods for its range"
        return f"{name} {self.kind} of {100 * self.size:+.2g} %"


def draw_fault(rng: np.random.Generator, signals: Sequence[Signal], samples: int) -> ActuatorFault:
    """A fault drawn at random over a test of ``samples``; a discrete MV can only stick."""
    mv, share = int(rng.integers(len(signals))), rng.uniform(size=3)
    kind = KINDS[min(int(share[0] * len(KINDS)), len(KINDS) - 1)] if signals[mv].values is None else STUCK
    if kind == STUCK:
        start = int(samples * (STUCK_FROM[0] + share[1] * (STUCK_FROM[1] - STUCK_FROM[0])))
        length = int(samples * (STUCK_FOR[0] + share[2] * (STUCK_FOR[1] - STUCK_FOR[0])))
        return ActuatorFault(kind, mv, start=start, end=start + max(length, 1))
    if kind == SLOW:
        return ActuatorFault(kind, mv, size=float(STROKE[0] + share[1] * (STROKE[1] - STROKE[0])))
    most = MOST_ZERO if kind == ZERO else MOST_SPAN
    return ActuatorFault(kind, mv, size=float(most * (2 * share[1] - 1)))


class Actuators:
    """The actuators of ``n`` loops: from commands to positions that are read back, and to what the plants receive.

        position(k) = position(k-1) + clip(command - position(k-1), -rate, rate),   held while it is stuck
        acting(k)   = clip(low + (1 + span) (position - low) + zero (high - low), low, high)

    The read-back knows nothing of an error of zero or span. With ``late`` the plant receives acting(k-1).
    """

    def __init__(
        self, signals: Sequence[Signal], faults: Sequence[ActuatorFault | None], mv0: Array, late: Sequence[bool]
    ) -> None:
        n, m = mv0.shape
        self.low, self.high = (np.array([getattr(s, end) for s in signals]) for end in ("low", "high"))
        self.rate, self.zero, self.span = np.full((n, m), np.inf), np.zeros((n, m)), np.zeros((n, m))
        self.start, self.end = np.zeros((n, m), dtype=np.int64), np.zeros((n, m), dtype=np.int64)
        for i, fault in enumerate(faults):
            if fault is None:
                continue
            at = (i, fault.mv)
            wide = self.high[fault.mv] - self.low[fault.mv]
            if fault.kind == STUCK:
                self.start[at], self.end[at] = fault.start, fault.end
            elif fault.kind == SLOW:
                self.rate[at] = wide / fault.size
            elif fault.kind == ZERO:
                self.zero[at] = fault.size * wide
            else:
                self.span[at] = fault.size
        self.wrong = (self.zero != 0) | (self.span != 0)
        self.late = np.array(late, dtype=bool)[:, None]
        self.position, self.before = mv0.copy(), mv0.copy()

    def move(self, k: int, command: Array) -> tuple[Array, Array]:
        """(position, acting), both (n, n_mv), over sample ``k`` under commands (n, n_mv)."""
        way = command - self.position
        slow = np.abs(way) > self.rate
        moved = np.where(slow, self.position + np.sign(way) * np.where(slow, self.rate, 0.0), command)
        self.position = np.where((k >= self.start) & (k < self.end), self.position, moved)
        bent = self.low + (1 + self.span) * (self.position - self.low) + self.zero
        acting = np.where(self.wrong, np.clip(bent, self.low, self.high), self.position)
        given = np.where(self.late, self.before, acting)
        self.before = acting
        return self.position, given


DRAWN_LOADS = (0.0, 1.0)  # times the test's disturbances
NOISE = (0.5, 2.0)  # times the case's measurement noise
LATE_LOOPS = 0.5  # share of the loops with one more sample of dead time
MIXED_LEVELS = 2  # of a test, of which a random set point is a mixture

Range = tuple[float, float]


@dataclass(frozen=True)
class Draw:
    """One loop. ``parameters`` differ from the plant's for the whole loop; ``load`` scales the test's disturbances."""

    index: int
    test: str
    scenario: Scenario
    parameters: Mapping[str, float]
    load: float
    noise: float
    late: bool
    fault: ActuatorFault | None
    noise_seed: tuple[int, int, int]

    def deviation(self, plant: Simulator, std: Array) -> Array:
        """The measurement noise (n, n_pv)."""
        rng = np.random.default_rng(self.noise_seed)
        return noise_draws(plant, self.scenario.samples, self.noise * std, rng)

    def dv_deviation(self, plant: Simulator) -> Array:
        """The noise (n, n_dv) of the measured disturbances."""
        rng = np.random.default_rng((*self.noise_seed, DV_DRAW))
        return noise_of_disturbances(plant, self.scenario.samples, rng, self.noise)

    def quantities(self) -> dict[str, float]:
        """All that was drawn as numbers, by the words of the report."""
        return {
            **self.parameters,
            "load": self.load,
            "noise": self.noise,
            "one more sample of dead time": float(self.late),
        }


@dataclass(frozen=True)
class Drawing:
    """How loops are drawn: of a case, from ``seed``, parameters without a stated range within +-``spread`` of theirs.

    ``faults`` is the share of the loops with a fault of an actuator. Each loop is a function of (seed, index) alone.
    """

    case: Case
    seed: int = 0
    spread: float = 0.02
    faults: float = 0.5

    @cached_property
    def tests(self) -> Mapping[str, tuple[Scenario, ...]]:
        """The case's tests, from which courses of set points and disturbances are drawn."""
        return self.case.tests()

    def plant_of(self, test: Scenario) -> Simulator:
        """The plant of a test."""
        return test.plant or self.case.plant

    @cached_property
    def disturbed(self) -> frozenset[str]:
        """Parameters that the case's own tests move: disturbances, which a draw scales."""
        return frozenset(name for tests in self.tests.values() for test in tests for name in test.changes)

    def ranges(self, plant: Simulator) -> dict[str, Range]:
        """Parameter -> range that it is drawn from: as the case states it, else +-``spread`` of a value that is not 0.

        PlantError for a plant without any.
        """
        stated, names = self.case.ranges_of(plant), plant.parameter_names()
        for name in stated:
            plant.parameters({name: stated[name][0]})  # raises for a name that the plant has not
        found = dict(stated)
        for name, value in zip(names, plant.parameters(), strict=True):
            if name not in stated and name not in self.disturbed and value:
                width = self.spread * abs(value)
                found[name] = (float(value - width), float(value + width))
        if not found and not self.disturbed:
            raise PlantError(
                f"plant {plant.name!r} has no parameters, so no other plant can be drawn; give its class numeric "
                'fields with metadata={"unit": ...}, or state ranges in the case'
            )
        return found

    def draw(self, index: int) -> Draw:
        """The loop with this number."""
        rng = np.random.default_rng((self.seed, index))
        name = list(self.tests)[int(rng.integers(len(self.tests)))]
        test = self.tests[name][int(rng.integers(len(self.tests[name])))]
        plant, share = self.plant_of(test), float(rng.uniform(*DRAWN_LOADS))
        parameters = {key: float(rng.uniform(*ends)) for key, ends in self.ranges(plant).items()}
        noise, late = float(rng.uniform(*NOISE)), bool(rng.uniform() < LATE_LOOPS)
        faulty = bool(rng.uniform() < self.faults)
        fault = draw_fault(rng, plant.mv_signals, test.samples)
        nominal = dict(zip(plant.parameter_names(), plant.parameters(), strict=True))
        loads = {k: nominal[k] + share * (v - nominal[k]) for k, v in test.changes.items() if k not in parameters}
        # One number each, however long the test: ten thousand loops are drawn before the first one runs.
        held = {k: np.broadcast_to(value, test.samples) for k, value in parameters.items()}
        scenario = replace(test, sp=_set_points(rng, test), changes={**held, **loads}, plant=plant)
        return Draw(
            index, name, scenario, parameters, share, noise, late, fault if faulty else None, (self.seed, index, 1)
        )

    def draws(self, indices: Sequence[int]) -> list[Draw]:
        """The loops with these numbers."""
        return [self.draw(i) for i in indices]


def _set_points(rng: np.random.Generator, test: Scenario) -> Array:
    """Set points (n, n_sp): those of every hold but the first are mixtures of two of the test's.

    A plant that can hold two set points can most often hold what lies between. A set point that does not move, or
    that follows a course of its own (a recipe), stays; so does one that a reference belongs to.
    """
    if not test.hold or test.reference is not None:
        return test.sp
    levels = test.sp[:: test.hold]
    if not np.any(levels != levels[0]):
        return test.sp
    pairs = rng.integers(len(levels), size=(len(levels), MIXED_LEVELS))
    weight = rng.uniform(size=(len(levels), 1))
    drawn = weight * levels[pairs[:, 0]] + (1 - weight) * levels[pairs[:, 1]]
    drawn[0] = levels[0]  # where the plant rests
    return np.repeat(drawn, test.hold, axis=0)[: test.samples]
