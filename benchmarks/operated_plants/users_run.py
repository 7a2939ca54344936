"""Ours as users come by it: a record's file, a table of tags, `loopwright new`, `loopwright run`, the shipped file."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from _project import ROOT, SOURCES, new_and_run, withheld
from contest import HEAD, Contest, bound_of, rows_of
from figures import Figures, figures_of, run_day
from from_record import FOLDER, Fit, Served, record_of
from operated_plant import PERIOD_S, Day, OperatedPlant

from loopwright.pipeline.files import write_bytes, write_json
from loopwright.pipeline.historian.cleaning.tags import safe_name
from loopwright.serving import Controller

START = datetime(2025, 2, 3)
TABLE = (
    "tag", "role", "unit", "low", "high", "command_low", "command_high", "max_move_per_min", "range_low", "range_high",
    "rest", "cost",
)  # fmt: skip
ONE_CORE = dict.fromkeys(("LOOPWRIGHT_WORKERS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
LINES = 3  # last ones of what was said, shown where nothing came


@dataclass(frozen=True, slots=True)
class UsersResult:
    """What the users' path makes of a plant. ``figures`` None: nothing that could be stepped came, ``why`` says it."""

    figures: Figures | None
    why: list[str]
    seconds: float  # of processor, of `new` and `run`
    project: Path


def write_rows(plant: OperatedPlant, rows: int, file: Path) -> None:
    """The plant's record as its archive shows it: an analyser's last number stands until the next one."""
    record = record_of(plant, rows)
    pv = record.pv.copy()
    for i, every in plant.every.items():
        pv[:, i] = pv[np.arange(rows) // every * every, i]
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", encoding="utf-8", newline="") as out:
        table = csv.writer(out, lineterminator="\n")
        table.writerow(["Timestamp", *(s.name for s in (*plant.pv, *plant.dv, *plant.mv))])
        for k, row in enumerate(np.hstack([pv, record.dv, record.mv])):
            stamp = START + timedelta(seconds=PERIOD_S * k)
            table.writerow([f"{stamp:%Y-%m-%d %H:%M:%S}", *(f"{v:.6g}" for v in row)])


def tags_of(plant: OperatedPlant) -> list[dict[str, str]]:
    """The table of tags as the plant's people fill it in, by what operators have set.

    An end of a range that nobody asked for is the signal's own: of a constraint an empty cell would ask the record.
    """
    lines, operate = [], plant.operate
    for i, s in enumerate(plant.pv):
        seldom = plant.every.get(i, 1) > 1
        kind = "analyser" * seldom if i < len(plant.sp) else "constraint" + "-analyser" * seldom
        low, high = plant.range_of(i)
        ranged = i >= len(plant.sp) or (low, high) != (s.low, s.high)
        own = {"range_low": low, "range_high": high} if ranged else {}
        lines.append((s, kind or "pv", own | {"cost": operate.get(f"{s.name}.cost")}))
    lines += [(s, "dv", {}) for s in plant.dv]
    for s, low, high in zip(plant.mv, *plant.mv_ends(), strict=True):
        ends = {"command_low": low, "command_high": high} if (low, high) != (s.low, s.high) else {}
        rate = None if s.max_move is None else s.max_move * 60 / PERIOD_S
        rest = operate.get(f"{s.name}.rest") if operate.get(f"{s.name}.rest_use") else None
        lines.append((s, "mv", ends | {"max_move_per_min": rate, "rest": rest, "cost": operate.get(f"{s.name}.cost")}))
    found = []
    for s, role, numbers in lines:
        own = {"tag": s.name, "role": role, "unit": s.unit, "low": f"{s.low:g}", "high": f"{s.high:g}"}
        found.append(own | {name: f"{v:.10g}" for name, v in numbers.items() if v is not None})
    return found


def write_tags(plant: OperatedPlant, file: Path) -> None:
    """The table of tags as a file for ``--tags``."""
    with file.open("w", encoding="utf-8", newline="") as out:
        table = csv.DictWriter(out, TABLE, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(tags_of(plant))


def users_figures(plant: OperatedPlant, file: Path, days: list[Day]) -> Figures:
    """The shipped file over the days, as the runtime steps it; RuntimeError where its signals are not the plant's."""
    controller = Controller(file)
    for role, signals in (("pv", plant.pv), ("sp", plant.sp), ("dv", plant.dv), ("mv", plant.mv)):
        found = [s.name for s in controller.manifest.signals(role)]
        if found != (own := [safe_name(s.name) for s in signals]):
            raise RuntimeError(f"{file}: {role} is {found}, the plant has {own}")
    if controller.manifest.period_s != PERIOD_S:
        raise RuntimeError(f"{file}: period_s is {controller.manifest.period_s:g}, the plant's day has {PERIOD_S:g}")
    return figures_of(plant, days, [run_day(plant, Served(controller), day) for day in days])


def users_result(
    plant: OperatedPlant, rows: int, seeds: Sequence[int], samples: int, folder: Path = FOLDER
) -> UsersResult:
    """The plant's shipped predictive file over the days; `new` and `run` once for the product's and the plant's state.

    Files under ``folder`` keep the record, the project and what came of it.
    """
    file = folder / "users" / f"{plant.name}-{rows}" / f"{plant.name}.csv"
    write_rows(plant, rows, file)
    write_tags(plant, tags := file.with_name(f"{plant.name}-tags.csv"))
    key = hashlib.sha256(b"".join(path.read_bytes() for path in (file, tags)) + product_digest().encode())
    project = folder / "users" / f"{plant.name}-{rows}-{key.hexdigest()[:12]}"
    kept = project.with_suffix(".json")
    if not kept.exists():
        options = ["--tags", tags.name, "--period", f"{PERIOD_S:g}"]
        done = new_and_run(project, plant.name, [file, tags], options)
        why = withheld(project, plant.name) if done.ended else done.said[-LINES:]
        write_json(kept, {"why": why, "seconds": done.seconds, "files": sorted(done.files)})
    found = json.loads(kept.read_text())
    if "predictive" not in found["files"]:
        return UsersResult(None, found["why"] or ["no controller is named predictive"], found["seconds"], project)
    shipped = project / "artifacts" / plant.name / "predictive.onnx"
    days = [plant.day(seed, samples) for seed in seeds]
    return UsersResult(users_figures(plant, shipped, days), found["why"], found["seconds"], project)


def product_digest() -> str:
    """Of the product's sources: another state of them fits and designs anew."""
    found = hashlib.sha256()
    for package in SOURCES:
        for file in sorted((ROOT / package).rglob("*.py")):
            found.update(file.read_bytes())
    return found.hexdigest()


def users_row(plant: OperatedPlant, result: UsersResult, bound: Figures) -> str:
    """Rows of ours and the NMPC, or the line that says why there is none of ours; [s]: of `new` and `run`."""
    own = {} if result.figures is None else {"run": result.figures}
    seconds = {"run": result.seconds, "NMPC": 0.0}
    text = rows_of(Contest(plant, own | {"NMPC": bound}, {}, {}, seconds))
    why = [f"  {plant.name}: {line}" for line in result.why]
    return "\n".join([*why, text])


def users_main(plants: Sequence[OperatedPlant], fit: Fit, seeds: Sequence[int], samples: int, file: Path | None) -> int:
    """Print the rows of plants as they come, what is done before each, and how long it took."""
    os.environ.update(ONE_CORE)
    lines = []
    for plant in plants:
        print(f"{plant.name}: `new` and `run` of {fit.rows} rows, {datetime.now():%H:%M}", flush=True)
        began = time.monotonic()
        result = users_result(plant, fit.rows, seeds, samples)
        took = f"{(time.monotonic() - began) / 60:.1f} minutes now, {result.seconds / 60:.1f} of one core when they ran"
        print(f"{plant.name}: {took}, in {result.project}; the NMPC is next", flush=True)
        bound = bound_of(plant, fit, seeds, samples)
        print(HEAD)
        print(users_row(plant, result, bound), flush=True)
        figures = {"run": None if result.figures is None else asdict(result.figures), "NMPC": asdict(bound)}
        known = {"plant": plant.name, "figures": figures, "why": result.why, "seconds": result.seconds}
        lines.append(json.dumps(known))
        if file is not None:
            write_bytes(file, ("\n".join(lines) + "\n").encode())
    return 0
