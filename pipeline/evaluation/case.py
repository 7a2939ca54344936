"""What a case is: a plant, the tests that its controllers must pass, and the paper's figures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ParamsError, PlantError
from pipeline.evaluation.closed_loop import closed_loop_metrics
from pipeline.evaluation.effort import Effort
from pipeline.evaluation.metric import METRICS, Metric
from pipeline.metrics import rmse
from pipeline.plants.equations import EquationPlant, equations
from pipeline.plants.simulator import Simulator
from pipeline.simulation.scenario import Scenario

Array = NDArray[np.float64]


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
    scenario: str | None = None  # of ``Case.scenarios`` or ``Case.unscored``
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
    plant_class: ClassVar[type[Simulator]]
    further_plants: ClassVar[tuple[type[Simulator], ...]] = ()  # that some of its tests run on
    development_seeds: ClassVar[tuple[int, ...]]  # for tuning and selection, never scored
    noise: ClassVar[Mapping[str, float]]  # PV -> standard deviation of its measurement noise
    gate: ClassVar[Mapping[str, float]]  # scenario -> weight in the promotion gate, summing to 1
    tables: ClassVar[tuple[PaperTable, ...]] = ()
    figures: ClassVar[tuple[Figure, ...]] = ()
    requirements: ClassVar[tuple[Requirement, ...]] = ()
    metric: ClassVar[str] = "mae"  # the figure that laws are compared by, one with a floor: mae, sse, tracking
    # Figures that `score` adds, or that a law's analysis has, and other words for a common one. The report shows
    # them of every test.
    own_metrics: ClassVar[tuple[Metric, ...]] = ()
    # A test -> its words inside a sentence, where they are not its name's.
    test_words: ClassVar[Mapping[str, str]] = {}
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
    def plant(self) -> Simulator:
        """The nominal plant; raises PlantError where ``plant_class`` is abstract."""
        lacking = ", ".join(sorted(self.plant_class.__abstractmethods__))
        if lacking:
            raise PlantError(
                f"case {self.name!r}: its plant class {self.plant_class.__name__} is abstract, as it lacks {lacking}; "
                "write that, or name another class as plant_class"
            )
        return self.plant_class()

    @property
    def equations(self) -> EquationPlant:
        """The nominal plant in its equations; PlantError where it has none."""
        return equations(self.plant, f"what was asked of case {self.name!r}")

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

    @cached_property
    def metrics(self) -> Mapping[str, Metric]:
        """Every metric of the case by its name: the common ones, and its own."""
        return METRICS | {metric.name: metric for metric in self.own_metrics}

    @property
    def criterion(self) -> Metric:
        """The metric that laws are compared by."""
        return self.metrics[self.metric]

    @property
    def foreseen(self) -> bool:
        """Whether the bounds may use the whole course that the CV should take: of a recipe, or of a reference."""
        return self.recipe or self.criterion.reference

    @property
    def cv_unit(self) -> str:
        """The unit of the controlled variable."""
        return self.plant_class.sp_signals[0].unit

    def label(self, metric: str) -> str:
        """Words for a figure at the head of a table, with its unit; of a path into a model set's, before the dot."""
        first = metric.partition(".")[0]
        known = self.metrics.get(metric) or self.metrics.get(first)
        return first.replace("_", " ") if known is None else known.label(self.cv_unit)

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
        put ``together``; the other tests have one scenario.
        """

    def unscored(self) -> Mapping[str, Scenario]:
        """Further tests by name, whose curves are kept and whose figures are not: what a picture shows."""
        return {}

    def variants_run(self, tests: tuple[Scenario, ...]) -> bool:
        """Whether a law's variants run these tests of one name; by default those of one sequence, as papers have."""
        return len(tests) == 1

    @abstractmethod
    def development(self) -> tuple[Scenario, ...]:
        """Sequences for tuning and for choosing among candidates; never scored."""
