"""A plant without dirt and its export, for benchmarks that spoil it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.cleaning.tags import Tag

Array = NDArray[np.float64]
PERIOD_S = 6.0
START_S = 1_709_532_000.0  # 2024-03-04 06:00 UTC
ROWS = 4000
NOISE = 0.15
TAGS = (Tag("TIC-101.PV", "pv", "degC"), Tag("TIC-101.OP", "mv", "%"), Tag("FI-7", "dv", "kg/h"))


@dataclass(frozen=True)
class Columns:
    """Columns (n,) of an experiment."""

    time_s: Array
    pv: Array
    mv: Array
    dv: Array

    def with_(self, **columns: Array) -> Columns:
        """Some columns replaced."""
        return replace(self, **columns)


@cache
def experiment(seed: int, rows: int = ROWS) -> Columns:
    """Two lags of 10 and 4 samples, gain 0.8, dead time of two samples; a disturbance with a lag of its own.

    The valve moves every 10 to 60 samples, the flow every 20 to 120.
    """
    random = np.random.default_rng(seed)
    mv, dv = steps(random, rows, 20, 80, 10, 60), 500 + steps(random, rows, -50, 50, 20, 120)
    flow = dv + random.normal(0, 0.5, rows)
    y, inner, pv = 60.0, 60.0, np.empty(rows)
    for k in range(rows):
        pv[k] = y
        y += 0.25 * (inner - y)
        inner += 0.1 * (20 + 0.8 * mv[max(k - 2, 0)] - 0.05 * (flow[k] - 500) - inner)
    time_s = START_S + PERIOD_S * np.arange(rows)
    return Columns(time_s, np.round(pv + random.normal(0, NOISE, rows), 3), mv, np.round(flow, 2))


def steps(random: np.random.Generator, n: int, low: float, high: float, shortest: int, longest: int) -> Array:
    """Levels (n,) held for random times."""
    values, k = np.empty(n), 0
    while k < n:
        hold = int(random.integers(shortest, longest))
        values[k : k + hold], k = np.round(random.uniform(low, high), 1), k + hold
    return values


@dataclass(frozen=True)
class Export:
    """Files of an export: name -> header and rows of texts; tags and options of `loopwright new`, the usual if none."""

    files: dict[str, tuple[Sequence[str], Sequence[Sequence[str]]]]
    tags: tuple[Tag, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)
    separator: str = ","
    lower: float = 0.0  # by which the PV stands below the plant's

    def write(self, folder: Path) -> list[Path]:
        """The files in ``folder``, in their order."""
        paths = []
        for name, (header, rows) in self.files.items():
            out = io.StringIO()
            table = csv.writer(out, delimiter=self.separator, lineterminator="\n")
            table.writerow(header)
            table.writerows(rows)
            path = folder / name
            path.write_text(out.getvalue(), encoding="utf-8")
            paths.append(path)
        return paths


HEADER = ("timestamp", *(t.tag for t in TAGS))


def cells(data: Columns) -> list[list[str]]:
    """Rows of texts, NaN as an empty cell, times as epoch seconds."""
    columns = [[f"{v:.12g}" if np.isfinite(v) else "" for v in c] for c in (data.pv, data.mv, data.dv)]
    return [[f"{t:.3f}", *row] for t, *row in zip(data.time_s, *columns, strict=True)]


def export_of(data: Columns | Sequence[Sequence[str]], **more: Any) -> Export:
    """One file with the usual header."""
    rows = cells(data) if isinstance(data, Columns) else data
    return Export({"export.csv": (HEADER, rows)}, **more)


CLEAN = export_of(experiment(0))
