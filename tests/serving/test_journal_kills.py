"""A journal whose process is killed, whatever it was doing: the file is whole, and the last second is lost at most."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from loopwright.serving import Controller
from loopwright.serving.journal import JournalReader

pytest_plugins = ["small_laws"]

PAUSE_S = 0.1  # a process that gives a scan each millisecond did not run for longer than that

# For each line that it reads, "STATEMENT|N", it forks a process that writes until it is killed: from outside, or as
# SQLite begins the Nth STATEMENT. "small" makes it pack and rotate all the time.
WRITER = """
import os, signal, sys, time
from pathlib import Path
from loopwright.serving import Manifest
from loopwright.serving.journal import writer
from loopwright.serving.journal import EventEntry, Journal, ScanEntry, writer
path, manifest, small = Path(sys.argv[1]), Manifest.from_json(sys.argv[2]), sys.argv[3] == "small"
if small:
    writer.BLOCK_SCANS, writer.FRESH, writer.FLUSH_S, writer.LEAST_EVENTS = 20, 40, 0.02, 60

def write(statement, nth):
    journal, seen = Journal(path, max_mb=0.02 if small else 2000.0), 0
    def trace(text):
        nonlocal seen
        seen += bool(statement) and text.startswith(statement)
        if statement and seen == nth:
            os.kill(os.getpid(), signal.SIGKILL)
    journal._base.set_trace_callback(trace)
    journal.begin(manifest, "", time.time())
    journal.event(EventEntry(time.time(), "fault", "loop", "the level is high", alarm="level", raised=True))
    for k in range(20_000):
        journal.scan(ScanEntry(time.time(), "AUTO", (float(k),) * 9))
        if small:
            journal.event(EventEntry(time.time(), "change", "anna", f"set point {k}"))
        os.write(1, b"%f\\n" % time.time())
        time.sleep(0.001)

for line in sys.stdin:
    statement, nth = line.rstrip().split("|")
    child = os.fork()
    if child == 0:
        write(statement, int(nth))
        os._exit(0)
    os.write(1, b"pid %d\\n" % child)
    _, status = os.waitpid(child, 0)
    os.write(1, b"ended %d\\n" % os.waitstatus_to_exitcode(status))
"""


class Writers:
    """Processes that write one journal, one after the other."""

    def __init__(self, path: Path, controller: Controller, size: str) -> None:
        command = [sys.executable, "-c", WRITER, str(path), controller.manifest.to_json(), size]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def killed(self, statement: str = "", nth: int = 1, after: int = 0) -> list[float]:
        """When each scan was given to the journal, until the process was killed: without a statement after so many."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{statement}|{nth}\n")
        self._process.stdin.flush()
        times, pid = [], 0
        for line in self._process.stdout:
            head, _, rest = line.rstrip().partition(" ")
            if head == "pid":
                pid = int(rest)
            elif head == "ended":
                assert int(rest) == -signal.SIGKILL
                return times
            else:
                times.append(float(head))
            if pid and not statement and len(times) == after:
                os.kill(pid, signal.SIGKILL)
        raise AssertionError("the program has ended")

    def close(self) -> None:
        self._process.communicate()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "loop.journal"


@pytest.fixture
def writers(path: Path, controller: Controller, request: pytest.FixtureRequest) -> Iterator[Writers]:
    made = Writers(path, controller, request.param)
    yield made
    made.close()


def lost_s(times: list[float], last_s: float) -> float:
    """For how long the process gave scans after the last one that was kept. A pause in which it did not run is none."""
    after = [time_s for time_s in times if time_s > last_s]
    return sum(min(b - a, PAUSE_S) for a, b in pairwise([last_s, *after]))


def whole(path: Path) -> None:
    with closing(sqlite3.connect(path)) as base:
        assert base.execute("pragma integrity_check").fetchone() == ("ok",)


@pytest.mark.parametrize("writers", ["usual"], indirect=True)
def test_a_killed_process_loses_at_most_its_last_second(path: Path, writers: Writers) -> None:
    """Fifty times, in the middle of writing and packing."""
    rng, before = np.random.default_rng(0), 0
    for _ in range(50):
        times = writers.killed(after=int(rng.integers(50, 500)))
        whole(path)
        with closing(JournalReader(path)) as reader:
            found = list(reader.scans(after_id=before))
        assert [i for i, _, _ in found] == list(range(before + 1, before + 1 + len(found)))
        before += len(found)
        assert lost_s(times, found[-1][2].time_s if found else times[0]) < 1.0


@pytest.mark.parametrize("writers", ["small"], indirect=True)
def test_a_process_that_is_killed_while_it_packs_or_rotates_loses_nothing_more(path: Path, writers: Writers) -> None:
    last = 0
    for statement in (
        *("insert into block", "delete from scan", "delete from block", "delete from run", "delete from kept"),
        *("insert into kept", "delete from event", "BEGIN", "COMMIT"),
    ):
        for nth in (1, 2, 5):
            times = writers.killed(statement, 7 * nth if statement.isupper() else nth)
            whole(path)
            with closing(JournalReader(path)) as reader:
                found = list(reader.scans())
                events = [event for _, event in reader.events()]
                runs = {run["id"] for run in reader.runs()}
                active = [entry.event.alarm for entry in reader.active()]
            ids = [i for i, _, _ in found]
            assert ids == list(range(ids[0], ids[-1] + 1)), statement
            assert ids[-1] >= last
            last = ids[-1]
            assert lost_s(times, found[-1][2].time_s) < 1.0, statement
            assert lost_s(times, events[-1].time_s) < 1.0, statement
            assert {run for _, run, _ in found} <= runs
            assert "level" in active, statement
    assert ids[0] > 1  # the oldest have gone
