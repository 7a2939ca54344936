"""One closed-loop test: set points, start, disturbances, and how such courses are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.files import digest
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.simulation import NOISE_SUFFIX as NOISE_SUFFIX
from loopwright.pipeline.simulation.operator_changes import OperatedCourse, OperatorChange
from loopwright.serving.manifest import OperateEntry


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """One closed-loop test.

    At sample k the PV is measured, the error sp(k) - pv(k) counted, and the law's move acts over
    [k, k+1). ``changes`` holds plant parameters over every period, which no controller sees. ``dv`` holds the
    measured disturbances, which a controller is given at sample k and which act over [k, k+1).
    """

    name: str
    title: str
    sp: Array  # (n, n_sp) set point at every sample
    x0: Array  # (n_x,) steady state at the start
    mv0: Array  # (n_mv,) MV applied before sample 0
    changes: Mapping[str, Array] = field(default_factory=dict)  # plant parameter -> (n,)
    hold: int = 0  # samples per set point; 0: it never moves, or follows a course of its own
    seed: int | None = None  # of a random sequence
    late_from: int = 0  # where above 0: the sample from which `sse_late` counts, once the set point is within reach
    plant: Simulator | None = None  # what the test runs on, where that is not the case's plant
    reference: Array | None = None  # (n, 1) what the CV should do, where that is not to be at its set point at once
    replayed: bool = False  # a record's own course, with its noise in it: no noise is added, and no bound computed
    kind: str = ""  # of the plant gone wrong that it runs on
    dv: Array | None = None  # (n, n_dv) measured disturbances at every sample; None: they stay at the plant's own
    operate: tuple[OperatorChange, ...] = ()  # of a law that operators steer by more than set points

    def __post_init__(self) -> None:
        what = f"scenario {self.name!r}"
        if self.sp.ndim != 2 or not len(self.sp):
            raise PlantError(f"{what}: sp has shape {self.sp.shape}; give (n, n_sp) with n >= 1")
        n = len(self.sp)
        for key, values in self.changes.items():
            if values.shape != (n,):
                raise PlantError(f"{what}: {key} has shape {values.shape}; give one value a period, ({n},)")
        if self.reference is not None and self.reference.shape != self.sp.shape:
            raise PlantError(f"{what}: reference has shape {self.reference.shape}; give that of sp, {self.sp.shape}")
        if self.dv is not None and (self.dv.ndim != 2 or len(self.dv) != n):
            raise PlantError(f"{what}: dv has shape {self.dv.shape}; give (n, n_dv) with a row for each of {n} samples")

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.sp)

    def parameters(self, plant: Simulator) -> Array:
        """The plant's parameter vector over every period, shape (n, n_p).

        Raises PlantError where ``changes`` names a parameter that the plant does not have.
        """
        table = np.tile(plant.parameters(), (self.samples, 1))
        plant.parameters({key: float(values[0]) for key, values in self.changes.items()})
        for key, values in self.changes.items():
            table[:, plant.parameter_names().index(key)] = values
        return table

    def disturbances(self, plant: Simulator) -> Array:
        """Measured disturbances at every sample, shape (n, n_dv); PlantError for another number than the plant's."""
        nominal = plant.dv_nominal
        if self.dv is None:
            return np.tile(nominal, (self.samples, 1))
        if self.dv.shape[1:] != nominal.shape:
            raise PlantError(
                f"scenario {self.name!r} has {self.dv.shape[1]} measured disturbances; plant {plant.name!r} has "
                f"{len(nominal)}"
            )
        return self.dv

    def operated(self, entries: Sequence[OperateEntry]) -> OperatedCourse | None:
        """The values of these ``entries`` of a law at every sample; None where operators change nothing."""
        if not self.operate:
            return None
        return OperatedCourse.of(entries, self.operate, self.samples, f"test {self.name!r}")

    def digest(self) -> str:
        """sha256 of what the scenario demands; seven digits, so that a solver's last bits do not count."""

        def digits(values: Array) -> list[str]:
            return [f"{v:.7g}" for v in np.ravel(values)]

        arrays = {"sp": self.sp, "x0": self.x0, "mv0": self.mv0, **self.changes}
        text = {key: digits(values) for key, values in arrays.items()}
        what: list[Any] = [text, self.hold, *([self.late_from] if self.late_from else [])]
        if self.reference is not None:
            what.append(digits(self.reference))
        if self.dv is not None:
            what.append(["dv", *digits(self.dv)])
        if self.operate:
            what.append([[one.at, {name: f"{v:.7g}" for name, v in one.values.items()}] for one in self.operate])
        if self.plant is not None:
            what.append([self.plant.name, *digits(self.plant.parameters())])
        return digest(what)


def held(levels: list[float], hold: int) -> Array:
    """Set points, shape (len(levels) * hold, 1), each held for ``hold`` samples."""
    return np.repeat(np.array(levels, dtype=np.float64), hold)[:, None]


def random_levels(seed: int, count: int, low: float, high: float) -> list[float]:
    """``count`` set points uniform in [low, high]."""
    return [float(v) for v in np.random.default_rng(seed).uniform(low, high, count)]


def from_rest(
    plant: Simulator,
    name: str,
    title: str,
    sp: Array,
    *,
    hold: int = 0,
    seed: int | None = None,
    changes: Mapping[str, Array] | None = None,
) -> Scenario:
    """A test that starts at the steady state of its first set point, under its first parameters.

    ``sp`` (n, 1); ``changes`` plant parameters over every period, each (n,). Raises PlantError
    where there is no such steady state.
    """
    changes = changes or {}
    nominal = equations(plant, f"test {name!r}, which starts at a steady state,")
    first = _same(nominal.with_parameters({key: float(values[0]) for key, values in changes.items()}))
    x0, mv0 = first.steady_state_at(float(sp[0, 0]))
    return Scenario(name, title, sp, x0, mv0, changes, hold, seed)


@cache
def _same(plant: EquationPlant) -> EquationPlant:
    """The first plant with these parameters: it has its steady states already, which take longer than many a test."""
    return plant


def stepwise(n: int, *steps: tuple[int, float]) -> Array:
    """Values of ``n`` samples from steps (first sample, value), shape (n,); the first step starts at sample 0."""
    values = np.empty(n)
    for at, value in steps:
        values[at:] = value
    return values
