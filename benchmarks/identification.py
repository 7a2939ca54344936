"""Identification on public records: free-run error over their test rows beside published figures.

``python benchmarks/identification.py DIR [RECORD ...]``; a row a record whose files are in DIR, all with the defaults
of the part ``identified`` (member 0, and the pointwise median of the three members), for each of ``--seeds`` seeds of
the search. ``--screened`` passes the rows to learn through `loopwright new` first, as the export of a plant. This is
the way of a user, and `loopwright run` then has seed 0. The records are not part of this repository;
nonlinearbenchmark.org and its mirrors hold them. DIR holds, flat or in folders of any name, as .csv (a head of column
names, each column as long as it is) or as .mat with variables of the same names:

    tanks      dataBenchmark    uEst, yEst: 1,024 rows to learn; uVal, yVal: 1,024 rows to test; 4 s      [V]
    drives_low, drives_high   DATAUNIF    u11, z11 and u12, z12: 500 rows each, the first 400 to learn; 20 ms
    emps       DATA_EMPS, DATA_EMPS_PULSES   vir [N], qm [m]: 1 ms; the first file to learn, the second to test
    wiener_hammerstein   WienerHammerBenchMark   uBenchMark, yBenchMark: 188,000 rows, of which 5,200 to 105,200 to
               learn, and those to 184,000 to test; 51.2 kHz     [V]
    silverbox  SNLS80mV         V1, V2: 131,072 rows, of which 40,650 to 105,712 to learn (the multisine), those to
               127,400 to test, and 100 to 40,575 (the arrow, whose end leaves the range that was learnt); 610 Hz  [V]

These are the splits of the package nonlinear_benchmarks. The initial state of a test is fitted to its first rows
(5, 4, 20, 50 and 50), which do not count. The EMPS integrate: rows are thinned to 10 ms, the velocity (differences of
qm) is identified, and its free run summed up again. A record longer than ``--rows`` gives its most informative blocks.

Published figures: the best black-box model and the best linear one that the benchmark's pages or a survey list (RMSE).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from pipeline.config.exports import ExportedTag, ExportParams
from pipeline.historian.exported import screened_export, signal_tags
from pipeline.models.identified.dynamics import Dynamics, Stretch
from pipeline.models.identified.identified import Identified
from pipeline.models.identified.identified_part import IdentifiedPart
from pipeline.models.identified.output_error import fit_starts
from pipeline.models.part import Source
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array
from pipeline.records.record import Record
from serving.manifest import Signal


@dataclass(frozen=True, eq=False)
class Part:
    """Neighbouring rows of input u (n,) and output y (n,)."""

    u: Array
    y: Array


@dataclass(frozen=True, eq=False)
class Task:
    """Rows to learn, tests by name, rows that fit a test's initial state, and how a free run becomes the output."""

    learn: Part
    tests: Mapping[str, Part]
    begin: int
    period_s: float
    scale: float = 1.0  # of the figures
    summed: bool = False  # the output is the sum of what the model predicts


@dataclass(frozen=True)
class Public:
    """A public record: its files, how they become a task, unit of the figures, and what is published."""

    files: tuple[str, ...]
    task: Callable[[list[dict[str, Array]]], Task]
    unit: str
    published: str


def columns(path: Path) -> dict[str, Array]:
    """Name -> values (n,) of a .mat or .csv file, without the empty cells behind a short column."""
    if path.suffix.lower() == ".mat":
        return {k: np.ravel(v).astype(np.float64) for k, v in loadmat(path).items() if not k.startswith("__")}
    with path.open(encoding="utf-8-sig") as file:
        names = [name.strip().strip('"') for name in file.readline().rstrip("\n").split(",")]
        table = np.genfromtxt(file, delimiter=",", usecols=range(len(names)), invalid_raise=False)
    return {name: column[~np.isnan(column)] for name, column in zip(names, table.T, strict=True) if name}


def found(folder: Path, name: str) -> Path | None:
    """The file of this name, .csv or .mat in any spelling, anywhere under the folder; the first by its path."""
    wanted = {f"{name}{end}".lower() for end in (".csv", ".mat")}
    return next((p for p in sorted(folder.rglob("*")) if p.name.lower() in wanted), None)


# ---------------------------------------------------------------------- the records
def tanks(files: list[dict[str, Array]]) -> Task:
    (f,) = files
    return Task(Part(f["uEst"], f["yEst"]), {"test": Part(f["uVal"], f["yVal"])}, 5, 4.0)


def drives(u: str, z: str) -> Callable[[list[dict[str, Array]]], Task]:
    def task(files: list[dict[str, Array]]) -> Task:
        (f,) = files
        return Task(Part(f[u][:400], f[z][:400]), {"test": Part(f[u][400:], f[z][400:])}, 4, 0.02)

    return task


def emps(files: list[dict[str, Array]]) -> Task:
    learn, test = (Part(f["vir"][::10], f["qm"][::10]) for f in files)
    return Task(learn, {"test": test}, 20, 0.01, scale=1000.0, summed=True)


def wiener_hammerstein(files: list[dict[str, Array]]) -> Task:
    (f,) = files
    u, y = f["uBenchMark"][5_200:184_000], f["yBenchMark"][5_200:184_000]
    return Task(Part(u[:100_000], y[:100_000]), {"test": Part(u[100_000:], y[100_000:])}, 50, 1 / 51_200, scale=1000.0)


def silverbox(files: list[dict[str, Array]]) -> Task:
    (f,) = files
    cut = {"learn": (40_650, 105_712), "multisine": (105_712, 127_400), "arrow": (100, 40_575)}
    parts = {name: Part(f["V1"][i:j], f["V2"][i:j]) for name, (i, j) in cut.items()}
    learn = parts.pop("learn")
    return Task(learn, parts, 50, 1 / 610.35, scale=1000.0)


RECORDS = {
    "tanks": Public(("dataBenchmark",), tanks, "V", "black box .306, linear .588"),
    "drives_low": Public(("DATAUNIF",), drives("u11", "z11"), "ticks/s", "a trial .067, its best peer .096"),
    "drives_high": Public(("DATAUNIF",), drives("u12", "z12"), "ticks/s", "a trial .038, its best peer .074"),
    "emps": Public(("DATA_EMPS", "DATA_EMPS_PULSES"), emps, "mm", "black box 2.64"),
    "wiener_hammerstein": Public(("WienerHammerBenchMark",), wiener_hammerstein, "mV", "SUBNET .24, recurrent 4"),
    "silverbox": Public(("SNLS80mV",), silverbox, "mV", "black box .3 to .6"),
}


# ---------------------------------------------------------------------- one record
def record_of(part: Part, period_s: float) -> Record:
    """The rows as a record of one PV and one MV, with ranges that hold what was learnt."""
    low, high = float(part.u.min()), float(part.u.max())
    half = float(np.ptp(part.y))
    pv = Signal("y", "-", float(part.y.min()) - half, float(part.y.max()) + half)
    signals = Signals(period_s, (pv,), (pv,), (), (Signal("u", "-", low, high),))
    return Record.of(signals, part.y[:, None], part.u[:, None])


def screened_rows(part: Part, period_s: float) -> Record:
    """The rows as `loopwright new` keeps them of an export with the columns time_s, y (a PV) and u (an MV)."""
    tags = (ExportedTag("y", "pv"), ExportedTag("u", "mv"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "export.csv"
        rows = np.column_stack([period_s * np.arange(len(part.y)), part.y, part.u])
        np.savetxt(path, rows, delimiter=",", header="time_s,y,u", comments="", fmt="%.10g")
        return screened_export(ExportParams("record", (path,), tags), signal_tags(tags)).record


def velocity(part: Part) -> Part:
    """The differences of the output a row; the last input has none."""
    return Part(part.u[:-1], np.diff(part.y))


def free_run(model: Identified, part: Part, begin: int, same_row: bool) -> Array:
    """The model's output (n,) over all rows, its initial state fitted to the first ``begin``; NaN where it explodes."""
    of = {name: np.array(value.numpy()) for name, value in model.state_dict().items()}
    dynamics = Dynamics(*(of[name] for name in ("a", "b", "c", "w1", "b1", "w2")))
    u = np.append(part.u[1:], part.u[-1]) if same_row else part.u
    y, v = (part.y - of["y_center"]) / of["y_scale"], (u - of["v_center"]) / of["v_scale"]
    data = Stretch(y[:, None], v[:, None])
    start = fit_starts(dynamics, [Stretch(data.y[:begin], data.v[:begin])])[0]
    run = dynamics.free_run(start, data)
    if run is None:
        return np.full(len(y), np.nan)
    return np.asarray(run[0][:, 0] * of["y_scale"] + of["y_center"])


def row_of(
    name: str, task: Task, unit: str, published: str, part: IdentifiedPart, seed: int = 0, screened: bool = False
) -> str:
    """The row of one record and one seed of the search; ``screened``: learnt from what `loopwright new` keeps."""
    began = time.perf_counter()
    learn = velocity(task.learn) if task.summed else task.learn
    record = screened_rows(learn, task.period_s) if screened else record_of(learn, task.period_s)
    source = Source(record, record_signals(record), seed=seed)
    work = part.groundwork()
    source = replace(source, groundwork={work: work.done(source, name)})
    learnt = [replace(part, member=k).learn(source) for k in range(3)]
    minutes = (time.perf_counter() - began) / 60
    structure = learnt[0].metrics["structure"]
    cells = []
    for test, rows in task.tests.items():
        runs = []
        for one in learnt:
            assert isinstance(one.model, Identified)
            run = free_run(one.model, velocity(rows) if task.summed else rows, task.begin, structure["same_row"])
            runs.append(rows.y[0] + np.append(0.0, np.cumsum(run)) if task.summed else run)
        errors = [
            task.scale * float(np.sqrt(np.mean((r - rows.y)[task.begin :] ** 2)))
            for r in (runs[0], np.median(runs, axis=0))
        ]
        cells.append(f"{test}: {errors[0]:.4g}, median of members {errors[1]:.4g} {unit}")
    form = f"{structure['start']} {structure['order']} states, {structure['hidden']} units, {len(record)} rows"
    return f"{name:20} seed {seed}  {'; '.join(cells):70} {minutes:5.1f} min  ({published}; {form})"


def record_signals(record: Record) -> Signals:
    """The signals of a record of ``record_of``."""
    return Signals(record.period_s, record.pv_signals, record.pv_signals, (), record.mv_signals)


def main(argv: list[str]) -> int:
    """Print a row a record as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("records", nargs="*", choices=[[], *RECORDS], help="(default: all whose files are there)")
    parser.add_argument("--rows", type=int, default=8_000, help="that are fitted at most (8000)")
    parser.add_argument("--minutes", type=float, help="of the search on one core (2)")
    parser.add_argument("--seeds", type=int, default=1, help="of the search, a row each (1)")
    parser.add_argument("--screened", action="store_true", help="learn from the rows that `loopwright new` keeps")
    options = parser.parse_args(argv)
    if not options.folder.is_dir():
        parser.error(f"{options.folder} is no folder; give the one that holds the records")
    part, rows = IdentifiedPart(rows=options.rows, minutes=options.minutes), 0
    print("RMSE of the free run over test rows, beside what is published")
    for name in options.records or RECORDS:
        public = RECORDS[name]
        paths = [found(options.folder, file) for file in public.files]
        there = [path for path in paths if path is not None]
        if len(there) < len(paths):
            print(f"{name:20} {' and '.join(public.files)} .csv or .mat not found under {options.folder}", flush=True)
            continue
        task = public.task([columns(p) for p in there])
        for seed in range(options.seeds):
            print(row_of(name, task, public.unit, public.published, part, seed, options.screened), flush=True)
        rows += 1
    return 0 if rows else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
