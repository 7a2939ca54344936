"""validation.json: what was found of a case's laws, for programs. This module alone writes and reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Self

from pipeline.config.params import parse
from pipeline.errors import ParamsError, PipelineError

SCHEMA = 1
"""Another meaning of an entry is another number; a new entry that has a default is not."""
FILE = "validation.json"
Row = Mapping[str, int | float]
"""Figures by metric; of a law also ``<criterion>_min`` and ``<criterion>_max`` over the seeds, and ``seeds``."""


@dataclass(frozen=True, slots=True)
class Statement:
    """A requirement or a claim in words, what was measured, and whether it holds; None: not measured."""

    what: str
    limit: str  # of a requirement what was asked, empty for a claim
    measured: str
    holds: bool | None
    because: str = ""


@dataclass(frozen=True, slots=True)
class PaperResult:
    """A figure of the paper's tables beside ours; ``paper`` is None where the paper prints none."""

    table: int
    label: str
    metric: str
    paper: float | None
    ours: float | None
    verdict: str
    holds: bool | None


@dataclass(frozen=True, slots=True)
class Analysis:
    """What one form of a law says of itself apart from its tests."""

    figures: Row = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LawResult:
    """What was found of a law apart from its figures.

    ``locked_up``: test -> data seed -> closed loops that got stuck. ``as_printed``: a reproduction of a paper's
    law, which is shipped all the same. ``analysis``: by the form's name, ``base`` for the shipped one.
    """

    seeds: int
    lock_ups: int | None
    step_us: float | None
    locked_up: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    as_printed: bool = False
    analysis: Mapping[str, Analysis] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class GateResult:
    """A law at the promotion gate: its score, lower is better, and its ratio in each test of the gate."""

    score: float | None
    lock_ups: int | None
    ratios: Row


@dataclass(frozen=True, slots=True)
class GateRecord:
    """The promotion gate: what it measures, and each law's result.

    ``floor`` is the standard deviation of the noise, ``floors`` what it makes of each scenario in the case's metric.
    """

    id: str
    weights: Row
    baseline: str
    baseline_name: str
    floor: float
    floors: Row
    laws: Mapping[str, GateResult]


@dataclass(frozen=True, slots=True)
class Titles:
    """Words for a person: of the case, of its metric, of its own figures, of laws and tests."""

    case: str
    metric: str
    metric_short: str
    figures: Mapping[str, str]
    laws: Mapping[str, str]
    scenarios: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Validation:
    """The whole file. ``metric`` is the one that laws are compared by, ``main`` the test that weighs most.

    ``scenarios``: test -> law -> figures, medians over the data seeds; ``bounds``: test -> bound -> figures.
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
    requirements: tuple[Statement, ...]
    claims: tuple[Statement, ...]
    paper: tuple[PaperResult, ...]

    def to_json(self) -> str:
        """The file's text; entries that equal their default are left out. ValueError for NaN and infinity."""
        return json.dumps({"schema": SCHEMA, **_plain(self)}, indent=1, allow_nan=False) + "\n"

    @classmethod
    def read(cls, path: Path) -> Self:
        """The file's content; PipelineError names what is wrong with it and the remedy."""
        try:
            tree = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise PipelineError(f"{path} cannot be read ({error}); {REMEDY}") from None
        version = tree.pop("schema", None) if isinstance(tree, dict) else None
        if version != SCHEMA:
            raise PipelineError(f"{path} has schema {version!r}; this release reads schema {SCHEMA}: {REMEDY}")
        try:
            return parse(cls, tree, str(path))
        except ParamsError as error:
            raise PipelineError(f"{error}; {REMEDY}") from None

    def bound(self, test: str, kind: str = "nmpc") -> float | None:
        """A bound's figure in the case's metric; None where none was computed."""
        return self.bounds.get(test, {}).get(kind, {}).get(self.metric)

    def floor(self, test: str) -> float:
        """The error that noise would hide in a test, whose name is given without the suffix of noise."""
        return self.gate.floors.get(test, self.gate.floor)


REMEDY = "run `dvc repro`, which writes it again"


def _plain(value: Any) -> Any:
    """Dataclasses, mappings and tuples as JSON has them."""
    if is_dataclass(value):
        return {f.name: _plain(v) for f in fields(value) if (v := getattr(value, f.name)) != _default(f)}
    if isinstance(value, Mapping):
        return {key: _plain(v) for key, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _default(f: Any) -> Any:
    return f.default if f.default_factory is MISSING else f.default_factory()
