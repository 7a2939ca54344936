"""The validation results of one law: its metrics.json, its figures and its loops."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.evaluation.operated import OperatedResult
from loopwright.pipeline.evaluation.typed_json import parsed, read_mapping, to_json
from loopwright.pipeline.files import write_text
from loopwright.pipeline.simulation import NOISE_SUFFIX
from loopwright.serving.certificate import Certificate

Array = NDArray[np.float64]
Loop = dict[str, Array]
Row = Mapping[str, int | float]  # figures by metric

METRICS_SCHEMA = 1
"""Schema of metrics.json. It changes with the meaning of an entry; a new entry with a default does not change it."""
BASE = "base"
"""The form of a law that is shipped; the others are its variants."""


@dataclass(frozen=True, slots=True)
class FormAnalysis:
    """Results of one form of a law that need no closed-loop test."""

    figures: Row = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    table: tuple[Row, ...] = ()  # of a search: a row for each trial


@dataclass(frozen=True, slots=True)
class OverSeeds:
    """Figures of one test over the data seeds."""

    median: Row
    min: Row
    max: Row
    per_seed: Mapping[str, Row]


@dataclass(frozen=True, slots=True)
class Form:
    """One form of a law: the shipped one, or a variant.

    ``setting`` holds what params.yaml gives this form itself, ``info`` the names of the trajectories' columns,
    ``tests`` the figures by test, those with noise under names of their own.
    """

    setting: Mapping[str, Any]
    info: tuple[str, ...]
    tests: Mapping[str, OverSeeds]
    analysis: FormAnalysis | None = None


@dataclass(frozen=True, slots=True)
class Cycle:
    """A CV that swings about its set point, or an MV about its mean, by +- ``amplitude`` [its unit].

    ``times``: how many times the limit the amplitude is.
    """

    signal: str
    unit: str
    amplitude: float
    period_s: float
    times: float

    @property
    def words(self) -> str:
        """``y0 swings by ± 0.3 m every 12 s``."""
        unit = "" if self.unit in {"", "-"} else f" {self.unit}"
        return f"{self.signal} swings by ± {self.amplitude:.2g}{unit} every {self.period_s:.3g} s"


@dataclass(frozen=True, slots=True)
class ColdStart:
    """Largest distances of the MVs that a law asks for, started cold at rests of the record, from the record's MVs.

    In % of the MV's range: ``first`` at the first step, ``later`` at those after it. ``mv`` is the MV that is farthest
    off, ``at`` the levels of PVs, MVs and measured disturbances at that rest. At a quarter of the rests no step is
    farther off than ``quarter``, of several files the worst one's. ``refused`` counts the rests at which a file refuses
    a step. Without ``rests`` there are no distances: the record has none, or none within the ranges of set points and
    MVs.
    """

    rests: int
    first: float | None = None
    later: float | None = None
    quarter: float | None = None
    mv: str = ""
    at: Mapping[str, float] = field(default_factory=dict)
    refused: int = 0

    @property
    def farthest(self) -> float | None:
        """The larger of both distances; None where no step was taken."""
        known = [away for away in (self.first, self.later) if away is not None]
        return max(known, default=None)


@dataclass(frozen=True, slots=True)
class LawMetrics:
    """metrics.json of one law, ``controllers.<case>-<name>``; this class alone writes and reads it.

    ``development``: data seed -> error over the development sequences (``Case.developed``), ``development_travel`` [MV]
    what the MVs travelled there, the mean of a sequence;
    ``locked_up``: test -> data seed -> closed loops that got stuck, of those where any did; ``as_printed``: a
    reproduction of a paper's law; ``sequences``: test -> seed of a sequence -> medians over the data seeds;
    ``forms``: the shipped one, BASE, and the variants by their names in params.yaml; ``reached``: PV or MV -> its
    lowest and highest value in closed loops without noise on models of a record, those gone wrong apart; ``replay``:
    MV -> figures of the shipped file over rows of that record; ``swings``: as ``locked_up``, loops that swing;
    ``at_rest``: test -> the error with the MVs left where they stand, of a case on models; ``cycles``: test -> the
    worst limit cycle of the shipped file; ``poor``: why a law that locked up nowhere is not shipped, a clause after its
    name, and what to do; ``beyond_reach``: as ``locked_up``, holds that count as no lock-up, because no control gets to
    their set point; ``calmed``: why the law's own numbers are not shipped, a clause after
    its name, where calmer ones hold; all figures are then of these; ``cold_start``: what the files ask for at rests of
    the record, of a case on models; ``operated``: test -> what came of it, of a law with ``operate``, by its shipped
    file; ``certificate``: that of the shipped file.
    """

    name: str
    title: str
    metric: str
    seeds: tuple[int, ...]
    shipped_seed: int
    forms: Mapping[str, Form]
    lock_ups: int = 0
    development_lock_ups: int = 0
    development: Mapping[str, float] = field(default_factory=dict)
    development_travel: Mapping[str, float] = field(default_factory=dict)
    locked_up: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    as_printed: bool = False
    sequences: Mapping[str, Mapping[str, Row]] = field(default_factory=dict)
    reached: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    replay: Mapping[str, Row] = field(default_factory=dict)
    swings: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    at_rest: Mapping[str, float] = field(default_factory=dict)
    cycles: Mapping[str, Cycle] = field(default_factory=dict)
    poor: str = ""
    beyond_reach: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    calmed: str = ""
    cold_start: ColdStart | None = None
    operated: Mapping[str, OperatedResult] = field(default_factory=dict)
    certificate: Certificate | None = None

    @property
    def why_withheld(self) -> str:
        """Why the law is not shipped, a clause after its name; empty where it is."""
        if self.lock_ups > 0 and not self.as_printed:
            return f"locked up or left its limits on {lock_up_text(self.locked_up)}"
        return self.poor

    def write(self, path: Path) -> None:
        """Write the file; ValueError for NaN and infinity."""
        write_text(path, to_json(self, METRICS_SCHEMA))

    @classmethod
    def read(cls, path: Path) -> LawMetrics:
        """The file's content; ReportError names what is wrong with it and the remedy."""
        return cls.of(read_mapping(path), str(path))

    @classmethod
    def of(cls, tree: Mapping[str, Any], where: str = "metrics.json") -> LawMetrics:
        """The mapping in such a file; ReportError names what is wrong with it and the remedy."""
        return parsed(cls, tree, where, METRICS_SCHEMA)


def without_noise(tests: Mapping[str, Mapping[str, int]]) -> dict[str, Mapping[str, int]]:
    """The tests in which nothing but the loop itself keeps a swing up: noise moves any loop."""
    return {test: seeds for test, seeds in tests.items() if not test.endswith(NOISE_SUFFIX)}


def lock_up_text(locked_up: Mapping[str, Mapping[str, int]]) -> str:
    """Tests with the data seeds that locked up, or swing, in them: ``held_out (seeds 0, 3), step (seed 1)``."""
    return ", ".join(
        f"{test} (seed{'s' if len(seeds) > 1 else ''} {', '.join(seeds)})" for test, seeds in locked_up.items()
    )


@dataclass(frozen=True, slots=True)
class LawEvidence:
    """The validation results of one law: metrics.json, the median time of a step, and the loops on demand."""

    metrics: LawMetrics
    trajectories: Path
    step_us: float | None = None  # None: not timed

    @property
    def title(self) -> str:
        """The law in words."""
        return self.metrics.title

    @property
    def seeds(self) -> int:
        """Number of data seeds: each trained its own networks."""
        return len(self.metrics.seeds)

    @property
    def lock_ups(self) -> int:
        """Closed loops that got stuck, over all seeds and scenarios."""
        return self.metrics.lock_ups

    @property
    def withheld(self) -> bool:
        """Whether it is not shipped: it locked up, and reproduces no paper, or its tests show it to be poor."""
        return bool(self.why_withheld)

    @property
    def why_withheld(self) -> str:
        """Why it is not shipped, a clause after its name; empty where it is."""
        return self.metrics.why_withheld

    @property
    def development(self) -> float | None:
        """Median of the data seeds' errors over the development sequences, in the case's metric.

        None with a lock-up there, or where nothing was measured.
        """
        errors = self.metrics.development.values()
        return None if not errors or self.metrics.development_lock_ups else statistics.median(errors)

    @property
    def development_travel(self) -> float:
        """Median of the data seeds' travel of the MVs over the development sequences; infinite without an error."""
        travels = self.metrics.development_travel.values()
        return math.inf if not travels or self.development is None else statistics.median(travels)

    def form_of(self, setting: Mapping[str, Any]) -> str | None:
        """Name of the form whose numbers, words and switches are the shipped ones but for ``setting``; BASE first."""
        shipped = _naming(self.metrics.forms[BASE].setting)
        forms = {name: {**shipped, **_naming(form.setting)} for name, form in self.metrics.forms.items()}
        return next((name for name, own in forms.items() if own == {**shipped, **setting}), None)

    def form(self, setting: Mapping[str, Any]) -> Form | None:
        """The form with this setting; None where it was not validated."""
        name = self.form_of(setting)
        return None if name is None else self.metrics.forms[name]

    @property
    def analyses(self) -> dict[str, FormAnalysis]:
        """The analysis of every form that has one, by the form's name."""
        return {name: form.analysis for name, form in self.metrics.forms.items() if form.analysis is not None}

    def analysis_arrays(self, setting: Mapping[str, Any]) -> Loop:
        """Arrays of the analysis by name; empty where none were kept."""
        start = f"{self.form_of(setting)}/"
        return arrays(self.trajectories.with_name("analysis.npz"), start)

    def loop(self, scenario: str, setting: Mapping[str, Any]) -> Loop | None:
        """Trajectory of the shipped data seed, arrays (n, ...) by field; None where none was stored.

        The first one, where a test has several sequences or several draws of the noise.
        """
        start = f"{scenario}/{self.form_of(setting)}/{self.metrics.shipped_seed}/"
        return arrays(self.trajectories, start) or None

    def cycling(self) -> Loop:
        """Arrays of the loop with the worst limit cycle by name, see ``worst_cycle``; empty where there is none."""
        return arrays(self.trajectories, "cycling/")

    def operated(self, test: str) -> Loop:
        """Arrays of the loop of a test in which operators change something by name; empty where it did not run."""
        return arrays(self.trajectories.with_name("operated.npz"), f"{test}/")

    def replay(self) -> Loop:
        """Arrays of the replay over the plant's record by name; empty where there was none."""
        return arrays(self.trajectories.with_name("replay.npz"))


def _naming(setting: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers, words and switches of a setting, which tell forms apart; a list or a mapping names no form."""
    return {key: value for key, value in setting.items() if isinstance(value, (int, float, str))}


def arrays(path: Path, start: str = "") -> Loop:
    """Arrays of an .npz whose names begin with ``start``, by the rest of the name; empty where there is no file."""
    if not path.exists():
        return {}
    with np.load(path, allow_pickle=False) as file:
        return {k.removeprefix(start): np.asarray(file[k], float) for k in file.files if k.startswith(start)}
