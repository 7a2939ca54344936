"""Entries of a journal, scans and the events between them, and their reader."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.journal.file import opened
from loopwright.serving.manifest import Manifest

Kind: TypeAlias = Literal["change", "swap", "fault", "connection", "monitor", "acknowledged"]

GROUPS = ("sp", "pv", "mv", "applied", "law", "beside", "dv", "info")


@dataclass(frozen=True, slots=True)
class ScanEntry:
    """One scan. ``numbers`` are the columns of its run, NaN where there was none; no ``quality``: all is good."""

    time_s: float  # since 1970
    mode: str
    numbers: tuple[float, ...]
    quality: tuple[int, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True)
class EventEntry:
    """A change by somebody, or an event.

    With ``alarm`` it begins (``raised``) or ends the alarm of that name; a new one of the same name ends the one
    before. ``about`` is the id of the event that is acknowledged.
    """

    time_s: float
    kind: Kind
    who: str
    what: str
    reason: str = ""
    alarm: str = ""
    raised: bool = False
    about: int = 0


def columns(manifest: Manifest) -> list[str]:
    """Names of a scan's numbers: group and signal, as ``pv T``."""
    m = manifest
    signals = dict(zip(GROUPS, (m.sp, m.pv, m.mv, m.mv, m.mv, m.mv, m.dv), strict=False))
    return [f"{g} {s.name}" for g, group in signals.items() for s in group] + [f"info {i}" for i in m.info]


# ------------------------------------------------------------------------------------------ scans as compressed blocks
Array: TypeAlias = NDArray[np.float64]


def packed(rows: Sequence[Sequence[Any]]) -> bytes:
    """Scans as one compressed value: a column after the other, of each all first bytes, then all second ones."""
    numbers = np.stack([np.frombuffer(row[4]) for row in rows])
    table = np.column_stack([[row[2] for row in rows], numbers]).astype("<f8")
    planes = table.T.copy().view(np.uint8).reshape(table.shape[1], len(rows), 8).transpose(0, 2, 1)
    head = {
        "rows": len(rows),
        "modes": _runs([row[3] for row in rows]),
        "quality": {i: json.loads(row[5]) for i, row in enumerate(rows) if row[5]},
        "reason": {i: row[6] for i, row in enumerate(rows) if row[6]},
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    return zlib.compress(len(text).to_bytes(4, "little") + text + planes.tobytes(), 6)


def unpacked(data: bytes) -> list[ScanEntry]:
    """The scans that ``packed`` made one value of."""
    head, numbers = _opened(data)
    modes = [mode for mode, times in head["modes"] for _ in range(times)]
    return [
        ScanEntry(
            row[0], modes[i], tuple(row[1:]), tuple(head["quality"].get(str(i), ())), head["reason"].get(str(i), "")
        )
        for i, row in enumerate(numbers.tolist())
    ]


def table(data: bytes) -> tuple[Array, list[str]]:
    """Times and numbers of a packed value, shape (scans, 1 + columns), and the mode of each scan."""
    head, numbers = _opened(data)
    return numbers, [mode for mode, times in head["modes"] for _ in range(times)]


def _opened(data: bytes) -> tuple[dict[str, Any], Array]:
    content = zlib.decompress(data)
    size = int.from_bytes(content[:4], "little")
    head = json.loads(content[4 : 4 + size])
    planes = np.frombuffer(content, dtype=np.uint8, offset=4 + size).reshape(-1, 8, head["rows"])
    return head, planes.transpose(0, 2, 1).copy().view("<f8")[..., 0].T


def _runs(values: Sequence[str]) -> list[tuple[str, int]]:
    found: list[tuple[str, int]] = []
    for value in values:
        if found and found[-1][0] == value:
            found[-1] = (value, found[-1][1] + 1)
        else:
            found.append((value, 1))
    return found


EVENT = "time, kind, who, what, reason, alarm, raised, about"
ENTRY = f"""select {", ".join(f"e.{name}" for name in EVENT.split(", "))}, e.id,
    case when e.raised then (select n.time from event n where n.alarm = e.alarm and n.id > e.id order by n.id limit 1)
    end as over, a.who, a.time, a.reason
    from event e left join event a on a.about = e.id and e.id > 0"""


@dataclass(frozen=True, slots=True)
class Entry:
    """An event as the log shows it: an alarm also with when it ended and who acknowledged it."""

    id: int
    event: EventEntry
    over_s: float | None
    acknowledged: EventEntry | None


class JournalReader:
    """Reads a journal, also while it is written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._base = opened(path, write=False)

    def close(self) -> None:
        """End."""
        self._base.close()

    def runs(self) -> list[dict[str, Any]]:
        """The controllers that ran, each with the columns of its scans."""
        rows = self._base.execute(
            "select id, began, controller, sha256, period_s, speed, columns, signals from run order by id"
        )
        names = ("id", "began", "controller", "sha256", "period_s", "speed", "columns", "signals")
        return [dict(zip(names, (*row[:-2], *map(json.loads, row[-2:])), strict=True)) for row in rows]

    def scans(
        self, after_id: int = 0, begin_s: float = -1e300, end_s: float = 1e300
    ) -> Iterator[tuple[int, int, ScanEntry]]:
        """(id, run, scan) of the scans after an id and within times, in the order in which they were written.

        Their times follow that order unless the clock was set meanwhile.
        """
        with closing(self._base.cursor()) as cursor:
            cursor.execute("begin")  # one state of the file: rows are packed meanwhile
            try:
                cursor.execute(
                    "select data, run, first from block where last > ? and end >= ? and begin <= ? order by first",
                    (after_id, begin_s, end_s),
                )
                for data, run, first in cursor:  # one by one: all blocks together may be gigabytes
                    for i, scan in enumerate(unpacked(data)):
                        if first + i > after_id and begin_s <= scan.time_s <= end_s:
                            yield first + i, run, scan
                cursor.execute(
                    "select id, run, time, mode, numbers, quality, reason from scan "
                    "where id > ? and time between ? and ? order by id",
                    (after_id, begin_s, end_s),
                )
                for id_, run, time_s, mode, numbers, quality, reason in cursor:
                    values = tuple(np.frombuffer(numbers).tolist())
                    yield id_, run, ScanEntry(time_s, mode, values, tuple(json.loads(quality or "[]")), reason or "")
            finally:
                cursor.execute("rollback")

    def tables(self, begin_s: float, end_s: float) -> Iterator[tuple[int, Array, list[str]]]:
        """(run, times and numbers (scans, 1 + columns), modes) of the scans within times, in pieces, in that order."""
        with closing(self._base.cursor()) as cursor:
            cursor.execute("begin")
            try:
                cursor.execute(
                    "select run, data from block where end >= ? and begin <= ? order by first", (begin_s, end_s)
                )
                for run, data in cursor:
                    numbers, modes = table(data)
                    inside = (numbers[:, 0] >= begin_s) & (numbers[:, 0] <= end_s)
                    if inside.any():
                        yield (
                            run,
                            numbers[inside],
                            [m for m, is_in in zip(modes, inside.tolist(), strict=True) if is_in],
                        )
                cursor.execute(
                    "select run, time, mode, numbers from scan where time between ? and ? order by id", (begin_s, end_s)
                )
                for run, rows in groupby(cursor, key=itemgetter(0)):
                    scans = list(rows)
                    numbers = np.array([(time_s, *np.frombuffer(n)) for _, time_s, _, n in scans])
                    yield run, numbers, [mode for _, _, mode, _ in scans]
            finally:
                cursor.execute("rollback")

    def last_id(self) -> int:
        """The id of the newest scan; 0 where there is none."""
        (found,) = self._base.execute(
            "select coalesce(max(seq), 0) from sqlite_sequence where name = 'scan'"
        ).fetchone()
        return int(found)

    def entries(self, limit: int = 200, after_id: int = 0) -> list[Entry]:
        """The newest events, newest first, and alarms that are active or not acknowledged, however old."""
        rows = self._base.execute(
            f"{ENTRY} where e.id > ? and (e.id > (select coalesce(max(id), 0) from event) - ? or (e.raised and "
            "(a.id is null or over is null))) order by e.id desc limit ?",
            (after_id, limit, 2 * limit),
        )
        return [_entry(row) for row in rows]

    def active(self) -> list[Entry]:
        """The alarms that have not ended, newest first."""
        rows = self._base.execute(f"{ENTRY} where e.raised and over is null order by e.id desc")
        return [_entry(row) for row in rows]

    def entry(self, id_: int) -> Entry | None:
        """One event."""
        row = self._base.execute(f"{ENTRY} where e.id = ?", (id_,)).fetchone()
        return None if row is None else _entry(row)

    def learnt(self, name: str) -> str | None:
        """The text that was kept under a name."""
        row = self._base.execute("select value from learnt where name = ?", (name,)).fetchone()
        return None if row is None else str(row[0])

    def learnt_names(self, begin: str) -> list[str]:
        """The names that begin so, in order, under which a text was kept."""
        rows = self._base.execute("select name from learnt where substr(name, 1, ?) = ?", (len(begin), begin))
        return sorted(str(name) for (name,) in rows)

    def events(self, after_id: int = 0, begin_s: float = -1e300, end_s: float = 1e300) -> list[tuple[int, EventEntry]]:
        """(id, event) after an id and within times, in order."""
        rows = self._base.execute(
            f"select id, {EVENT} from event where id > ? and time between ? and ? order by id",
            (after_id, begin_s, end_s),
        )
        return [(row[0], _event(row[1:])) for row in rows]


def _event(row: Sequence[Any]) -> EventEntry:
    time_s, kind, who, what, reason, alarm, raised, about = row
    return EventEntry(time_s, kind, who, what, reason, alarm, bool(raised), about)


def _entry(row: Sequence[Any]) -> Entry:
    *event, id_, over, who, time_s, reason = row
    return Entry(id_, _event(event), over, None if who is None else EventEntry(time_s, "acknowledged", who, "", reason))
