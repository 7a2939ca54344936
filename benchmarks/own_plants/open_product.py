"""The product's way from an operator's moves to a controller: an export of the signals, `new`, `run`, shipped files."""

from __future__ import annotations

import csv
import time
from datetime import timedelta
from pathlib import Path

import numpy as np
from _project import withheld
from closed_product import Columns, by_run
from closed_record import START
from loops import scored
from plant import OwnPlant
from record import record_of
from store import FOLDER, bound_of


def columns_of(plant: OwnPlant) -> Columns:
    """The signals' own names, with units and ranges."""
    words = [
        [f"--{role}", f"{s.name}[{s.unit}]={s.low:g}..{s.high:g}"]
        for role, signals in (("pv", plant.pv_signals), ("mv", plant.mv_signals))
        for s in signals
    ]
    pv, mv = ([s.name for s in signals] for signals in (plant.pv_signals, plant.mv_signals))
    return Columns([word for pair in words for word in pair], pv, mv)


def write_rows(plant: OwnPlant, rows: int, file: Path) -> None:
    """The plant's record as a file of a stamp and its signals."""
    record = record_of(plant, rows)
    names = [s.name for s in (*plant.pv_signals, *plant.mv_signals)]
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", encoding="utf-8", newline="") as out:
        table = csv.writer(out, lineterminator="\n")
        table.writerow(["Timestamp", *names])
        for k, row in enumerate(np.hstack([record.pv, record.mv])):
            stamp = START + timedelta(seconds=plant.period_s * k)
            table.writerow([f"{stamp:%Y-%m-%d %H:%M:%S}", *(f"{v:.6g}" for v in row)])


def run_row(plant: OwnPlant, rows: int) -> str:
    """A row of text: set points of each shipped file over the NMPC, its loads and upsets, or why nothing came."""
    began = time.monotonic()
    file = FOLDER / "exports" / f"{plant.name}-{rows}" / f"{plant.name}.csv"
    write_rows(plant, rows, file)
    project = FOLDER / "projects" / f"{plant.name}-{rows}-open"
    done = by_run(plant, file, project, columns_of(plant))
    minutes = (time.monotonic() - began) / 60
    bound = bound_of(plant)
    parts = [f"{plant.name:12} NMPC {bound:5.2f}"]
    for name, law in done.laws.items():
        found = {test: score.nmae for test, score in scored(law, plant).items()}
        sp = found["set points"]
        parts.append(f"{name} {sp:5.2f} ({sp / bound:.2f}) loads {found['loads']:5.2f} upsets {found['upsets']:5.2f}")
    parts += [f"withheld {line[:200]}" for line in withheld(project, plant.name)]
    if not done.laws:
        parts += [f"nothing: {line}" for line in done.said[-3:]]
    return " | ".join([*parts, f"{minutes:.1f} min, {done.seconds / 60:.1f} of a core"])
