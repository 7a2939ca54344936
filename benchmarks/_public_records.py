"""Public records of nonlinear plants: their files, their rows to learn and to test, and what is published of them.

A folder holds the files, flat or in folders of any name, as .csv (a head of column names, each column as long as it
is) or as .mat with variables of the same names:

    tanks      dataBenchmark    uEst, yEst: 1,024 rows to learn; uVal, yVal: 1,024 rows to test; 4 s      [V]
    drives_low, drives_high   DATAUNIF    u11, z11 and u12, z12: 500 rows each, the first 400 to learn; 20 ms
    emps       DATA_EMPS, DATA_EMPS_PULSES   vir [N], qm [m]: 1 ms; the first file to learn, the second to test
    silverbox  SNLS80mV         V1, V2: 131,072 rows, of which 40,650 to 105,712 to learn (the multisine), those to
               127,400 to test, and 100 to 40,575 (the arrow, whose end leaves the range that was learnt); 610 Hz  [V]
    wiener_hammerstein   WienerHammerBenchMark   uBenchMark, yBenchMark: 188,000 rows, of which 5,200 to 105,200 to
               learn, and those to 184,000 to test; 51.2 kHz     [V]
    bouc_wen   uval_multisine, yval_multisine, uval_sinesweep, yval_sinesweep: rows to test alone; 750 Hz   [N], [m]

These are the splits of the package nonlinear_benchmarks (G. Beintema). The initial state of a test is fitted to
its first rows, which do not count. EMPS rows are thinned to 10 ms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _free_run import Array, Part, Task
from _made_records import BOUC_WEN_BEGIN, BOUC_WEN_PERIOD_S, bouc_wen_learn
from scipy.io import loadmat

Columns = Mapping[str, Array]


@dataclass(frozen=True)
class Published:
    """RMSE over the test rows as others report it; empty where we know of none."""

    linear: str = ""
    black_box: str = ""
    grey_box: str = ""


@dataclass(frozen=True)
class Public:
    """A public record: its files, how they become a task, the unit of the figures, and what is published by test."""

    files: tuple[str, ...]
    task: Callable[[list[Columns]], Task]
    unit: str
    published: Mapping[str, Published]


def columns(path: Path) -> dict[str, Array]:
    """Name -> values (n,) of a .mat or .csv file, without the empty cells behind a short column."""
    if path.suffix.lower() == ".mat":
        return {k: np.ravel(v).astype(np.float64) for k, v in loadmat(path).items() if not k.startswith("__")}
    with path.open(encoding="utf-8-sig") as file:
        names = [name.strip().strip('"') for name in file.readline().rstrip("\n").split(",")]
        table = np.genfromtxt(file, delimiter=",", usecols=range(len(names)), invalid_raise=False)
    return {name: column[~np.isnan(column)] for name, column in zip(names, table.T, strict=True) if name}


def file_of(folder: Path, name: str) -> Path | None:
    """The file of this name, .csv or .mat in any spelling, anywhere under the folder; the first by its path."""
    wanted = {f"{name}{end}".lower() for end in (".csv", ".mat")}
    return next((p for p in sorted(folder.rglob("*")) if p.name.lower() in wanted), None)


def public_task(folder: Path, name: str) -> Task | None:
    """The task of a public record; None where one of its files is not under the folder."""
    paths = [file_of(folder, file) for file in PUBLIC[name].files]
    there = [path for path in paths if path is not None]
    return PUBLIC[name].task([columns(path) for path in there]) if len(there) == len(paths) else None


# ---------------------------------------------------------------------- the records
def tanks(files: list[Columns]) -> Task:
    (f,) = files
    return Task(Part(f["uEst"], f["yEst"]), {"test": Part(f["uVal"], f["yVal"])}, 5, 4.0, overflows=True)


def drives(u: str, z: str) -> Callable[[list[Columns]], Task]:
    def task(files: list[Columns]) -> Task:
        (f,) = files
        return Task(Part(f[u][:400], f[z][:400]), {"test": Part(f[u][400:], f[z][400:])}, 4, 0.02)

    return task


def emps(files: list[Columns]) -> Task:
    learn, test = (Part(f["vir"][::10], f["qm"][::10]) for f in files)
    return Task(learn, {"test": test}, 20, 0.01, scale=1e3)


def silverbox(files: list[Columns]) -> Task:
    (f,) = files
    cut = {"learn": (40_650, 105_712), "multisine": (105_712, 127_400), "arrow": (100, 40_575)}
    parts = {name: Part(f["V1"][i:j], f["V2"][i:j]) for name, (i, j) in cut.items()}
    learn = parts.pop("learn")
    return Task(learn, parts, 50, 1 / 610.35, scale=1e3)


def wiener_hammerstein(files: list[Columns]) -> Task:
    (f,) = files
    u, y = f["uBenchMark"][5_200:184_000], f["yBenchMark"][5_200:184_000]
    return Task(Part(u[:100_000], y[:100_000]), {"test": Part(u[100_000:], y[100_000:])}, 50, 1 / 51_200, scale=1e3)


def bouc_wen(files: list[Columns]) -> Task:
    """The tests of the benchmark; the rows to learn are made, as the benchmark asks, by the equations it states."""
    u_multisine, y_multisine, u_sweep, y_sweep = (
        next(v for name, v in f.items() if name.lower().startswith(letter))
        for f, letter in zip(files, "uyuy", strict=True)
    )
    tests = {"multisine": Part(u_multisine, y_multisine), "sweep": Part(u_sweep, y_sweep)}
    return Task(bouc_wen_learn(np.random.default_rng(0)), tests, BOUC_WEN_BEGIN, BOUC_WEN_PERIOD_S, scale=1e6)


PUBLIC = {
    "tanks": Public(("dataBenchmark",), tanks, "V", {"test": Published(".588", ".306")}),
    "drives_low": Public(("DATAUNIF",), drives("u11", "z11"), "ticks/s", {"test": Published("", ".096")}),
    "drives_high": Public(("DATAUNIF",), drives("u12", "z12"), "ticks/s", {"test": Published("", ".074")}),
    "emps": Public(("DATA_EMPS", "DATA_EMPS_PULSES"), emps, "mm", {"test": Published("", "2.64")}),
    "silverbox": Public(("SNLS80mV",), silverbox, "mV", {"multisine": Published("", ".30 to .36")}),
    "wiener_hammerstein": Public(
        ("WienerHammerBenchMark",), wiener_hammerstein, "mV", {"test": Published("", ".24")}
    ),
    # J. P. Noel, A. F. Esfahani, G. Kerschen, J. Schoukens, arXiv 1610.09138: -98.32 dB of 1 m.
    "bouc_wen": Public(
        ("uval_multisine", "yval_multisine", "uval_sinesweep", "yval_sinesweep"),
        bouc_wen, "um", {"multisine": Published("", "12")},
    ),
}  # fmt: skip
