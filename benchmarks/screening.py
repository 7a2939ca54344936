"""What a long export costs `loopwright new`: seconds and memory, ``python benchmarks/screening.py [--rows 500000]``.

Ten tags every second, as CSV and as Parquet: three manipulated variables that step, four process variables that follow
with noise, a measured disturbance, a set point and a mode; with gaps, empty cells, codes for missing values, outliers
and a stuck sensor. `new` reads, screens and resamples it, and draws the page. Each file has a process of its own.
Of every phase the table gives the seconds, those of the CPU, and the largest memory so far [MB]. The 500,000 rows keep
`make bench` short, about 35 seconds; of 5,000,000 no more than 60 s and 1.5 GB are wanted, on two idle cores.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from _exports import START_S, Array, steps
from scipy.signal import lfilter

from loopwright.pipeline.__main__ import main as loopwright
from loopwright.pipeline.commands import new
from loopwright.pipeline.historian import export_params, screening

BLOCK = 250_000  # rows that are made at a time: this process must stay smaller than the one that is measured
WANTED_ROWS, WANTED_S, WANTED_MB = 5_000_000, 60.0, 1500.0
TAGS = {"pv": ("TIC-1.PV", "TIC-2.PV", "AIC-3.PV", "PI-4"), "mv": ("TIC-1.OP", "TIC-2.OP", "AIC-3.OP"),
        "dv": ("FI-5",), "sp": ("TIC-1.SP",), "mode": ("TIC-1.MODE",)}  # fmt: skip
GAINS = np.array([[0.8, 0.1, 0.0], [0.2, 0.6, 0.0], [0.0, -0.3, 0.5], [0.1, 0.0, -0.4]])  # of the PVs, from the MVs
LOADS = np.array([0.05, -0.04, 0.03, 0.06])  # of the PVs, from the disturbance
LAGS_S = np.array([40.0, 60.0, 90.0, 30.0])
DEAD_S, NOISE = 5, 0.1
PHASES: tuple[tuple[str, Any, str], ...] = (
    ("reading", export_params, "read_export"),
    ("screening of readings", screening, "flag_bad_readings"),
    ("remarks on readings", screening, "check_readings"),
    ("settling", screening, "pace_of"),
    ("resampling", screening, "resampled"),
    ("pulses", screening, "remove_pulses"),
    ("outliers by a model", screening, "review_outliers"),
    ("stuck and saturated", screening, "mask_stuck_and_saturated"),
    ("inputs and answers", screening, "mask_contradictions"),
    ("rows", screening, "row_codes"),
    ("record", screening, "record_of"),
    ("verdict", screening, "judged"),
    ("page", new, "write_page"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table a format; 1 where a run of WANTED_ROWS or fewer costs more than is wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=500_000)
    parser.add_argument("--format", choices=("csv", "parquet"), action="append", help="both unless one is named")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="make the files and run there, and leave all")
    parser.add_argument("--measured", metavar="FILE", help=argparse.SUPPRESS)  # the child: `new` on this file
    options = parser.parse_args(arguments)
    if options.measured:
        return measured(options.measured)
    print(f"{options.rows} rows of 10 tags through `loopwright new`; about {25 + options.rows // 50_000} s", flush=True)
    with tempfile.TemporaryDirectory() as own:
        good = [run(options.keep or Path(own), kind, options.rows) for kind in options.format or ("csv", "parquet")]
    return 0 if all(good) else 1


def run(folder: Path, kind: str, rows: int) -> bool:
    """Write the export, screen it in a process of its own, and print what that took; whether it is as wanted."""
    folder.mkdir(parents=True, exist_ok=True)
    name = f"export.{kind}"
    size_mb = write(folder / name, rows) / 1e6
    started = time.perf_counter()
    command = [sys.executable, str(Path(__file__).resolve()), "--measured", name]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - started
    if done.returncode:
        print(done.stdout + done.stderr, file=sys.stderr)
        return False
    found = json.loads(done.stdout.splitlines()[-1])
    phases = found["phases"]
    phases["others"] = [
        all_of - sum(p[i] for p in phases.values()) for i, all_of in enumerate((seconds, found["cpu_s"]))
    ]
    print(
        f"{kind}: {rows} rows, {size_mb:.0f} MB -> {seconds:.1f} s, {found['cpu_s']:.1f} s of CPU, {found['mb']:.0f} MB"
    )
    for phase, (wall_s, cpu_s, *peak) in phases.items():
        print(f"  {phase:24}{wall_s:8.1f}{cpu_s:8.1f}{''.join(f'{mb:8.0f}' for mb in peak)}")
    return rows > WANTED_ROWS or (seconds <= WANTED_S and found["mb"] <= WANTED_MB)


# ---------------------------------------------------------------------- the process that is measured
def measured(file: str) -> int:
    """`loopwright new` on the file; the last line is what it took, as JSON."""
    phases = {phase: [0.0, 0.0, 0.0] for phase, _, _ in PHASES}
    for phase, module, name in PHASES:
        setattr(module, name, timed(getattr(module, name), phases[phase]))
    given = [word for role, tags in TAGS.items() for tag in tags for word in (f"--{role}", tag)]
    Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n", encoding="utf-8")
    code = loopwright(["new", f"long_{Path(file).suffix[1:]}", file, *given])
    print(json.dumps({"cpu_s": time.process_time(), "mb": peak_mb(), "phases": phases}))
    return code


def timed(function: Callable[..., Any], into: list[float]) -> Callable[..., Any]:
    """The function, which adds its seconds and those of the CPU to ``into``; the third is the peak after it [MB]."""

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            into[:] = into[0] + time.perf_counter() - wall_s, into[1] + time.process_time() - cpu_s, peak_mb()

    return wrapped


def peak_mb() -> float:
    """The largest memory of this process so far [MB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


# ---------------------------------------------------------------------- the export
def write(path: Path, rows: int) -> int:
    """The export of ``rows`` rows, less its gaps; its size [bytes]."""
    writer: Any = None
    for table in tables(rows):
        if writer is None:
            text = path.suffix == ".csv"
            writer = (pa_csv.CSVWriter if text else pq.ParquetWriter)(path, table.schema)
        writer.write_table(table)
    writer.close()
    return path.stat().st_size


def tables(rows: int) -> Iterator[pa.Table]:
    """The export, BLOCK rows at a time."""
    random = np.random.default_rng(11)
    drives = [first_order(LAGS_S[i], DEAD_S) for i in range(len(GAINS))]
    for start in range(0, rows, BLOCK):
        n = min(BLOCK, rows - start)
        mv = np.column_stack([steps(random, n, 20, 80, 200, 900) for _ in TAGS["mv"]])
        flow = 500 + steps(random, n, -50, 50, 300, 1500)
        static = 30 + mv @ GAINS.T + np.outer(flow - 500, LOADS)
        pv = np.column_stack([drive(static[:, i]) for i, drive in enumerate(drives)])
        pv = np.round(pv + random.normal(0, NOISE, pv.shape), 2)
        yield dirty(random, start, pv, mv, np.round(flow + random.normal(0, 0.5, n), 1))


def first_order(lag_s: float, dead_s: int) -> Callable[[Array], Array]:
    """y(k+1) = y(k) + (u(k - dead) - y(k)) / lag, called with one block of u (n,) after the other."""
    b, a = np.r_[np.zeros(dead_s + 1), 1 / lag_s], [1.0, 1 / lag_s - 1.0]
    state = np.zeros(len(b) - 1)

    def block(u: Array) -> Array:
        y, state[:] = lfilter(b, a, u - 50.0, zi=state)
        return np.asarray(y + 50.0)

    return block


def dirty(random: np.random.Generator, start: int, pv: Array, mv: Array, dv: Array) -> pa.Table:
    """A block of columns, (n, m) and (n,), with its dirt."""
    n = len(pv)
    for i in range(pv.shape[1]):
        pv[random.choice(n, n // 5000, replace=False), i] += random.choice([-20.0, 20.0])  # outliers
        pv[random.choice(n, n // 5000, replace=False), i] = -9999.0
        pv[random.choice(n, n // 2000, replace=False), i] = np.nan
    stuck = slice(n // 3, n // 3 + 600)
    pv[stuck, 0] = pv[n // 3, 0]
    kept = np.ones(n, dtype=bool)
    kept[n // 2 : n // 2 + 120] = False  # the historian was down
    stamps = ((START_S + start + np.arange(n)) * 1e3).astype("datetime64[ms]")
    modes = np.where((np.arange(n) // 20_000) % 5 == 4, "AUTO", "MAN")
    sp = np.repeat(np.round(random.uniform(50, 70, n // 5000 + 1), 1), 5000)[:n]
    names = ("Timestamp", *(tag for tags in TAGS.values() for tag in tags))
    columns = [stamps, *pv.T, *mv.T, dv, sp, modes]
    return pa.table({name: pa.array(c[kept], from_pandas=True) for name, c in zip(names, columns, strict=True)})


if __name__ == "__main__":
    sys.exit(main())
