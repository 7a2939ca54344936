"""A made column with a temperature, an analyser that is seldom and late, and a pressure that is only kept in its range.

    tau_ij g_ij'' ... : every output is the sum over the inputs of K_ij / ((tau_ij s + 1)(0.3 tau_ij s + 1)) of u_j

The analyser takes its sample ``LATE`` rows before it has the number, and has one every ``EVERY`` rows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from benchmark_modules import FOLDER, benchmark_modules
from numpy.typing import NDArray

Array = NDArray[np.float64]

_COLUMN = benchmark_modules(("operated_plant", "analysed"), FOLDER / "operated_plants").analysed  # has its numbers
PERIOD_S = 60.0
EVERY, LATE, FAST = _COLUMN.EVERY, _COLUMN.LATE, _COLUMN.FAST
GAIN, LAG, MIDDLE, NOISE = _COLUMN.GAIN, _COLUMN.LAG, _COLUMN.MIDDLE, _COLUMN.NOISE
NAMES = ("TI-1.PV", "AI-1.PV", "PI-1.PV", "FV-1.OP", "FV-2.OP")
UNITS = ("degC", "%", "bar", "%", "%")


def moves(rows: int, rng: np.random.Generator) -> Array:
    """Random positions (rows, 2) of the valves [%], each held for 15 to 90 rows."""
    found = np.empty((rows, 2))
    for j in range(2):
        k = 0
        while k < rows:
            n = int(rng.integers(15, 90))
            found[k : k + n, j] = round(float(rng.uniform(30.0, 70.0)), 1)
            k += n
    return found


class Column:
    """The plant, a step a row; ``truth`` are its outputs without noise and without the analyser's lateness."""

    def __init__(self) -> None:
        self.x = np.zeros((2, *GAIN.shape))
        self.past = [np.zeros(3)] * (LATE + 1)

    def step(self, mv: Array) -> None:
        """A period under valves at ``mv`` (2,)."""
        a, b = np.exp(-1 / LAG), np.exp(-1 / (FAST * LAG))
        into = (mv - 50.0)[None, :]
        self.x[0] = b * self.x[0] + (1 - b) * into
        self.x[1] = a * self.x[1] + (1 - a) * self.x[0]
        self.past = [*self.past[1:], self.deviation]

    @property
    def deviation(self) -> Array:
        """Outputs (3,) from their middle."""
        return np.asarray((GAIN * self.x[1]).sum(axis=1))

    @property
    def truth(self) -> Array:
        """Outputs (3,) now."""
        return MIDDLE + self.deviation

    @property
    def late(self) -> Array:
        """Outputs (3,), the analyser's as it was ``LATE`` rows before."""
        return np.asarray(MIDDLE + np.where([False, True, False], self.past[0], self.past[-1]))


def made(rows: int, seed: int) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """(valves (rows, 2), late outputs without noise (rows, 3), readings (rows, 3), which are new (rows,)).

    Readings of the analyser stand between its new ones.
    """
    rng = np.random.default_rng(seed)
    u, plant = moves(rows, rng), Column()
    late = np.empty((rows, 3))
    for k in range(rows):
        late[k] = plant.late
        plant.step(u[k])
    read = late + NOISE * rng.standard_normal(late.shape)
    fresh = np.arange(rows) % EVERY == int(rng.integers(EVERY))
    last = np.maximum.accumulate(np.where(fresh, np.arange(rows), -1))
    read[:, 1] = np.where(last >= 0, read[np.maximum(last, 0), 1], read[0, 1])
    return u, late, read, fresh


def write_export(path: Path, rows: int, seed: int, *, missing: bool = False) -> None:
    """The record as an export; with ``missing`` the analyser's cells between new readings are empty."""
    u, _, read, fresh = made(rows, seed)
    lines = ["time," + ",".join(f"{name} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True))]
    for k in range(rows):
        cells = [f"{v:.6g}" for v in (*read[k], *u[k])]
        if missing and not fresh[k]:
            cells[1] = ""
        lines.append(f"{PERIOD_S * k:g}," + ",".join(cells))
    path.write_text("\n".join(lines) + "\n")
