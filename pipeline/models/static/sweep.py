"""The partition sweep: one RBF network for every number of fuzzy sets, and what each is worth."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.engine.progress import progress_bar
from pipeline.errors import ModelError
from pipeline.files import write_json
from pipeline.metrics import per_region, r2, rmse
from pipeline.models.static.fuzzy_means import check_parameters, grid_points, scaling, select_centres, to_grid
from pipeline.models.static.least_squares import solve_iterative
from pipeline.models.static.rbf import CHUNK, Basis, design_matrix
from pipeline.plants.simulator import Array

Regions = Mapping[str, tuple[float, float]]


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
    into two buffers that are allocated once. Fit the chosen network again with ``FuzzyMeansRBF``.

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
    low, span = scaling(x_train)
    u_train, u_val = (2.0 * (x - low) / span - 1.0 for x in (x_train, x_val))
    y = torch.from_numpy(y_train)

    def score(x: Array, target: Array, prediction: Array) -> Score:
        limited = prediction if limits is None else prediction.clip(*limits)
        by_region = per_region(rmse, target, limited, x[:, 0], regions or {})
        return Score(rmse(target, limited), r2(target, limited), by_region)

    begun = time.perf_counter()
    selected: list[NDArray[np.int64]] = []
    rows: list[SweepRow] = []
    with progress_bar() as bar:
        for c in bar.track(counts, description="choosing centres"):
            selected.append(select_centres(u_train, c))  # noqa: PERF401  # the bar follows a loop
        largest = max(len(index) for index in selected)
        buffer = torch.empty(max(len(u_train), len(u_val)) * largest, dtype=torch.float64)
        work = torch.empty(CHUNK * largest, dtype=torch.float64)
        for c, index in zip(bar.track(counts, description="fitting networks"), selected, strict=True):
            centres = torch.from_numpy(grid_points(index, c))
            z = design_matrix(torch.from_numpy(u_train), centres, basis, width, out=buffer, work=work)
            w = solve_iterative(z, y, _cells(to_grid(u_train, c)[1]), ridge)
            train = score(x_train, y_train, torch.mm(z, w).numpy())
            z = design_matrix(torch.from_numpy(u_val), centres, basis, width, out=buffer, work=work)
            validation = score(x_val, y_val, torch.mm(z, w).numpy())
            rows.append(SweepRow(c, len(index), train, validation))
    result = SweepResult(tuple(rows), unit)
    if not bar.console.is_terminal:
        best = result.best
        took = f"{time.perf_counter() - begun:.0f} s"
        bar.console.print(f"sweep: {len(rows)} networks, best c = {best.partitions}, {best.centres} centres ({took})")
    return result


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
