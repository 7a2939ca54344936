"""Cases: a plant, the tests of its controllers, and the paper's figures."""

from __future__ import annotations

import math
import statistics
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.config.known import Known
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.evaluation.closed_loop import closed_loop_metrics
from loopwright.pipeline.evaluation.evidence_basis import RecordVerdict
from loopwright.pipeline.evaluation.metric import METRICS, TRAVEL, Metric
from loopwright.pipeline.metrics import rmse
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.simulator import Signals, Simulator
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.records.recorded_rests import RecordedRest
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.manifest import OperateEntry

Array = NDArray[np.float64]
Setting = Mapping[str, float | str]
"""The parameters in which a variant differs from the shipped law."""
SHARES_OF_RANGES = "% of ranges"
"""The unit of the travel of MVs whose own units differ."""


@dataclass(frozen=True, slots=True)
class Effort:
    """Horizon and resolution of the bounds' plans; they depend on the sampling period.

    The defaults are for a plant that changes much within one period. A plant that needs many periods to
    respond to a move needs more and coarser periods, longer reaches, and a plan that is followed for
    several samples.
    """

    periods: int = 40  # horizon of the NMPC
    elements: int = 3  # of collocation a period, of the NMPC ...
    fine: int = 6  # ... and of the offline optimum
    degree: int = 3
    reaches: tuple[int, ...] = (1, 2, 3)  # of the rollouts that a fresh search starts from
    tail: int = 20  # periods of an offline plan beyond its set point's last sample
    every: int = 1  # samples for which the NMPC follows a plan while its predictions are correct
    noisy: bool = True  # whether the NMPC also runs with noisy states, which it does not filter


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """One number of the paper's tables.

    For a model, ``law`` names its set, ``scenario`` is empty and ``metric`` is a path in the set's figures.
    ``within`` is a tolerance in the figure's unit, for figures that follow from equations alone: half a
    unit of the last printed digit. The general tolerance of a quarter is too wide for them.
    """

    label: str
    law: str
    scenario: str
    metric: str
    paper: float
    setting: Setting = field(default_factory=dict)  # of the law, such as r
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
    setting: Setting = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the paper: curves over a scenario; no scenario: predictions over validation data."""

    number: int
    title: str
    curves: tuple[Curve, ...]
    scenario: str | None = None  # of ``Case.scenarios`` or ``Case.unscored``
    info: tuple[str, ...] = ()  # entries of the controllers' info, a panel each, instead of the loop
    model: str | None = None  # the model set whose predictions it shows


@dataclass(frozen=True, slots=True)
class Requirement:
    """A requirement: low <= metric <= high; with ``times``, high is a factor of that bound's figure."""

    law: str | None  # None: the case's best controller
    scenario: str
    metric: str
    high: float
    low: float = 0.0
    times: str | None = None  # "nmpc" or "offline"
    setting: Setting = field(default_factory=dict)


@dataclass(frozen=True)
class Case(ABC):
    """A plant with its tests. params.yaml sets ``held_out_seeds``; the case fixes the rest."""

    held_out_seeds: tuple[int, ...]

    name: ClassVar[str]
    title: ClassVar[str]
    plant_class: ClassVar[type[Simulator]]
    further_plants: ClassVar[tuple[type[Simulator], ...]] = ()  # for some of its tests
    development_seeds: ClassVar[tuple[int, ...]]  # for tuning and selection, never scored
    noise: ClassVar[Mapping[str, float]]  # PV -> standard deviation of its measurement noise
    gate: ClassVar[Mapping[str, float]]  # scenario -> weight in the promotion gate, summing to 1
    tables: ClassVar[tuple[PaperTable, ...]] = ()
    figures: ClassVar[tuple[Figure, ...]] = ()
    requirements: ClassVar[tuple[Requirement, ...]] = ()
    metric: ClassVar[str] = "mae"  # compares the laws; it has a floor: mae, sse, tracking
    # Metrics that `score` or a law's analysis adds, and new words for common metrics. The report shows them for
    # every test.
    own_metrics: ClassVar[tuple[Metric, ...]] = ()
    # Test -> its words in a sentence, if they differ from its name.
    test_words: ClassVar[Mapping[str, str]] = {}
    recipe: ClassVar[bool] = False  # the set-point profile is known in advance; the bounds may use it
    unforeseen: ClassVar[bool] = False  # the bounds' NMPC sees a parameter change one sample late
    disclosure: ClassVar[str] = ""  # for the report: the scored figures that influenced settings
    read_every: ClassVar[tuple[int, ...]] = ()  # samples from one new reading of each PV to the next; (): all are read
    baseline: ClassVar[str] = "pid"  # the law that a champion must beat, and that reports compare with
    old_loop: ClassVar[str] = ""  # the law that the plant was run by before: none is best that does not beat it
    data_seeds: ClassVar[int] = 5  # required of the best law; 1 if no model is trained on data
    effort: ClassVar[Effort] = Effort()  # horizon and resolution of the bounds' search
    limits: ClassVar[Mapping[str, tuple[float, float]]] = {}  # state -> its range, for laws and bounds
    noise_draws: ClassVar[int] = 1  # repetitions of a closed loop with noise; figures are averaged
    known: ClassVar[tuple[Known, ...]] = ()  # of pairs of PV and input, by an engineer
    kept_ranges: ClassVar[
        Mapping[str, tuple[float, float]]
    ] = {}  # PV -> its range: no set point asks for a rest beyond
    held: ClassVar[Mapping[str, int]] = {}  # PV -> sign of its answer to the MV, by the old loop that held it with that
    on_models: ClassVar[bool] = False  # the tests run on models of the plant's record
    stand_in: ClassVar[str] = "identified"  # what they run on in the plant's place: such models, or a simulator
    reads: ClassVar[tuple[Path, ...]] = ()  # files, beside the code, that the tests run
    development_noise: ClassVar[bool] = False  # development runs have measurement noise too
    development_geometric: ClassVar[bool] = False  # each sequence counts by its ratio, however large its errors are
    gone_wrong: ClassVar[tuple[str, ...]] = ()  # tests on plants that no law was told of: poor figures there are told
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}  # plant parameter -> where that of a real plant may lie

    def __post_init__(self) -> None:
        both = sorted(set(self.held_out_seeds) & set(self.development_seeds))
        if both or not self.held_out_seeds or len(set(self.held_out_seeds)) < len(self.held_out_seeds):
            raise ParamsError(
                f"cases.{self.name}.held_out_seeds: {list(self.held_out_seeds)}; give one or more different seeds, "
                f"none of the development seeds {list(self.development_seeds)}"
            )

    @cached_property
    def plant(self) -> Simulator:
        """The nominal plant; raises PlantError where ``plant_class`` is abstract."""
        lacking = ", ".join(sorted(self.plant_class.__abstractmethods__))
        if lacking:
            raise PlantError(
                f"case {self.name!r}: its plant class {self.plant_class.__name__} is abstract, as it lacks {lacking}; "
                "implement that, or give another plant_class"
            )
        return self.plant_class()

    @property
    def weights(self) -> Mapping[str, float]:
        """The weights of ``gate`` over the tests that the case has; those of a test that it lacks go to the others."""
        return self.gate

    @property
    def lacking(self) -> tuple[str, ...]:
        """Sentences for the report: tests that the plant does not allow, and why."""
        return ()

    @property
    def ready(self) -> bool:
        """Whether the plant can be simulated yet; a plant known by its record alone waits for its models."""
        return True

    @property
    def equations(self) -> EquationPlant:
        """The nominal plant in its equations; PlantError where it has none."""
        return equations(self.plant, f"what was asked of case {self.name!r}")

    @property
    def regions(self) -> Mapping[str, tuple[float, float]]:
        """Operating regions, name -> [low, high) of the CV; by default the plant's regions."""
        return self.plant.regions

    def ranges_of(self, plant: Simulator) -> Mapping[str, tuple[float, float]]:
        """Stated ranges of the parameters of one of the case's plants, from which other plants are drawn."""
        return self.ranges

    @property
    def noise_std(self) -> Array:
        """Standard deviation of each PV's measurement noise, shape (n_pv,)."""
        return np.array([self.noise[s.name] for s in self.plant_class.pv_signals])

    @property
    def settling_s(self) -> float | None:
        """About how long [s] the plant takes to settle, as a record shows it; None without one."""
        return None

    @property
    def asked(self) -> Array:
        """How far set points go from one to another, (n_cv,): the ranges, or less where a case states it."""
        return np.array([s.high - s.low for s in self.plant.sp_signals])

    def rest_within_ranges(self, test: Scenario, entries: Sequence[OperateEntry], row: int, mv: Array) -> Array | None:
        """Where the CVs (n_cv,) rest at best at a row of a test, for a law that keeps the ranges of its ``entries``.

        ``mv`` (n_mv,) are the MVs then. None where no model says so.
        """
        return None

    @property
    def spans(self) -> Array:
        """Widths (n_cv,) of which small errors are shares: of settling, of swings, of steps too small to count."""
        return self.asked

    @property
    def noise_level(self) -> float:
        """The measurement noise in the unit that the laws' errors have, as a standard deviation."""
        return float(self.noise_std[0])

    @property
    def recorded(self) -> Mapping[str, tuple[float, float]]:
        """PV or MV -> its lowest and highest value in the plant's record; empty for a plant in equations."""
        return {}

    @property
    def record_verdict(self) -> RecordVerdict | None:
        """The verdict of the screening on the plant's record; None where there is no such record."""
        return None

    @property
    def record_signals(self) -> Signals:
        """The signals of the plant's record: those of the plant, unless its MVs were moved farther than laws may."""
        return self.plant.signals

    @property
    def replayed(self) -> tuple[Record, int] | None:
        """The record over which laws are replayed, and the samples in which the plant half answers; None: no record."""
        return None

    @property
    def recorded_rests(self) -> tuple[RecordedRest, ...]:
        """Rests of the plant's record, at which laws are started cold; none without a record."""
        return ()

    def tests(self) -> dict[str, tuple[Scenario, ...]]:
        """``scenarios``; ParamsError if there are none, or if one of them has no sequence."""
        scenarios = self.scenarios()
        if not scenarios:
            raise ParamsError(f"case {self.name!r} has no tests: its scenarios() is empty; return at least one")
        for name, sequences in scenarios.items():
            if not sequences:
                raise ParamsError(
                    f"case {self.name!r}: its test {name!r} has no sequence; give it at least one Scenario"
                )
        return scenarios

    @cached_property
    def metrics(self) -> Mapping[str, Metric]:
        """Every metric of the case by its name: the common ones, that of the MVs' travel in its unit, and its own."""
        mv = self.plant_class.mv_signals[0].unit
        travel = replace(METRICS[TRAVEL], unit=SHARES_OF_RANGES if self.travel_in_shares else mv)
        return METRICS | {travel.name: travel} | {metric.name: metric for metric in self.own_metrics}

    @property
    def travel_in_shares(self) -> bool:
        """Whether the MVs' travel counts in % of their ranges: a sum of their own units would mean nothing."""
        return len({s.unit for s in self.plant_class.mv_signals}) > 1

    @property
    def criterion(self) -> Metric:
        """The metric that laws are compared by."""
        return self.metrics[self.metric]

    @property
    def unit(self) -> str:
        """The unit of that metric; empty for a plain number."""
        return self.criterion.unit_of(self.cv_unit)

    @property
    def foreseen(self) -> bool:
        """Whether the bounds may use the future set points: of a recipe, or of a reference model."""
        return self.recipe or self.criterion.reference

    @property
    def cv_unit(self) -> str:
        """The unit of the controlled variable."""
        return self.plant_class.sp_signals[0].unit

    def label(self, metric: str) -> str:
        """Words and unit of a metric for a table head; for a path into a model set, of the part before the dot."""
        first = metric.partition(".")[0]
        known = self.metrics.get(metric) or self.metrics.get(first)
        return first.replace("_", " ") if known is None else known.label(self.cv_unit)

    def with_held_out(self, seeds: tuple[int, ...]) -> Self:
        """The case scored on other held-out sequences."""
        return replace(self, held_out_seeds=seeds)

    def mv_shares(self, mv: Array) -> Array:
        """MVs (n, n_mv) in % of the widths of their ranges."""
        return 100 * mv / np.array([s.high - s.low for s in self.plant.mv_signals])

    def score(self, test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
        """Figures of one closed loop from the noise-free process variables pv (n, n_pv) and mv (n, n_mv).

        A case with more figures than ``closed_loop_metrics`` adds its own.
        """
        span = self.spans[0]
        moved = self.mv_shares(mv) if self.travel_in_shares else mv
        figures = closed_loop_metrics(test.sp, pv, moved, test.hold, self.plant.period_s, span, test.late_from)
        if test.reference is not None:
            figures["tracking"] = rmse(test.reference, pv[:, : test.reference.shape[1]])
        return figures

    @abstractmethod
    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        """The tests by name, each as its scenarios.

        A test of several random sequences has one scenario for each sequence; ``together`` combines
        their figures. The other tests have one scenario.
        """

    def unscored(self) -> Mapping[str, Scenario]:
        """Further tests by name, for pictures only: their curves are stored, their figures are not."""
        return {}

    def variants_run(self, tests: tuple[Scenario, ...]) -> bool:
        """Whether a law's variants run this test; by default if it has one sequence, as in papers."""
        return len(tests) == 1

    @abstractmethod
    def development(self) -> tuple[Scenario, ...]:
        """Sequences for tuning and for choosing among candidates; never scored."""

    def developed(self, errors: Sequence[float]) -> float:
        """The mean of a law's errors over the development sequences, nan of none; see ``development_geometric``."""
        if not errors or not self.development_geometric:
            return statistics.fmean(errors) if errors else math.nan
        # An error of none counts as the least of the others: no sequence decides alone.
        least = min((error for error in errors if error > 0), default=0.0)
        return float(statistics.geometric_mean(np.maximum(errors, least))) if least else sum(errors)
