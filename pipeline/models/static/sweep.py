"""The partition sweep: a fuzzy-means RBF network for every number of fuzzy sets, and the part that learns it so."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.files import write_json
from loopwright.pipeline.metrics import per_region, r2, rmse
from loopwright.pipeline.models.base import Model
from loopwright.pipeline.models.part import Learnt, Source, StaticPart, predict
from loopwright.pipeline.models.static.fuzzy_means import (
    check_parameters,
    grid_points,
    scaling,
    select_centres,
    solve_iterative,
    to_grid,
)
from loopwright.pipeline.models.static.rbf import DESIGN_ROWS, RBF, Basis, design_matrix
from loopwright.pipeline.models.training.regressors import Pairs
from loopwright.pipeline.plants.simulator import Array

Regions = Mapping[str, tuple[float, float]]
SWEEP_PIECES = 12  # pieces of a sweep


@dataclass(frozen=True, slots=True)
class Score:
    """Fit of one set of samples: RMSE [the output's unit], R2 [-] and the RMSE of each region."""

    rmse: float
    r2: float
    regions: dict[str, float]


@dataclass(frozen=True, slots=True)
class SweepRow:
    """One number of partitions: the network's size and its fit."""

    partitions: int
    centres: int
    train: Score
    validation: Score


@dataclass(frozen=True, slots=True)
class SweepResult:
    """All rows of a sweep, in the order of the partitions; ``unit`` is the output's."""

    rows: tuple[SweepRow, ...]
    unit: str = ""

    @property
    def best(self) -> SweepRow:
        """The row with the smallest RMSE on the validation data."""
        return min(self.rows, key=lambda row: row.validation.rmse)

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON-ready values, with the chosen partitions beside the rows."""
        return {"chosen": self.best.partitions, "unit": self.unit, "rows": [asdict(row) for row in self.rows]}

    def save(self, path: Path) -> None:
        """Write the result as JSON."""
        write_json(path, self.to_dict())


def sweep(
    x_train: Array,
    y_train: Array,
    x_val: Array,
    y_val: Array,
    *,
    partitions: Iterable[int] = range(4, 101),
    limits: tuple[float, float] | None = None,
    regions: Regions | None = None,
    basis: Basis = "thin_plate",
    width: float = 0.5,
    ridge: float = 0.0,
    unit: str = "",
) -> SweepResult:
    """Fit and score a network for every number of partitions.

    ``x_*`` (K, n_in) and ``y_*`` (K,) or (K, n_out) in engineering units; ``limits`` bounds every
    prediction before it is scored; ``regions`` (name -> (low, high), as ``plant.regions``) are ranges
    [low, high) of the first input.

    The weights come from ``solve_iterative``, whose predictions differ from those of the full QR by
    1e-5 of the residual: far below what tells two partitions apart. All large arrays are written
    into two buffers that a share of the numbers allocates once. Fit the chosen network again with ``FuzzyMeansRBF``.

    A bar shows the progress on a terminal; elsewhere one line says that it is done and how long it took.
    The result holds no duration: equal data give an equal result, byte for byte.
    """
    counts = sorted(set(partitions))
    if not counts:
        raise ModelError("the sweep has no partitions; give at least one number, such as range(4, 101)")
    for c in counts:
        check_parameters(c, basis, width, ridge)
    x_train, x_val = (_table(a) for a in (x_train, x_val))
    y_train, y_val = (_table(a.reshape(len(a), -1)) for a in (np.asarray(y_train), np.asarray(y_val)))
    if len(x_train) != len(y_train) or len(x_val) != len(y_val):
        raise ModelError(
            f"inputs and outputs differ in length: {len(x_train)} and {len(y_train)} rows for training, "
            f"{len(x_val)} and {len(y_val)} for validation; give one output row for every input row"
        )
    begun = time.perf_counter()
    low, span = scaling(x_train)
    u_train, u_val = (2.0 * (x - low) / span - 1.0 for x in (x_train, x_val))
    data = (_Half(x_train, u_train, y_train), _Half(x_val, u_val, y_val))
    # Small and large networks in each share, so that shares take about as long.
    shares = [counts[i::SWEEP_PIECES] for i in range(min(SWEEP_PIECES, len(counts)))]
    fit = partial(_rows, data, limits=limits, regions=regions or {}, basis=basis, width=width, ridge=ridge)
    found = [row for rows in parallel_map(fit, shares, "sweep: networks of every number of partitions") for row in rows]
    rows = sorted(found, key=lambda row: row.partitions)
    result = SweepResult(tuple(rows), unit)
    if not sys.stderr.isatty():
        best, took = result.best, f"{time.perf_counter() - begun:.0f} s"
        found_best = f"sweep: {len(rows)} networks, best c = {best.partitions}, {best.centres} centres ({took})"
        print(found_best, file=sys.stderr, flush=True)
    return result


@dataclass(frozen=True)
class _Half:
    """Training or validation data: inputs (K, n_in) as they are and scaled to [-1, 1], outputs (K, n_out)."""

    x: Array
    u: Array
    y: Array


def _rows(
    data: tuple[_Half, _Half],
    counts: Sequence[int],
    *,
    limits: tuple[float, float] | None,
    regions: Regions,
    basis: Basis,
    width: float,
    ridge: float,
) -> list[SweepRow]:
    """The rows of some numbers of partitions."""
    train, validation = data

    def score(half: _Half, prediction: Array) -> Score:
        limited = prediction if limits is None else prediction.clip(*limits)
        by_region = per_region(rmse, half.y, limited, half.x[:, 0], regions)
        return Score(rmse(half.y, limited), r2(half.y, limited), by_region)

    selected = [select_centres(train.u, c) for c in counts]
    largest = max(len(index) for index in selected)
    buffer = torch.empty(max(len(train.u), len(validation.u)) * largest, dtype=torch.float64)
    work = torch.empty(DESIGN_ROWS * largest, dtype=torch.float64)
    rows = list[SweepRow]()
    for c, index in zip(counts, selected, strict=True):
        centres = torch.from_numpy(grid_points(index, c))
        z = design_matrix(torch.from_numpy(train.u), centres, basis, width, out=buffer, work=work)
        w = solve_iterative(z, torch.from_numpy(train.y), _cells(to_grid(train.u, c)[1]), ridge)
        fitted = score(train, torch.mm(z, w).numpy())
        z = design_matrix(torch.from_numpy(validation.u), centres, basis, width, out=buffer, work=work)
        rows.append(SweepRow(c, len(index), fitted, score(validation, torch.mm(z, w).numpy())))
    return rows


def _table(values: Array) -> Array:
    """A float64 copy (K, n), finite."""
    table = np.array(values, dtype=np.float64)
    if table.ndim != 2 or not len(table) or not np.isfinite(table).all():
        raise ModelError(f"data of shape {table.shape} cannot be swept; give a (K, n) table of finite numbers")
    return table


def _cells(near: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of the grid cell of each sample: 0, 1, ... over the cells that have any.

    Column by column, so that no number reaches c^N.
    """
    cell = np.zeros(len(near), dtype=np.int64)
    for column in near.T:
        cell = np.unique(cell * (int(column.max()) + 1) + column, return_inverse=True)[1]
    return cell


# ------------------------------------------------------------------------------ how a fuzzy-means RBF network is learnt
if TYPE_CHECKING:
    from loopwright.pipeline.models.static.sweep import SweepResult


@dataclass(frozen=True, kw_only=True)
class RbfPart(StaticPart):
    """A fuzzy-means RBF network.

    ``partitions`` c fuzzy sets an input; ``basis``, ``width``, ``ridge`` as in FuzzyMeansRBF; ``sweep``
    [first, last] partitions to try on the data seed ``sweep_seed``, for the picture, none where empty.
    """

    model: ClassVar[type[Model]] = RBF
    partitions: int = 10
    basis: Basis = "thin_plate"
    width: float = 0.5
    ridge: float = 0.0
    sweep: tuple[int, ...] = ()
    sweep_seed: int = 0

    def __post_init__(self) -> None:
        if self.sweep and (len(self.sweep) != 2 or not 2 <= self.sweep[0] <= self.sweep[1]):
            raise ValueError(f"sweep is {list(self.sweep)}; give [first, last] partitions, 2 <= first <= last")

    def learn(self, source: Source) -> Learnt:
        """Train by one least-squares fit, and sweep the partitions where asked to."""
        pairs = self.pairs(source)
        train, validation = pairs.split(self.train_fraction, self.split, source.seed)
        model, metrics = self._fit(train, validation, source)
        if self.split == "random":
            # Neighbours in time on both sides flatter a random split: the honest figure stands beside it.
            _, chronological = self._fit(*pairs.split(self.train_fraction, "time", source.seed), source)
            metrics["time_split"] = {k: chronological[k] for k in ("rmse", "r2", "centres")}
        swept = self._swept(train, validation, source) if self.sweep and source.seed == self.sweep_seed else None
        shown = validation.take(np.arange(min(400, len(validation))))
        predictions = {
            "time_s": source.data(self.model.kind).time_s[shown.row],
            "actual": shown.y[:, 0],
            "predicted": self.limited(predict(model, shown.x), source.signals)[:, 0],
        }
        return Learnt(model, metrics, swept, predictions)

    def _fit(self, train: Pairs, validation: Pairs, source: Source) -> tuple[Model, dict[str, Any]]:
        from loopwright.pipeline.models.static.fuzzy_means import (
            FuzzyMeansRBF,  # scikit-learn is slow to import, few need it
        )

        estimator = FuzzyMeansRBF(self.partitions, basis=self.basis, width=self.width, ridge=self.ridge)
        model = estimator.fit(train.x, train.y).to_torch()
        metrics = self.scored(model, validation, source)
        return model, metrics | {"centres": len(estimator.centres_), "c": self.partitions, "n_train": len(train)}

    def _swept(self, train: Pairs, validation: Pairs, source: Source) -> SweepResult:
        from loopwright.pipeline.models.static.sweep import sweep  # here, as above

        signals = source.signals
        data = train.x, train.y, validation.x, validation.y
        return sweep(
            *data,
            partitions=range(self.sweep[0], self.sweep[1] + 1),
            limits=self.limits(signals),
            regions=source.regions,
            basis=self.basis,
            width=self.width,
            ridge=self.ridge,
            unit=(signals.mv[0] if self.task == "inverse" else signals.pv[source.pv_index(self.target)]).unit,
        )
