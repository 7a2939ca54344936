"""A clean export of a small plant in memory, for tests that spoil it: T [degC] answers to a valve and a flow."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from loopwright.pipeline.historian.cleaning.tags import Tag, named
from loopwright.pipeline.historian.files.file_reader import read_export
from loopwright.pipeline.historian.screening import Screened, screen_export

PERIOD_S = 6.0
START_S = 1_709_532_000.0  # 2024-03-04 06:00 UTC
TAGS = (Tag("TIC-101.PV", "pv", "degC"), Tag("TIC-101.OP", "mv", "%"), Tag("FI-7", "dv", "kg/h"))


@dataclass(frozen=True)
class Clean:
    """Columns (n,) each; a test replaces some of them."""

    time_s: np.ndarray
    pv: np.ndarray
    mv: np.ndarray
    dv: np.ndarray

    def with_(self, **columns: np.ndarray) -> Clean:
        return replace(self, **columns)


def clean(n: int = 1500, seed: int = 0, noise: float = 0.1) -> Clean:
    """y(k+1) = y + 0.1 (20 + 0.8 u(k-2) - 0.02 (d - 500) - y), with steps of u and d of 10 to 60 rows."""
    random = np.random.default_rng(seed)
    mv, dv = steps(random, n, 20, 80), 500 + steps(random, n, -50, 50)
    pv = np.round(answer(mv, dv) + random.normal(0, noise, n), 3)
    return Clean(START_S + PERIOD_S * np.arange(n), pv, mv, np.round(dv + random.normal(0, 0.5, n), 2))


def spoilt(**columns: np.ndarray) -> Clean:
    """The clean export of 1,500 rows with other inputs, and the PV's answer to them."""
    data = clean().with_(**columns)
    noise = np.random.default_rng(2).normal(0, 0.1, len(data.pv))
    return data.with_(pv=answer(data.mv, data.dv) + noise)


def answer(mv: np.ndarray, dv: np.ndarray) -> np.ndarray:
    """The PV (n,) without noise under inputs (n,) each."""
    y = np.full(len(mv), 55.0)
    for k in range(len(mv) - 1):
        y[k + 1] = y[k] + 0.1 * (20 + 0.8 * mv[max(k - 2, 0)] - 0.02 * (dv[k] - 500) - y[k])
    return y


def steps(random: np.random.Generator, n: int, low: float, high: float) -> np.ndarray:
    values = np.empty(n)
    k = 0
    while k < n:
        hold = int(random.integers(10, 60))
        values[k : k + hold], k = np.round(random.uniform(low, high), 1), k + hold
    return values


def cells(data: Clean) -> list[list[str]]:
    """Rows of texts, NaN as an empty cell; times as epoch seconds."""
    columns = [[f"{v:.12g}" if np.isfinite(v) else "" for v in c] for c in (data.pv, data.mv, data.dv)]
    return [[f"{t:.3f}", *row] for t, *row in zip(data.time_s, *columns, strict=True)]


def write(
    path: Path, rows: Sequence[Sequence[str]], header: Sequence[str] = ("", *(t.tag for t in TAGS)), sep: str = ","
) -> Path:
    out = io.StringIO()
    table = csv.writer(out, delimiter=sep, lineterminator="\n")
    table.writerow([header[0] or "timestamp", *header[1:]])
    table.writerows(rows)
    path.write_text(out.getvalue(), encoding="utf-8")
    return path


def screen(path: Path, tags: Sequence[Tag] = TAGS, time_zone: str = "", **options: object) -> Screened:
    own = named(tags)
    values, modes = ([t.tag for t in own if (t.role == "mode") is m] for m in (False, True))
    return screen_export("plant", read_export([path], values, modes, time_zone=time_zone), own, **options)


def screen_of(data: Clean, folder: Path, tags: Sequence[Tag] = TAGS, **options: object) -> Screened:
    return screen(write(folder / "export.csv", cells(data)), tags, **options)
