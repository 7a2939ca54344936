"""What a case is: a plant, the tests that its controllers must pass, and the paper's figures."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.cases.effort import Effort
from pipeline.errors import ParamsError, PlantError
from pipeline.metrics import closed_loop_metrics, rmse
from pipeline.plants.base import Plant

Array = NDArray[np.float64]

NOISE_SUFFIX = "_noise"
"""A scenario's name with measurement noise is its name with this at the end: ``sp_a_noise``."""


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """One closed-loop test.

    At sample k the PV is measured, the error sp(k) - pv(k) counted, and the law's move acts over
    [k, k+1). ``changes`` holds plant parameters over every period, which no controller sees.
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
    plant: Plant | None = None  # what the test runs on, where that is not the case's plant
    reference: Array | None = None  # (n, 1) what the CV should do, where that is not to be at its set point at once

    def __post_init__(self) -> None:
        if self.sp.ndim != 2 or not len(self.sp):
            raise PlantError(f"scenario {self.name!r}: sp has shape {self.sp.shape}; give (n, n_sp) with n >= 1")
        for key, values in self.changes.items():
            if values.shape != (len(self.sp),):
                raise PlantError(
                    f"scenario {self.name!r}: {key} has shape {values.shape}; "
                    f"give one value a period, ({len(self.sp)},)"
                )
        if self.reference is not None and self.reference.shape != self.sp.shape:
            raise PlantError(
                f"scenario {self.name!r}: reference has shape {self.reference.shape}; give that of sp, {self.sp.shape}"
            )

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.sp)

    def parameters(self, plant: Plant) -> Array:
        """The plant's parameter vector over every period, shape (n, n_p).

        Raises PlantError where ``changes`` names a parameter that the plant does not have.
        """
        table = np.tile(plant.parameters(), (self.samples, 1))
        plant.parameters({key: float(values[0]) for key, values in self.changes.items()})
        for key, values in self.changes.items():
            table[:, plant.parameter_names().index(key)] = values
        return table

    def with_hold(self, hold: int) -> Self:
        """The same set points, each held for ``hold`` samples; only for a test without disturbances."""
        if not self.hold or self.changes:
            raise PlantError(f"scenario {self.name!r} has no holds that could be stretched")
        return replace(self, sp=np.repeat(self.sp[:: self.hold], hold, axis=0), hold=hold)

    def digest(self) -> str:
        """sha256 of what the scenario demands; seven digits, so that a solver's last bits do not count."""
        arrays = {"sp": self.sp, "x0": self.x0, "mv0": self.mv0, **self.changes}
        text = {key: [f"{v:.7g}" for v in np.ravel(values)] for key, values in arrays.items()}
        what: list[Any] = [text, self.hold, *([self.late_from] if self.late_from else [])]
        if self.reference is not None:
            what.append([f"{v:.7g}" for v in np.ravel(self.reference)])
        if self.plant is not None:
            what.append([self.plant.name, *(f"{v:.7g}" for v in self.plant.parameters())])
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """One number of the paper's tables, and the same one from an independent implementation.

    Of a model, ``law`` names its set, ``scenario`` is empty and ``metric`` a path of the set's figures.
    Without a scenario a law's name stands for what its analysis says, where no set is called so.
    Where the paper prints no figure (``printed`` false), ``paper`` is the independent implementation's.
    ``within`` is how near ours must be, in the figure's unit, where a quarter would let anything pass:
    half a unit of the last printed digit, for what follows from equations alone.
    """

    label: str
    law: str
    scenario: str
    metric: str
    paper: float
    setting: Mapping[str, float | str] = field(default_factory=dict)  # of the law, such as r
    independent: float | None = None
    printed: bool = True
    within: float | None = None


@dataclass(frozen=True, slots=True)
class PaperTable:
    """A table of the paper."""

    number: int
    title: str
    rows: tuple[PaperFigure, ...]


@dataclass(frozen=True, slots=True)
class Curve:
    """One controller in a figure."""

    law: str
    setting: Mapping[str, float | str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The paper's way to write it: INCAD (r=2.5)."""
        inside = ", ".join(f"{k}={v}" if isinstance(v, str) else f"{k}={v:g}" for k, v in self.setting.items())
        return self.law.upper() + (f" ({inside})" if inside else "")


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the paper: curves over a scenario; no scenario: predictions over validation data."""

    number: int
    title: str
    curves: tuple[Curve, ...]
    scenario: str | None = None
    hold: int | None = None  # other than the scenario's own
    info: tuple[str, ...] = ()  # entries of the controllers' info to show in place of the loop, a panel each
    model: str | None = None  # the model set whose predictions it shows


@dataclass(frozen=True, slots=True)
class Requirement:
    """What a law must show: low <= metric <= high, or high times a bound's figure of the same scenario."""

    law: str | None  # None: the case's best controller
    scenario: str
    metric: str
    high: float
    low: float = 0.0
    times: str | None = None  # "nmpc" or "offline"
    setting: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Case(ABC):
    """A plant with its tests. ``held_out_seeds`` may be changed (params.yaml); the rest is what the case is."""

    held_out_seeds: tuple[int, ...]

    name: ClassVar[str]
    title: ClassVar[str]
    plant_class: ClassVar[type[Plant]]
    development_seeds: ClassVar[tuple[int, ...]]  # for tuning and selection, never scored
    noise: ClassVar[Mapping[str, float]]  # PV -> standard deviation of its measurement noise
    gate: ClassVar[Mapping[str, float]]  # scenario -> weight in the promotion gate, summing to 1
    tables: ClassVar[tuple[PaperTable, ...]] = ()
    figures: ClassVar[tuple[Figure, ...]] = ()
    requirements: ClassVar[tuple[Requirement, ...]] = ()
    claims: ClassVar[Mapping[str, str]] = {}  # what the paper states -> what an independent implementation found
    # The figure that laws are compared by: "mae", "sse" (sum of squared errors over a test's samples), or "tracking"
    # (root mean square of reference - CV, where the tests have a reference).
    metric: ClassVar[str] = "mae"
    # A figure that `score` adds, or that a law's analysis has -> its words in a table, unit and all ("IAE [K s]").
    # What a case names here, its report shows of every test.
    metric_words: ClassVar[Mapping[str, str]] = {}
    recipe: ClassVar[bool] = False  # the course of the set point is known beforehand; the bounds may use that
    unforeseen: ClassVar[bool] = False  # the bounds' NMPC learns of a changed parameter one sample late
    seen: ClassVar[str] = ""  # in words for the report: which scored figures were looked at while numbers were chosen
    baseline: ClassVar[str] = "pid"  # the law that a champion must beat, and that reports compare with
    data_seeds: ClassVar[int] = 5  # that the best law must come from; 1 where nothing is learnt from data
    effort: ClassVar[Effort] = Effort()  # how far and how finely the bounds are searched
    limits: ClassVar[Mapping[str, tuple[float, float]]] = {}  # state -> the range that its laws and bounds keep it in
    noise_draws: ClassVar[int] = 1  # closed loops with noise are run this many times, and their figures averaged
    development_noise: ClassVar[bool] = False  # the plant is never measured without noise: nor is it for development

    def __post_init__(self) -> None:
        both = sorted(set(self.held_out_seeds) & set(self.development_seeds))
        if both or not self.held_out_seeds or len(set(self.held_out_seeds)) < len(self.held_out_seeds):
            raise ParamsError(
                f"cases.{self.name}.held_out_seeds: {list(self.held_out_seeds)}; give one or more different seeds, "
                f"none of {list(self.development_seeds)}, which serve the development"
            )

    @cached_property
    def plant(self) -> Plant:
        """The nominal plant; raises PlantError where ``plant_class`` is abstract."""
        lacking = ", ".join(sorted(self.plant_class.__abstractmethods__))
        if lacking:
            raise PlantError(
                f"case {self.name!r}: its plant class {self.plant_class.__name__} is abstract, as it lacks {lacking}; "
                "write that, or name another class as plant_class"
            )
        return self.plant_class()

    @property
    def regions(self) -> Mapping[str, tuple[float, float]]:
        """Operating regions, name -> [low, high) of the CV; the plant's own unless the case has better names."""
        return self.plant.regions

    @property
    def noise_std(self) -> Array:
        """Standard deviation of each PV's measurement noise, shape (n_pv,)."""
        return np.array([self.noise[s.name] for s in self.plant_class.pv_signals])

    def tests(self) -> dict[str, tuple[Scenario, ...]]:
        """``scenarios``; raises ParamsError where there are none, or one of them has no sequence."""
        found = self.scenarios()
        if not found:
            raise ParamsError(f"case {self.name!r} has no tests: its scenarios() is empty; return at least one")
        for name, sequences in found.items():
            if not sequences:
                raise ParamsError(
                    f"case {self.name!r}: its test {name!r} has no sequence; give it at least one Scenario"
                )
        return found

    def with_held_out(self, seeds: tuple[int, ...]) -> Self:
        """The case scored on other held-out sequences."""
        return replace(self, held_out_seeds=seeds)

    def score(self, test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
        """Figures of one closed loop, of the process variables without noise: pv (n, n_pv), mv (n, n_mv).

        A case that is judged by more than ``closed_loop_metrics`` adds to them.
        """
        sp = self.plant.sp_signals[0]
        found = closed_loop_metrics(test.sp, pv, mv, test.hold, self.plant.period_s, sp.high - sp.low, test.late_from)
        if test.reference is not None:
            found["tracking"] = rmse(test.reference, pv[:, : test.reference.shape[1]])
        return found

    @abstractmethod
    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        """The tests by name, each as its scenarios.

        A test of several random sequences has one scenario for each sequence, and its figures are
        the means over them; the other tests have one scenario.
        """

    @abstractmethod
    def development(self) -> tuple[Scenario, ...]:
        """Sequences for tuning and for choosing among candidates; never scored."""


def held(levels: list[float], hold: int) -> Array:
    """Set points, shape (len(levels) * hold, 1), each held for ``hold`` samples."""
    return np.repeat(np.array(levels, dtype=np.float64), hold)[:, None]


def random_levels(seed: int, count: int, low: float, high: float) -> list[float]:
    """``count`` set points uniform in [low, high]."""
    return [float(v) for v in np.random.default_rng(seed).uniform(low, high, count)]


def from_rest(
    plant: Plant,
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
    first = _same(plant.with_parameters({key: float(values[0]) for key, values in changes.items()}))
    x0, mv0 = first.steady_state_at(float(sp[0, 0]))
    return Scenario(name, title, sp, x0, mv0, changes, hold, seed)


@cache
def _same(plant: Plant) -> Plant:
    """The first plant with these parameters: it has its steady states already, which take longer than many a test."""
    return plant


def stepwise(n: int, *steps: tuple[int, float]) -> Array:
    """Values of ``n`` samples from steps (first sample, value), shape (n,); the first step starts at sample 0."""
    values = np.empty(n)
    for at, value in steps:
        values[at:] = value
    return values
