"""validation.json: the figures and verdicts of a case, for programs. This module alone writes and reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from loopwright.pipeline.evaluation.evidence_basis import Grounds
from loopwright.pipeline.evaluation.law_evidence import ColdStart, FormAnalysis, Row
from loopwright.pipeline.evaluation.metric import TRAVEL
from loopwright.pipeline.evaluation.operated import OperatedResult
from loopwright.pipeline.evaluation.typed_json import parsed, read_mapping, to_json

VALIDATION_SCHEMA = 1
"""It changes with the meaning of an entry; a new entry with a default does not change it."""
FILE = "validation.json"
RelativeTo: TypeAlias = Literal["nmpc", "baseline", "floor"]
"""The reference of a gate score: the perfect-model NMPC; the baseline; or the error that noise can hide."""


@dataclass(frozen=True, slots=True)
class CheckedStatement:
    """A requirement or a claim in words, what was measured, and whether it holds; None: not measured."""

    what: str
    limit: str  # the limit of a requirement; empty for a claim
    measured: str
    holds: bool | None
    because: str = ""


@dataclass(frozen=True, slots=True)
class PaperResult:
    """A figure of the paper's tables beside ours, None where ours was not measured."""

    table: int
    label: str
    metric: str
    paper: float
    ours: float | None
    verdict: str
    holds: bool | None


@dataclass(frozen=True, slots=True)
class LawResult:
    """A law's results beside its figures.

    ``locked_up``: test -> data seed -> closed loops that locked up. ``as_printed``: a reproduction of a paper's
    law, which is shipped nevertheless. ``analysis``: by the form's name, ``base`` for the shipped one. ``swings``: as
    ``locked_up``, closed loops that swing to the end. ``withheld``: why it is not shipped, a clause after its name.
    ``cold_start``: how far from the record's MVs it begins at rests of the record, of a case on models. ``operated``:
    test -> results where operators change more than set points, of a law with ``operate``.
    """

    seeds: int
    lock_ups: int | None
    step_us: float | None
    locked_up: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    as_printed: bool = False
    analysis: Mapping[str, FormAnalysis] = field(default_factory=dict)
    swings: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    withheld: str = ""
    cold_start: ColdStart | None = None
    operated: Mapping[str, OperatedResult] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class GateResult:
    """A law at the promotion gate: its score, lower is better, and its ratio in each test of the gate.

    ``worse``: the tests in which its error is larger than under the loop that the plant was run by before.
    """

    score: float | None
    lock_ups: int | None
    ratios: Row
    worse: tuple[str, ...] = ()


def reference_words(relative_to: RelativeTo, baseline: str) -> str:
    """The unit of a gate score, in words; ``baseline`` is the name of the case's baseline."""
    return {"nmpc": "the bound", "baseline": f"the {baseline}'s error", "floor": "the error that noise can hide"}[
        relative_to
    ]


@dataclass(frozen=True, slots=True)
class GateRecord:
    """The promotion gate: what it measures, and each law's result.

    ``floor`` is the standard deviation of the noise, ``floors`` the floor of each scenario in the case's metric.
    ``relative_to`` says what scores divide errors by, ``no_baseline`` why there is no baseline to beat.
    """

    id: str
    weights: Row
    baseline: str
    baseline_name: str
    floor: float
    floors: Row
    laws: Mapping[str, GateResult]
    relative_to: RelativeTo = "nmpc"
    no_baseline: str = ""

    @property
    def reference(self) -> str:
        """The unit of a score, in words."""
        return reference_words(self.relative_to, self.baseline_name)

    @property
    def times(self) -> str:
        """The same as short as a column's head: ``× NMPC``."""
        return "× " + {"nmpc": "NMPC", "baseline": self.baseline_name, "floor": "noise floor"}[self.relative_to]


@dataclass(frozen=True, slots=True)
class Titles:
    """Words for a person: of the case, of its metric and its unit, of travel and its own figures, of laws and tests."""

    case: str
    metric: str
    metric_short: str
    figures: Mapping[str, str]
    laws: Mapping[str, str]
    scenarios: Mapping[str, str]
    unit: str = ""  # of the metric


@dataclass(frozen=True, slots=True)
class Validation:
    """The whole file. ``metric`` is the one that laws are compared by, ``main`` the test that weighs most.

    ``old_loop``: the law that the plant was run by before. ``on_models``: the tests ran on models of the plant's
    record; ``grounds`` are what they then rest on.
    ``scenarios``: test -> law -> figures, medians over the data seeds, with ``<criterion>_min`` and
    ``<criterion>_max`` over the seeds and their number, ``seeds``; ``bounds``: test -> bound -> figures.
    """

    case: str
    metric: str
    best: str | None
    main: str
    scenarios: Mapping[str, Mapping[str, Row]]
    bounds: Mapping[str, Mapping[str, Row]]
    gate: GateRecord
    laws: Mapping[str, LawResult]
    titles: Titles
    requirements: tuple[CheckedStatement, ...]
    claims: tuple[CheckedStatement, ...]
    paper: tuple[PaperResult, ...]
    on_models: bool = False
    old_loop: str = ""
    grounds: Grounds | None = None

    def to_json(self) -> str:
        """The file's text; ValueError for NaN and infinity."""
        return to_json(self, VALIDATION_SCHEMA)

    @classmethod
    def read(cls, path: Path) -> Validation:
        """The file's content; PipelineError names what is wrong with it and the remedy."""
        return parsed(cls, read_mapping(path), str(path), VALIDATION_SCHEMA)

    def bound(self, test: str, kind: str = "nmpc") -> float | None:
        """A bound's figure in the case's metric; None where none was computed."""
        return self.bounds.get(test, {}).get(kind, {}).get(self.metric)

    @property
    def of_each_cv(self) -> dict[str, str]:
        """Figure -> words and unit: the metric of each of several CVs, whose shares of ranges make up ``metric``."""
        figures = self.titles.figures.items() if self.on_models else ()
        return {name: words for name, words in figures if name.startswith(f"{self.metric}_")}

    @property
    def travel_words(self) -> str:
        """Words and unit of the MVs' travel; empty in a file of an older release, which may sum unlike units."""
        return self.titles.figures.get(TRAVEL, "")

    def floor(self, test: str) -> float:
        """The error that noise can hide in a test; ``test`` has no noise suffix."""
        return self.gate.floors.get(test, self.gate.floor)
