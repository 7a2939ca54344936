"""Writes everything that a loop did, scan by scan, into one SQLite file that survives the death of its process."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from serving.errors import LoopError
from serving.journal.entries import Event, Scan, columns
from serving.journal.file import opened, sole_writer
from serving.journal.packing import packed
from serving.journal.rotation import SLACK, most_events, shorten_events, shorten_scans
from serving.journal.waiting import Item, Waiting
from serving.manifest import Manifest
from serving.words import named

FLUSH_S = 0.25  # so much is lost at most when the process dies
BLOCK = 600  # scans that are packed together
FRESH = 1200  # the last scans, a row each
WAITING = 200_000  # scans and events that wait in memory while the disk takes none
TOGETHER = 2_000  # are written at most in one transaction
STALL_S = 10.0  # a write that takes longer is told
CLOSE_S = 30.0  # without a scan written, after which an end waits no longer


class Journal:
    """Writes scans and events from a thread of its own; ``scan`` and ``event`` return at once.

    The file is in WAL mode: a process that dies, whatever it was doing, leaves a whole file without its last
    ``FLUSH_S`` at most. With ``fsync`` "power loss" each write waits for the disk. Older scans are packed, and beyond
    ``max_mb`` the oldest go; so do the oldest events, but no alarm that is active (see ``rotation``). While the disk
    takes nothing, or does not answer, scans wait in memory, and ``trouble`` says why. Beyond ``WAITING`` the oldest are
    ``lost``, scans before events; what a run is stays. That is told once, and once the journal writes again, an alarm
    in it says how many they were.

    Raises LoopError for a file that is no journal, and for one that another ``Journal`` writes, also of this process.
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
        self.trouble = ""
        self._fsync = fsync
        self._most_events = self._events = most_events(self.max_bytes)  # written since the last look at how many
        self._queue, self._taken = Waiting(), list[Item]()
        self._writing_s: float | None = None  # since when, on a monotonic clock
        self._base = opened(path, write=True, fsync=fsync)
        try:
            self._lock = sole_writer(path)
        except LoopError:
            self._base.close()
            raise
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
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
        """What follows is of this controller, on a plant that is ``speed`` times as fast as the clock."""
        m = manifest
        signals = {name: [s.to_dict() for s in m.signals(name)] for name in ("sp", "pv", "mv", "dv")}
        texts = (json.dumps(columns(m)), json.dumps(signals))
        row = (time_s, f"{m.law} for {m.case}", sha256, m.period_s, speed, *texts)
        self._put("run", row)

    def scan(self, scan: Scan) -> None:
        """Write a scan down."""
        self._put("scan", scan)

    def event(self, event: Event) -> None:
        """Write an event down."""
        self._put("event", event)

    def keep(self, name: str, value: str) -> None:
        """Keep a text under a name, for the next run of the loop."""
        self._put("learnt", (name, value))

    def close(self) -> None:
        """Write what waits and end. A disk that does not answer for ``CLOSE_S`` is waited for no longer, and told."""
        self._closing.set()
        self._queue.wake()
        waiting = None
        while self._thread.is_alive() and waiting != self.behind:
            waiting = self.behind
            self._thread.join(CLOSE_S)
        if self._thread.is_alive():  # which has the file open still
            self.tell(f"the journal cannot be written: the last {waiting} scans and events are lost")
            return
        self._base.close()
        os.close(self._lock)

    def _put(self, kind: str, row: Any) -> None:
        if self._queue.put((kind, row), WAITING):
            self.tell(f"the journal has {WAITING} scans and events that wait: from now on the oldest are lost")
        since = self._writing_s
        if since is not None and not self.trouble and time.monotonic() - since > STALL_S:
            self.trouble = f"the disk has not answered for {STALL_S:g} s"
            self.tell(f"the journal cannot be written: {self.trouble}")

    # ------------------------------------------------------------------ the writer
    def _run(self) -> None:
        run = told = 0  # of what is lost, as much as stands in the journal
        while True:
            self._take()
            if not self._taken and self._closing.is_set():
                return
            self._writing_s = time.monotonic()
            try:
                run = self._write(run)
                self._queue.written()
                lost, told = self.lost - told, self.lost
                if self.trouble or lost:
                    self.tell("the journal writes again" + (LOSS.format(lost) if lost else ""))
                self.trouble, self._taken = "", _loss(lost) if lost else []
                if self._taken:
                    run = self._write(run)
                self._pack()
                self._rotate()
            except Exception as error:
                with suppress(sqlite3.Error):
                    self._base.rollback()
                if not self.trouble:
                    self.tell(f"the journal cannot be written: {named(error)}")
                self.trouble = named(error)
                if self._closing.is_set():
                    return
                self._queue.give_back(WAITING)
            finally:
                self._writing_s = None

    def _take(self) -> None:
        """Wait for something to write, then gather for ``FLUSH_S``, unless enough waits already."""
        if not self._closing.is_set():
            self._queue.wait()
        if self.trouble or len(self._queue) < TOGETHER:
            self._closing.wait(FLUSH_S)
        self._taken = self._queue.take(TOGETHER)

    def _write(self, run: int) -> int:
        with self._base:
            for kind, item in self._taken:
                if kind == "run":
                    cursor = self._base.execute(
                        "insert into run (began, controller, sha256, period_s, speed, columns, signals) "
                        "values (?, ?, ?, ?, ?, ?, ?)",
                        item,
                    )
                    run = int(cursor.lastrowid or 0)
                elif kind == "scan":
                    numbers = np.asarray(item.numbers, dtype=np.float64).tobytes()
                    quality = json.dumps(item.quality) if any(item.quality) else None
                    self._base.execute(
                        "insert into scan (run, time, mode, numbers, quality, reason) values (?, ?, ?, ?, ?, ?)",
                        (run, item.time_s, item.mode, numbers, quality, item.reason or None),
                    )
                elif kind == "learnt":
                    self._base.execute("insert or replace into learnt (name, value) values (?, ?)", item)
                else:
                    self._events += 1
                    self._base.execute(
                        "insert into event (time, kind, who, what, reason, alarm, raised, about) "
                        "values (?, ?, ?, ?, ?, ?, ?, ?)",
                        astuple(item),
                    )
        return run

    def _pack(self) -> None:
        """Pack the oldest scans once there are enough, and drop the oldest blocks once there are too many."""
        (count,) = self._base.execute("select count(*) from scan").fetchone()
        while count >= FRESH + BLOCK:
            rows = self._base.execute(
                "select id, run, time, mode, numbers, quality, reason from scan order by id limit ?", (BLOCK,)
            ).fetchall()
            # One run a block. Releases that let two loops write one journal left runs that alternate, and the ids of a
            # block have no gap.
            run = rows[0][1]
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

    def _rotate(self) -> None:
        """Drop the oldest events once there are too many; seldom looked at, since each look goes through all."""
        if self._events >= SLACK * self._most_events:
            self._events = 0
            with self._base:
                shorten_events(self._base, self._most_events)


LOSS = "; {} scans and events are lost that the disk did not take"


def _loss(n: int) -> list[Any]:
    """An alarm that is over and that somebody has to see."""
    what = "the journal could not be written" + LOSS.format(n)
    found = Event(time.time(), "fault", "journal", what, alarm="journal", raised=True)
    return [
        ("event", found),
        ("event", Event(found.time_s, "fault", "journal", "over: it writes again", alarm="journal")),
    ]
