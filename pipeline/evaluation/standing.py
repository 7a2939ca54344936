"""How the laws of a case stand: what its validation.json says, as the overview and the terminal show it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pipeline.errors import PipelineError

NOISE = "_noise"  # the end of a test's name where it is run with measurement noise


@dataclass(frozen=True, slots=True)
class LawStanding:
    """One law on the test that weighs most in its case, in the case's metric."""

    law: str
    title: str
    best: bool  # of its case, by the development sequences
    figure: float | None  # median over the data seeds
    low: float | None
    high: float | None
    seeds: int | None
    lock_ups: int | None
    ratio: float | None  # to the bound, or to what noise would hide where the bound is less: ``Standing.hidden``
    step_us: float | None
    bytes: int | None  # size of the controller file


@dataclass(frozen=True, slots=True)
class Statement:
    """A requirement or a claim of the paper, what was measured, and whether it holds; None: not measured."""

    what: str
    limit: str  # of a requirement what was asked; empty for a claim
    measured: str
    because: str
    holds: bool | None


@dataclass(frozen=True, slots=True)
class Standing:
    """A case: its laws, the best figure first, and the verdicts about its paper."""

    case: str
    folder: Path
    title: str
    metric: str  # as it stands in a table
    metric_long: str
    test: str
    test_title: str
    bound: float | None  # of the perfect-model NMPC
    hidden: bool  # the bound is less than measurement noise would hide, which takes its place in the ratios
    laws: tuple[LawStanding, ...]
    requirements: tuple[Statement, ...]
    claims: tuple[Statement, ...]
    reproduced: tuple[int, int]  # figures of the paper's tables: those that do, and those that were measured

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The standing in ``folder``/validation.json; sizes are those of the controller files beside it.

        Raises PipelineError where it cannot be read.
        """
        path = folder / "validation.json"
        try:
            return cls._of(json.loads(path.read_text(encoding="utf-8")), folder)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise PipelineError(f"{path} cannot be read ({error!r}); run `dvc repro`") from error

    @classmethod
    def _of(cls, tree: Mapping[str, Any], folder: Path) -> Self:
        scenarios, titles = tree["scenarios"], tree.get("titles") or {}
        metric, gate = tree.get("metric", "mae"), tree.get("gate") or {}
        weights = gate.get("weights") or {}
        test = tree.get("main") or max(weights, key=lambda name: weights[name], default="")
        bare = test.removesuffix(NOISE)
        bound = ((tree.get("bounds") or {}).get(test) or {}).get("nmpc", {}).get(metric)
        floor = (gate.get("floors") or {}).get(bare, gate.get("floor", 0.0))
        names = dict.fromkeys(law for rows in scenarios.values() for law in rows)
        rows = {law: (scenarios.get(test) or {}).get(law) or {} for law in names}
        laws = [_law(tree, law, row, metric, bound, floor, folder) for law, row in rows.items()]
        # A row of a figure that the paper does not print stands beside another implementation's alone.
        printed = [row for row in tree.get("paper") or () if row["paper"] is not None]
        judged = [row["holds"] for row in printed if row["holds"] is not None]
        return cls(
            case=tree["case"],
            folder=folder,
            title=titles.get("case", tree["case"]),
            metric=titles.get("metric_short", metric.upper()),
            metric_long=titles.get("metric", metric),
            test=test,
            test_title=(titles.get("scenarios") or {}).get(bare, bare) + (" with noise" if test != bare else ""),
            bound=bound,
            hidden=bound is not None and bound < floor,
            laws=tuple(sorted(laws, key=lambda law: math.inf if law.figure is None else law.figure)),
            requirements=_statements(tree.get("requirements")),
            claims=_statements(tree.get("claims")),
            reproduced=(sum(judged), len(judged)),
        )

    @property
    def best(self) -> LawStanding | None:
        """The best law of the case."""
        return next((law for law in self.laws if law.best), None)


def tally(rows: tuple[Statement, ...]) -> tuple[int, int]:
    """How many hold, of those that were measured."""
    known = [row.holds for row in rows if row.holds is not None]
    return sum(known), len(known)


def _law(
    tree: Mapping[str, Any],
    law: str,
    row: Mapping[str, Any],
    metric: str,
    bound: float | None,
    floor: float,
    folder: Path,
) -> LawStanding:
    told = (tree.get("laws") or {}).get(law) or {}
    file = folder / f"{law}.onnx"
    own = row.get(metric)
    return LawStanding(
        law=law,
        title=((tree.get("titles") or {}).get("laws") or {}).get(law, law),
        best=law == tree.get("best"),
        figure=own,
        low=row.get(f"{metric}_min"),
        high=row.get(f"{metric}_max"),
        seeds=told.get("seeds", row.get("seeds")),
        lock_ups=told.get("lock_ups"),
        ratio=None if own is None or bound is None else _ratio(own, bound, floor),
        step_us=told.get("step_us"),
        bytes=file.stat().st_size if file.exists() else None,
    )


def _ratio(own: float, bound: float, floor: float) -> float | None:
    """Error over the bound's; where noise would hide the bound, over what it would hide, and no less than 1."""
    if bound >= floor:
        return own / bound if bound else None
    return max(own, floor) / floor


def _statements(rows: Any) -> tuple[Statement, ...]:
    return tuple(Statement(r["what"], r["limit"], r["measured"], r["because"], r["holds"]) for r in rows or ())
