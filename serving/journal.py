"""Everything that a loop did, scan by scan, in one SQLite file that survives the death of its process."""

from __future__ import annotations

import json
import queue
import sqlite3
import threading
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.errors import LoopError
from serving.manifest import Manifest
from serving.words import named

Array: TypeAlias = NDArray[np.float64]

SCHEMA = 1
GROUPS = ("sp", "pv", "mv", "applied", "law", "beside", "dv", "info")
FLUSH_S = 0.25  # so much is lost at most when the process dies
BLOCK = 600  # scans that are packed together
FRESH = 1200  # the last scans, a row each
WAITING = 200_000  # scans that wait in memory while the disk takes none
TABLES = """
create table if not exists run (id integer primary key, began real not null, controller text not null,
    sha256 text not null, period_s real not null, columns text not null);
create table if not exists scan (id integer primary key autoincrement, run integer not null, time real not null,
    mode text not null, numbers blob not null, quality text, reason text);
create table if not exists block (first integer primary key, last integer not null, run integer not null,
    begin real not null, end real not null, data blob not null);
create table if not exists event (id integer primary key autoincrement, time real not null, kind text not null,
    who text not null, what text not null, reason text not null);
create index if not exists event_time on event (time);
create index if not exists block_end on block (end);
"""


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan. ``numbers`` are the columns of its run, NaN where there was none; no ``quality``: all is good."""

    time_s: float  # since 1970
    mode: str
    numbers: tuple[float, ...]
    quality: tuple[int, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """What somebody changed, or what happened: ``kind`` is change, fault, connection, alarm, monitor or swap."""

    time_s: float
    kind: str
    who: str
    what: str
    reason: str = ""


def columns(manifest: Manifest) -> list[str]:
    """Names of a scan's numbers: group and signal, as ``pv T``."""
    m = manifest
    names = {
        "sp": m.sp, "pv": m.pv, "mv": m.mv, "applied": m.mv, "law": m.mv, "beside": m.mv, "dv": m.dv,
    }  # fmt: skip
    return [f"{g} {s.name}" for g, signals in names.items() for s in signals] + [f"info {i}" for i in m.info]


class Journal:
    """Writes scans and events from a thread of its own; ``scan`` and ``event`` return at once.

    The file is in WAL mode: a process that dies, whatever it was doing, leaves a whole file without its last
    ``FLUSH_S`` at most. With ``fsync`` "power loss" each write waits for the disk. Older scans are packed, and beyond
    ``max_mb`` the oldest go. While the disk takes nothing, scans wait in memory, and ``trouble`` says why.

    Raises LoopError for a file that is no journal.
    """

    def __init__(
        self,
        path: Path,
        *,
        max_mb: float = 2000.0,
        fsync: Literal["power loss", "crash"] = "crash",
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.path, self.max_bytes, self.tell = path, max_mb * 1e6, tell
        self.trouble, self.lost = "", 0
        self._fsync = fsync
        self._queue = queue.SimpleQueue[Any]()
        self._base = opened(path, write=True, fsync=fsync)
        self._closing = threading.Event()
        self._waiting: list[Any] = []
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def begin(self, manifest: Manifest, sha256: str, time_s: float) -> None:
        """What follows is of this controller."""
        row = (time_s, f"{manifest.law} for {manifest.case}", sha256, manifest.period_s, json.dumps(columns(manifest)))
        self._queue.put(("run", row))

    def scan(self, scan: Scan) -> None:
        """Write a scan down."""
        self._queue.put(("scan", scan))

    def event(self, event: Event) -> None:
        """Write an event down."""
        self._queue.put(("event", event))

    def close(self) -> None:
        """Write what waits and end."""
        self._closing.set()
        self._queue.put(None)
        self._thread.join()
        self._base.close()

    # ------------------------------------------------------------------ the writer
    def _run(self) -> None:
        run = 0
        while True:
            self._take()
            if not self._waiting and self._closing.is_set():
                return
            try:
                run = self._write(run)
                if self.trouble:
                    self.tell("the journal writes again")
                self.trouble = ""
                self._waiting.clear()
                self._pack()
            except Exception as error:
                with suppress(sqlite3.Error):
                    self._base.rollback()
                if not self.trouble:
                    self.tell(f"the journal cannot be written: {named(error)}")
                self.trouble = named(error)
                if self._closing.is_set():
                    return
                if len(self._waiting) > WAITING:
                    self.lost += len(self._waiting) - WAITING
                    del self._waiting[: len(self._waiting) - WAITING]

    def _take(self) -> None:
        """Wait for something to write, then gather for ``FLUSH_S``."""
        if not self._waiting and not self._closing.is_set():
            first = self._queue.get()
            if first is not None:
                self._waiting.append(first)
        self._closing.wait(FLUSH_S)
        with suppress(queue.Empty):
            while True:
                item = self._queue.get_nowait()
                if item is not None:
                    self._waiting.append(item)

    def _write(self, run: int) -> int:
        with self._base:
            for kind, item in self._waiting:
                if kind == "run":
                    cursor = self._base.execute(
                        "insert into run (began, controller, sha256, period_s, columns) values (?, ?, ?, ?, ?)", item
                    )
                    run = int(cursor.lastrowid or 0)
                elif kind == "scan":
                    numbers = np.asarray(item.numbers, dtype=np.float64).tobytes()
                    quality = json.dumps(item.quality) if any(item.quality) else None
                    self._base.execute(
                        "insert into scan (run, time, mode, numbers, quality, reason) values (?, ?, ?, ?, ?, ?)",
                        (run, item.time_s, item.mode, numbers, quality, item.reason or None),
                    )
                else:
                    self._base.execute(
                        "insert into event (time, kind, who, what, reason) values (?, ?, ?, ?, ?)",
                        (item.time_s, item.kind, item.who, item.what, item.reason),
                    )
        return run

    def _pack(self) -> None:
        """Pack the oldest scans once there are enough, and drop the oldest blocks once there are too many."""
        (count,) = self._base.execute("select count(*) from scan").fetchone()
        while count >= FRESH + BLOCK:
            rows = self._base.execute(
                "select id, run, time, mode, numbers, quality, reason from scan order by id limit ?", (BLOCK,)
            ).fetchall()
            rows = [row for row in rows if row[1] == rows[0][1]]
            with self._base:
                self._base.execute(
                    "insert into block values (?, ?, ?, ?, ?, ?)",
                    (rows[0][0], rows[-1][0], rows[0][1], rows[0][2], rows[-1][2], packed(rows)),
                )
                self._base.execute("delete from scan where id <= ?", (rows[-1][0],))
                self._shorten()
            count -= len(rows)

    def _shorten(self) -> None:
        (size,) = self._base.execute("select coalesce(sum(length(data)), 0) from block").fetchone()
        for first, length in self._base.execute("select first, length(data) from block order by first").fetchall():
            if size <= self.max_bytes:
                return
            self._base.execute("delete from block where first = ?", (first,))
            size -= length


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
        rows = self._base.execute("select id, began, controller, sha256, period_s, columns from run order by id")
        names = ("id", "began", "controller", "sha256", "period_s", "columns")
        return [dict(zip(names, (*row[:-1], json.loads(row[-1])), strict=True)) for row in rows]

    def scans(
        self, after_id: int = 0, begin_s: float = -1e300, end_s: float = 1e300
    ) -> Iterator[tuple[int, int, Scan]]:
        """(id, run, scan) of the scans after an id and within times, in order."""
        with closing(self._base.cursor()) as cursor:
            cursor.execute("begin")  # one state of the file: rows are packed meanwhile
            try:
                cursor.execute(
                    "select data, run, first from block where last > ? and end >= ? and begin <= ? order by first",
                    (after_id, begin_s, end_s),
                )
                for data, run, first in cursor.fetchall():
                    for i, scan in enumerate(unpacked(data)):
                        if first + i > after_id and begin_s <= scan.time_s <= end_s:
                            yield first + i, run, scan
                cursor.execute(
                    "select id, run, time, mode, numbers, quality, reason from scan "
                    "where id > ? and time between ? and ? order by id",
                    (after_id, begin_s, end_s),
                )
                for id_, run, time_s, mode, numbers, quality, reason in cursor.fetchall():
                    values = tuple(np.frombuffer(numbers).tolist())
                    yield id_, run, Scan(time_s, mode, values, tuple(json.loads(quality or "[]")), reason or "")
            finally:
                cursor.execute("rollback")

    def events(self, after_id: int = 0, begin_s: float = -1e300, end_s: float = 1e300) -> list[tuple[int, Event]]:
        """(id, event) after an id and within times, in order."""
        rows = self._base.execute(
            "select id, time, kind, who, what, reason from event where id > ? and time between ? and ? order by id",
            (after_id, begin_s, end_s),
        )
        return [(row[0], Event(*row[1:])) for row in rows]


def opened(path: Path, *, write: bool, fsync: str = "crash") -> sqlite3.Connection:
    """A journal's database. LoopError where there is none to read, or the file is something else."""
    if not write and not path.is_file():
        raise LoopError(f"{path} is not here; it is the journal that a loop writes")
    try:
        address = path.absolute().as_uri() + ("" if write else "?mode=ro")
        base = sqlite3.connect(address, uri=True, timeout=10, check_same_thread=False)
        with closing(base.cursor()) as cursor:
            (version,) = cursor.execute("pragma user_version").fetchone()
            (tables,) = cursor.execute("select count(*) from sqlite_master").fetchone()
            if version != SCHEMA and (tables or not write):
                raise LoopError(
                    f"{path} is no journal of this release (version {version}, not {SCHEMA}); name another file"
                )
            if write:
                cursor.execute("pragma journal_mode=wal")
                cursor.execute(f"pragma synchronous={'full' if fsync == 'power loss' else 'normal'}")
                cursor.executescript(TABLES)
                cursor.execute(f"pragma user_version={SCHEMA}")
    except sqlite3.Error as error:
        raise LoopError(f"{path} is no journal, or cannot be written: {error}") from None
    return base


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


def unpacked(data: bytes) -> list[Scan]:
    """The scans that ``packed`` made one value of."""
    content = zlib.decompress(data)
    size = int.from_bytes(content[:4], "little")
    head = json.loads(content[4 : 4 + size])
    n = head["rows"]
    planes = np.frombuffer(content, dtype=np.uint8, offset=4 + size).reshape(-1, 8, n)
    table = planes.transpose(0, 2, 1).copy().view("<f8")[..., 0].T
    modes = [mode for mode, times in head["modes"] for _ in range(times)]
    return [
        Scan(row[0], modes[i], tuple(row[1:]), tuple(head["quality"].get(str(i), ())), head["reason"].get(str(i), ""))
        for i, row in enumerate(table.tolist())
    ]


def _runs(values: Sequence[str]) -> list[tuple[str, int]]:
    found: list[tuple[str, int]] = []
    for value in values:
        if found and found[-1][0] == value:
            found[-1] = (value, found[-1][1] + 1)
        else:
            found.append((value, 1))
    return found
