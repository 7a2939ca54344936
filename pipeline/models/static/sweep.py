"""The partition sweep: one RBF network for every number of fuzzy sets, and what each is worth."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.files import write_json
from loopwright.pipeline.metrics import per_region, r2, rmse
from loopwright.pipeline.models.static.fuzzy_means import (
    check_parameters,
    grid_points,
    scaling,
    select_centres,
    to_grid,
)
from loopwright.pipeline.models.static.least_squares import solve_iterative
from loopwright.pipeline.models.static.rbf import DESIGN_ROWS, Basis, design_matrix
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
