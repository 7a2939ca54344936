"""Writes everything that a loop did, scan by scan, into one SQLite file that survives the death of its process."""

from __future__ import annotations

import json
import math
import os
import sqlite3
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from loopwright.serving.clock import MACHINE_TIME, Time
from loopwright.serving.errors import LoopError
from loopwright.serving.journal.entries import EventEntry, ScanEntry, columns, packed
from loopwright.serving.journal.file import held, holds, is_damage, opened, sole_writer
from loopwright.serving.journal.recovery import FileChange, OpenFiles, alarm, cleared, copied, made_again
from loopwright.serving.journal.waiting import EntryQueue, Item
from loopwright.serving.manifest import Manifest
from loopwright.serving.words import named

EVENT_SHARE, EVENT_BYTES = 0.05, 400  # of the size for scans; of an event with its indexes
LEAST_EVENTS = 1_000  # events that a journal keeps, however small it is
EVENT_SLACK = 0.1  # of the events, by which there may be more until some go

# Of each alarm its newest event, which says whether it is active; and the newest alarms that nobody has acknowledged.
# With them their ends and acknowledgments.
KEPT = (
    "create temp table if not exists kept (id integer primary key)",
    "delete from kept",
    "insert into kept select max(id) from event where alarm != '' group by alarm",
    """insert or ignore into kept select e.id from event e where e.raised
        and not exists (select 1 from event a where a.about = e.id) order by e.id desc limit :unseen""",
    """insert or ignore into kept select n.id from (
        select (select min(n.id) from event n where n.alarm = e.alarm and n.id > e.id) as id
        from event e join kept k on k.id = e.id) n where n.id is not null""",
    "insert or ignore into kept select a.id from event a join kept k on a.about = k.id",
)


def most_events(max_bytes: float) -> int:
    """How many events a journal keeps beside ``max_bytes`` of scans."""
    return max(LEAST_EVENTS, int(EVENT_SHARE * max_bytes / EVENT_BYTES))


def shorten_scans(base: sqlite3.Connection, max_bytes: float) -> None:
    """Drop the oldest blocks of scans, and the runs that have none any more."""
    (size,) = base.execute("select coalesce(sum(length(data)), 0) from block").fetchone()
    if size <= max_bytes:
        return
    for first, length in base.execute("select first, length(data) from block order by first").fetchall():
        base.execute("delete from block where first = ?", (first,))
        size -= length
        if size <= max_bytes:
            break
    base.execute("delete from run where id < (select min(run) from (select run from block union select run from scan))")


def shorten_events(base: sqlite3.Connection, most: int) -> None:
    """Drop the oldest events beyond ``most``.

    The state of active alarms stays; of those that are over and not acknowledged, as many as are half of ``most``.
    """
    (count,) = base.execute("select count(*) from event").fetchone()
    if count <= most * (1 + EVENT_SLACK):
        return
    for statement in KEPT:
        base.execute(statement, {"unseen": most // 2} if ":unseen" in statement else {})
    old = "select id from event where id not in (select id from kept) order by id limit ?"
    base.execute(f"delete from event where id in ({old})", (count - most,))


# ---------------------------------------------------------------------------------------------------------- the writer
FLUSH_S = 0.25  # so much is lost at most when the process dies
BLOCK_SCANS = 600  # scans that are packed together
FRESH = 1200  # the last scans, a row each
WAITING_ENTRIES = 200_000  # scans and events that wait in memory while the disk takes none
TRANSACTION_ENTRIES = 2_000  # are written at most in one transaction
STALL_S = 10.0  # a write that takes longer is told
AGAIN_S = 10.0  # until a file is tried again that could not be made again
UNSTEADY = 2  # such files in a row that are another one at once, as on some file systems over a network
CLOSE_S = 30.0  # without a scan written, after which an end waits no longer


class Journal:
    """Writes scans and events from a thread of its own; ``scan`` and ``event`` return at once.

    The file is in WAL mode: a process that dies, whatever it was doing, leaves a whole file without its last
    ``FLUSH_S`` at most. With ``fsync`` "power loss" each write waits for the disk. Older scans are packed, and beyond
    ``max_mb`` the oldest go; so do the oldest events, but no alarm that is active (see ``rotation``). While the disk
    takes nothing, or does not answer, scans wait in memory, and ``trouble`` says why. Beyond ``WAITING_ENTRIES`` the
    oldest are ``lost``, scans before events; what a run is stays. The loop tells it once, and once the journal writes
    again, an alarm in it says how many they were. A file that is deleted, replaced, cut or damaged meanwhile is made
    again, with the rows that the open one still gives; an alarm says how many went, and they are ``lost`` (see
    ``recovery``).

    Raises LoopError for a file that is no journal, and for one that another ``Journal`` writes, also of this process.
    """

    def __init__(
        self,
        path: Path,
        *,
        max_mb: float = 2000.0,
        fsync: Literal["power loss", "crash"] = "crash",
        tell: Callable[[str], None] = lambda _: None,
        time: Time = MACHINE_TIME,
    ) -> None:
        self.path, self.max_bytes, self.tell, self._time = path, max_mb * 1e6, tell, time
        self.trouble = ""
        self._fsync = fsync
        self._most_events = self._events = most_events(self.max_bytes)  # written since the last look at how many
        self._queue, self._taken = EntryQueue(), list[Item]()
        self._writing_s: float | None = None  # since when, on a monotonic clock
        self._base = opened(path, write=True, fsync=fsync)
        try:
            self._lock = sole_writer(path)
        except LoopError:
            self._base.close()
            raise
        self._files = OpenFiles(path.resolve())
        self._harm: FileChange | None = None  # which has yet to be mended
        self._making, self._made_s = False, -math.inf  # whether the file is being made again; when it last was
        self._replaced = 0  # how many times in a row right after it was made
        self._run_id, self._run_row = 0, None  # the run of the scans that come
        self._held = held(self._base)  # scans and events that stand in the file, those of earlier runs too
        self._ids = dict[str, int]()  # the last ones by this journal
        self._told = 0  # of what is lost, as much as stands in the journal
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._start()

    def _start(self) -> None:
        self._thread.start()

    @property
    def behind(self) -> int:
        """How many scans and events wait to be written."""
        return len(self._queue)

    @property
    def lost(self) -> int:
        """How many scans and events were given up."""
        return self._queue.lost

    def begin(self, manifest: Manifest, sha256: str, time_s: float, speed: float = 1.0) -> None:
        """The scans that follow are of this controller, on a plant that is ``speed`` times as fast as the clock."""
        m = manifest
        signals = {name: [s.to_dict() for s in m.signals(name)] for name in ("sp", "pv", "mv", "dv")}
        texts = (json.dumps(columns(m)), json.dumps(signals))
        row = (time_s, f"{m.law} for {m.case}", sha256, m.period_s, speed, *texts)
        self._put("run", row)

    def scan(self, scan: ScanEntry) -> None:
        """Write a scan down."""
        self._put("scan", scan)

    def event(self, event: EventEntry) -> None:
        """Write an event down."""
        self._put("event", event)

    def keep(self, name: str, value: str) -> None:
        """Keep a text under a name, for the next run of the loop."""
        self._put("learnt", (name, value))

    def close(self) -> None:
        """Write what waits and end. A disk that does not answer for ``CLOSE_S`` is waited for no longer, and told."""
        self._closing.set()
        self._queue.wake()
        if not self._finished():  # the thread has the file open still
            n = self._queue.give_up()
            end = f"the last {n} scans and events are lost" if n else "nothing waits to be written"
            self.tell(f"the journal's disk does not answer: {end}")
            return
        self._base.close()
        os.close(self._lock)

    def _finished(self) -> bool:
        """Wait until all is written; False where the disk does not answer."""
        waiting = None
        while self._thread.is_alive() and waiting != self.behind:
            waiting = self.behind
            self._thread.join(CLOSE_S)
        return not self._thread.is_alive()

    def _put(self, kind: str, row: Any) -> None:
        if self._queue.put((kind, row), WAITING_ENTRIES):
            self.tell(f"the journal has {WAITING_ENTRIES} scans and events that wait: from now on the oldest are lost")
        since = self._writing_s
        if since is not None and not self.trouble and self._time.steady_s() - since > STALL_S:
            what = "its file is being made again" if self._making else "the disk has not answered"
            self.trouble = f"{what} for {STALL_S:g} s"
            self.tell(f"the journal cannot be written: {self.trouble}")

    # ------------------------------------------------------------------ the writer
    def _run(self) -> None:
        """Wait for something to write, gather, unless enough waits already, and write."""
        ended = False
        while not ended:
            if not self._closing.is_set():
                self._queue.wait()
            if self.trouble or len(self._queue) < TRANSACTION_ENTRIES:
                self._closing.wait(self.gathers_s)
            ended = self._turn()

    @property
    def gathers_s(self) -> float:
        """How long [s] it waits for more before it writes."""
        return FLUSH_S if self._harm is None else AGAIN_S

    def _turn(self) -> bool:
        """Write what waits, as far as the disk takes it now; whether nothing will be written any more."""
        self._taken = self._queue.take(TRANSACTION_ENTRIES)
        last = not self._taken and self._closing.is_set()
        self._writing_s = self._time.steady_s()
        try:
            self._tend()
            if last:
                return True
            self._write()
            self._queue.written()
            lost = self.lost - self._told
            if self.trouble or lost:
                self.tell("the journal writes again" + (LOSS.format(lost) if lost else ""))
            self.trouble = ""
            if lost:
                what = "the journal could not be written" + LOSS.format(lost)
                self._note(alarm(self._time.wall_s(), what, "over: it writes again"))
                self._told += lost
            self._pack()
            self._rotate()
        except Exception as error:
            with suppress(sqlite3.Error):
                self._base.rollback()
            if not self.trouble:
                self.tell(f"the journal cannot be written: {named(error)}")
            self.trouble = named(error)
            damaged = self._harm is None and is_damage(error)
            self._harm = FileChange.DAMAGED if damaged else self._harm
            if self._closing.is_set() and not damaged:
                self._give_up()
                return True
            self._queue.give_back(WAITING_ENTRIES)
        finally:
            self._writing_s = None
        return False

    def _write(self) -> None:
        run, row, ids, n = self._run_id, self._run_row, dict(self._ids), 0
        with self._base:
            for kind, item in self._taken:
                if kind == "run":
                    run, row = self._begun(item), item
                elif kind == "scan":
                    numbers = np.asarray(item.numbers, dtype=np.float64).tobytes()
                    quality = json.dumps(item.quality) if any(item.quality) else None
                    cursor = self._base.execute(
                        "insert into scan (run, time, mode, numbers, quality, reason) values (?, ?, ?, ?, ?, ?)",
                        (run, item.time_s, item.mode, numbers, quality, item.reason or None),
                    )
                    ids["scan"], n = int(cursor.lastrowid or 0), n + 1
                elif kind == "learnt":
                    self._base.execute("insert or replace into learnt (name, value) values (?, ?)", item)
                else:
                    ids["event"], n = self._noted(item), n + 1
        self._run_id, self._run_row, self._ids, self._held = run, row, ids, self._held + n

    def _begun(self, row: Any) -> int:
        cursor = self._base.execute(
            "insert into run (began, controller, sha256, period_s, speed, columns, signals) "
            "values (?, ?, ?, ?, ?, ?, ?)",
            row,
        )
        return int(cursor.lastrowid or 0)

    def _noted(self, event: EventEntry) -> int:
        self._events += 1
        cursor = self._base.execute(
            "insert into event (time, kind, who, what, reason, alarm, raised, about) values (?, ?, ?, ?, ?, ?, ?, ?)",
            astuple(event),
        )
        return int(cursor.lastrowid or 0)

    def _note(self, events: list[EventEntry]) -> None:
        """Write down what the journal has to say of itself."""
        with self._base:
            for event in events:
                self._ids["event"] = self._noted(event)
        self._held += len(events)

    def _give_up(self) -> None:
        """Count what is lost at the end."""
        n = self._queue.give_up() + (self._held if self._harm else 0)
        self._queue.lost += self._held if self._harm else 0
        if n:
            self.tell(f"the journal cannot be written: the last {n} scans and events are lost")

    # ------------------------------------------------------------------ a file that went away
    def _tend(self) -> None:
        """Make the file again where it is no longer the one that was opened; before that its lock."""
        self._harm = self._harm or self._files.harm(self._held)
        if not holds(self.path, self._lock):
            self._files.path.parent.mkdir(parents=True, exist_ok=True)
            lock = sole_writer(self.path)
            os.close(self._lock)
            self._lock = lock
        if self._harm is not None:
            self._making = True
            try:
                self._make_again(self._harm)
            finally:
                self._making = False

    def _make_again(self, harm: FileChange) -> None:
        """A new file with all rows of the open one; an empty one where that cannot be read any more.

        Where the disk takes no copy now, the error is raised: the open file has the rows still.
        """
        path, old = self._files.path, self._base
        copy = None if harm is FileChange.DAMAGED else copied(old, path)
        again = harm is FileChange.REPLACED and self._time.steady_s() - self._made_s < 2 * AGAIN_S
        self._replaced = self._replaced + 1 if again else 0
        unsteady = self._files.steady and self._replaced >= UNSTEADY
        self._files.steady = self._files.steady and not unsteady
        aside = cleared(self._files, keep=copy is None)
        try:
            if copy is not None:
                copy.rename(path)
            elif self._files.mode is not None:
                path.touch()
            if self._files.mode is not None:
                path.chmod(self._files.mode)
            self._base = opened(path, write=True, fsync=self._fsync)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        with suppress(sqlite3.Error):
            old.close()
        self._files = OpenFiles(path, steady=self._files.steady)
        self._made_s = self._time.steady_s()
        lost, self._held = max(0, self._held - held(self._base)), held(self._base)
        self._queue.lost, self._told = self._queue.lost + lost, self._told + lost
        self._go_on()
        self._harm = None
        what = made_again(harm, lost, empty=copy is None, aside=aside, unsteady=unsteady)
        self.tell(what)
        self._note(alarm(self._time.wall_s(), what, "over: it is made again"))

    def _go_on(self) -> None:
        """Number the rows of a file that lacks some as the one before: whoever saw a row asks for those after it."""
        with self._base:
            for table, last in self._ids.items():
                self._base.execute("delete from sqlite_sequence where name = ?", (table,))
                self._base.execute("insert into sqlite_sequence (name, seq) values (?, ?)", (table, last))
            if not self._base.execute("select 1 from run where id = ?", (self._run_id,)).fetchone():
                self._run_id = 0 if self._run_row is None else self._begun(self._run_row)

    def _pack(self) -> None:
        """Pack the oldest scans once there are enough, and drop the oldest blocks once there are too many."""
        (count,) = self._base.execute("select count(*) from scan").fetchone()
        while count >= FRESH + BLOCK_SCANS:
            rows = self._base.execute(
                "select id, run, time, mode, numbers, quality, reason from scan order by id limit ?", (BLOCK_SCANS,)
            ).fetchall()
            # One run a block. Releases that let two loops write one journal left runs that alternate, and the ids of a
            # block have no gap: a file that lost rows has one.
            run, first = rows[0][1], rows[0][0]
            rows = [row for k, row in enumerate(rows) if row[0] - k == first]
            rows = next(list(same) for _, same in groupby(rows, key=itemgetter(1)))
            times = [row[2] for row in rows]  # not in order where the clock was set
            with self._base:
                self._base.execute(
                    "insert into block values (?, ?, ?, ?, ?, ?)",
                    (rows[0][0], rows[-1][0], run, min(times), max(times), packed(rows)),
                )
                self._base.execute("delete from scan where run = ? and id <= ?", (run, rows[-1][0]))
                shorten_scans(self._base, self.max_bytes)
            count -= len(rows)
            self._held = held(self._base)

    def _rotate(self) -> None:
        """Drop the oldest events once there are too many; seldom looked at, since each look goes through all."""
        if self._events >= EVENT_SLACK * self._most_events:
            self._events = 0
            with self._base:
                shorten_events(self._base, self._most_events)
            self._held = held(self._base)


LOSS = "; {} scans and events are lost that the disk did not take"
