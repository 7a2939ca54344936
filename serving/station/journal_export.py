"""A journal for other tools: its rows as the export of a historian, its events as lines and as CSV."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from loopwright.serving.errors import LoopError
from loopwright.serving.journal import EventEntry, JournalReader, ScanEntry
from loopwright.serving.station.settings import Settings
from loopwright.serving.words import plain

# -------------------------------------------------------------------------------------------------------------- events
FIELDS = ("time", "kind", "who", "what", "reason")


def journal_of(file: Path) -> Path:
    """The journal that ``file`` is, or that the loop.toml ``file`` names."""
    return Settings.read(file).journal.file if file.suffix == ".toml" else file


def happened(journal: Path, since: str = "", last: int | None = None) -> list[EventEntry]:
    """The events of a journal, oldest first: all, or those from ``since`` on, and of these the ``last`` ones.

    ``since`` is in ISO 8601, and UTC where it names no zone. LoopError where it is no time, or ``last`` is below 1.
    """
    begin_s = _seconds(since) if since else -1e300
    if last is not None and last < 1:
        raise LoopError(f"--last is {last}; it must be 1 or more")
    with closing(JournalReader(journal)) as reader:
        events = [event for _, event in reader.events(begin_s=begin_s)]
    return events if last is None else events[-last:]


def lines(events: Sequence[EventEntry]) -> list[str]:
    """A line an event: when, of which kind, who, what, and the reason in brackets."""
    rows = [_cells(event) for event in events]
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(3)]
    found = []
    for *head, what, reason in rows:
        start = "  ".join(cell.ljust(width) for cell, width in zip(head, widths, strict=True))
        found.append(f"{start}  {what}" + f" ({reason})" * bool(reason))
    return found


def write_csv(events: Sequence[EventEntry], out: TextIO) -> None:
    """A row an event, below the names of the columns."""
    table = csv.writer(out, lineterminator="\n")
    table.writerow(FIELDS)
    table.writerows(_cells(event) for event in events)


def _cells(event: EventEntry) -> list[str]:
    # An acknowledgement is written down with the text of its alarm.
    what = f"acknowledged: {event.what}" if event.kind == "acknowledged" else event.what
    moment = datetime.fromtimestamp(event.time_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return [moment, event.kind, *(plain(" ".join(text.split())) for text in (event.who, what, event.reason))]


def _seconds(since: str) -> float:
    try:
        moment = datetime.fromisoformat(since)
    except ValueError:
        raise LoopError(f"--since is {since!r}; write a date or a time, as 2026-03-01 or 2026-03-01T14:30") from None
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()


# -------------------------------------------------------------------------------------------------------- a row a scan
WRITTEN = ("pv", "dv", "applied", "sp")  # groups of columns; the MV as the actuator has it from then on
MEASURED = ("pv", "applied", "dv")  # in the order of a scan's statuses
EXPORT_GOOD, EXPORT_UNCERTAIN = 0, 1  # the two highest bits of a status
LATE_PERIODS = 1.5  # periods to the next scan from which it does not say what the actuator had


def export(journal: Path, out: Path) -> int:
    """Write the scans to a CSV file, whole or not at all; how many there were. LoopError where there is none.

    The MV of a row is the one that the actuator has from this scan to the next, as the next one reads it back: a model
    of rows whose MV acted before their PVs would take what the controller made of a PV for what moved it.
    A value whose quality was not good is an empty cell: nobody measured it. One of uncertain quality counts where the
    loop used it, as ``server.uncertain`` says.
    Times are the plant's: where its time runs faster than the clock's, so do they, and runs follow each other. Where
    the clock was set back, the next scan follows the one before it by a period, and the later ones go on from there.
    """
    reader = JournalReader(journal)
    draft = out.with_name(out.name + ".draft")
    try:
        found = {run["id"]: run for run in reader.runs()}
        runs = {id_: run["columns"] for id_, run in found.items()}
        names = list(dict.fromkeys(c for columns in runs.values() for c in columns if c.partition(" ")[0] in WRITTEN))
        names.sort(key=lambda name: WRITTEN.index(name.partition(" ")[0]))
        count = 0
        with draft.open("w", encoding="utf-8", newline="") as text:
            table = csv.writer(text)
            table.writerow(["time", *map(_tag, names), "MODE"])
            of, began, last = 0, 0.0, 0.0
            waiting: _Row | None = None
            for _, run, scan in reader.scans():
                speed, period = found[run]["speed"], found[run]["period_s"]
                if run != of:
                    of, began = run, max(found[run]["began"], last + period)
                now = began + (scan.time_s - found[run]["began"]) * speed
                if waiting is not None and now <= last:
                    began += last + period - now
                    now = last + period
                last = now
                row = _Row(run, last, _believed(scan, runs[run]), scan.mode)
                if waiting is not None:
                    table.writerow(waiting.cells(names, row if now - waiting.time_s < LATE_PERIODS * period else None))
                waiting = row
                count += 1
            if waiting is not None:
                table.writerow(waiting.cells(names, None))
        if not count:
            raise LoopError(f"{journal} holds no scan yet")
        os.replace(draft, out)
    finally:
        reader.close()
        draft.unlink(missing_ok=True)
    return count


def _believed(scan: ScanEntry, columns: Sequence[str]) -> dict[str, float]:
    """The numbers of a scan by column, NaN for what was measured with a quality that is not to be believed.

    A loop that does not use values of uncertain quality has a fault at each; one that it uses comes without.
    """
    worst = EXPORT_GOOD if scan.reason else EXPORT_UNCERTAIN
    bad = [status >> 30 > worst for status in scan.quality]  # empty: all is good
    pvs, mvs, dvs = ([c for c in columns if c.startswith(f"{group} ")] for group in MEASURED)
    wrong = {name for name, is_bad in zip([*pvs, *mvs, *dvs], bad, strict=False) if is_bad}
    if len(bad) < len(pvs + mvs + dvs) and any(bad[len(pvs + mvs) :]):
        wrong.update(dvs)  # not every DV is read, and the journal does not say which ones are
    numbers = zip(columns, scan.numbers, strict=True)
    return {name: math.nan if name in wrong else value for name, value in numbers}


@dataclass(frozen=True, slots=True)
class _Row:
    """A scan by column, on the plant's time."""

    run: int
    time_s: float
    numbers: Mapping[str, float]
    mode: str

    def cells(self, names: Sequence[str], following: _Row | None) -> list[str]:
        """The row of the table, with the MVs that the ``following`` scan reads back; None: the scan's own command."""
        after = following.numbers if following is not None and following.run == self.run else {}
        when = datetime.fromtimestamp(self.time_s, UTC).isoformat(timespec="milliseconds")
        return [when, *(_cell(self._value(name, after)) for name in names), self.mode]

    def _value(self, name: str, after: Mapping[str, float]) -> float:
        if not name.startswith("applied "):
            return self.numbers.get(name, math.nan)
        asked = self.numbers.get(name.replace("applied", "mv", 1), math.nan)
        found = (after.get(name, math.nan), asked, self.numbers.get(name, math.nan))
        return next((value for value in found if math.isfinite(value)), math.nan)


def tag_table(journal: Path, out: Path) -> None:
    """Write the tags of the exported file: roles, names and units as the last controller had them.

    A range is the widest of all runs, so that no reading of an earlier controller counts as impossible. The range that
    the last controller may command of an MV is beside it where that is less.
    """
    with closing(JournalReader(journal)) as reader:
        runs = reader.runs()
    last = runs[-1]
    fields = ["tag", "role", "name", "unit", "unit_certain", "low", "high"]
    fields += ["command_low", "command_high", "max_move_per_min"]
    with out.open("w", encoding="utf-8", newline="") as text:
        table = csv.DictWriter(text, fields)
        table.writeheader()
        for group, role in (("pv", "pv"), ("mv", "mv"), ("dv", "dv"), ("sp", "sp")):
            for s in last["signals"][group]:
                row: dict[str, Any] = {
                    "tag": _tag(f"{'applied' if group == 'mv' else group} {s['name']}"),
                    "role": role,
                }
                low, high = _widest(runs, group, s)
                row |= {"name": s["name"], "unit": s["unit"], "low": low, "high": high}
                if group == "mv" and (low, high) != (s["low"], s["high"]):
                    row |= {"command_low": s["low"], "command_high": s["high"]}
                row["unit_certain"] = "yes"  # loop.toml states it, and no reading is in another one
                if s.get("max_move") is not None:
                    row["max_move_per_min"] = s["max_move"] * 60 / last["period_s"]
                table.writerow(row)
        table.writerow({"tag": "MODE", "role": "mode", "name": "MODE"})


def _widest(runs: Sequence[Mapping[str, Any]], group: str, signal: Mapping[str, Any]) -> tuple[float, float]:
    """The range of a signal over the runs that have it in this unit."""
    same = [
        s for run in runs for s in run["signals"][group] if (s["name"], s["unit"]) == (signal["name"], signal["unit"])
    ]
    return min(s["low"] for s in same), max(s["high"] for s in same)


def _tag(column: str) -> str:
    group, _, name = column.partition(" ")
    return f"{name}.{ {'pv': 'PV', 'dv': 'DV', 'applied': 'OP', 'sp': 'SP'}[group] }"


def _cell(value: float) -> str:
    return repr(value) if math.isfinite(value) else ""
