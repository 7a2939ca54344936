"""A journal as the export of a historian: a row a scan, for `loopwright new` to read."""

from __future__ import annotations

import csv
import math
import os
from datetime import UTC, datetime
from pathlib import Path

from serving.errors import LoopError
from serving.journal import JournalReader

WRITTEN = ("pv", "dv", "applied", "sp")  # groups of columns; the MV as the actuator had it


def export(journal: Path, out: Path) -> int:
    """Write the scans to a CSV file, whole or not at all; how many there were. LoopError where there is none."""
    reader = JournalReader(journal)
    draft = out.with_name(out.name + ".draft")
    try:
        runs = {run["id"]: run["columns"] for run in reader.runs()}
        names = list(dict.fromkeys(c for columns in runs.values() for c in columns if c.partition(" ")[0] in WRITTEN))
        names.sort(key=lambda name: WRITTEN.index(name.partition(" ")[0]))
        count = 0
        with draft.open("w", encoding="utf-8", newline="") as text:
            table = csv.writer(text)
            table.writerow(["time", *map(_tag, names), "MODE"])
            for _, run, scan in reader.scans():
                at = {name: i for i, name in enumerate(runs[run])}
                cells = [_cell(scan.numbers[at[name]]) if name in at else "" for name in names]
                when = datetime.fromtimestamp(scan.time_s, UTC).isoformat(timespec="milliseconds")
                table.writerow([when, *cells, scan.mode])
                count += 1
        if not count:
            raise LoopError(f"{journal} holds no scan yet")
        os.replace(draft, out)
    finally:
        reader.close()
        draft.unlink(missing_ok=True)
    return count


def _tag(column: str) -> str:
    group, _, name = column.partition(" ")
    return f"{name}.{ {'pv': 'PV', 'dv': 'DV', 'applied': 'OP', 'sp': 'SP'}[group] }"


def _cell(value: float) -> str:
    return repr(value) if math.isfinite(value) else ""
