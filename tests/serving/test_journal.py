"""A journal holds what happened, whole; see test_journal_kills.py for what happens to its process."""

from __future__ import annotations

import itertools
import os
import sqlite3
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import within

from loopwright.serving import Controller, LoopError
from loopwright.serving.journal import EventEntry, Journal, JournalReader, ScanEntry, columns, writer
from loopwright.serving.journal.entries import EVENT, Kind, packed, unpacked
from loopwright.serving.journal.file import TABLES
from loopwright.serving.journal.writer import BLOCK_SCANS, EVENT_SLACK, FRESH, LEAST_EVENTS, shorten_events
from loopwright.serving.page.prometheus import metrics_text
from loopwright.serving.station.recorder import Recorder

pytest_plugins = ["small_laws"]


def scans(n: int, seed: int = 0, width: int = 9) -> list[ScanEntry]:
    rng = np.random.default_rng(seed)
    found = []
    for k in range(n):
        numbers = tuple(np.where(rng.random(width) < 0.1, np.nan, rng.normal(size=width)).tolist())
        quality = (0, 2147483648) if k % 50 == 3 else ()
        found.append(
            ScanEntry(1e9 + k, ("AUTO", "HOLD")[k % 97 > 90], numbers, quality, "PV level: bad" * (k % 50 == 3))
        )
    return found


def same(a: ScanEntry, b: ScanEntry) -> bool:
    return np.array_equal(a.numbers, b.numbers, equal_nan=True) and (a.time_s, a.mode, a.quality, a.reason) == (
        b.time_s, b.mode, b.quality, b.reason,
    )  # fmt: skip


def test_what_is_written_is_read_also_after_it_was_packed(tmp_path: Path, controller: Controller) -> None:
    given = scans(FRESH + 3 * BLOCK_SCANS + 7)
    journal = Journal(tmp_path / "loop.journal")
    journal.begin(controller.manifest, controller.sha256, 1e9)
    for scan in given:
        journal.scan(scan)
    journal.event(EventEntry(1e9, "change", "anna", "mode AUTO", "start of the shift"))
    journal.close()
    reader = JournalReader(tmp_path / "loop.journal")
    found = list(reader.scans())
    assert [id_ for id_, _, _ in found] == list(range(1, len(given) + 1))
    assert all(same(a, b) for a, (_, _, b) in zip(given, found, strict=True))
    assert reader.events() == [(1, EventEntry(1e9, "change", "anna", "mode AUTO", "start of the shift"))]
    (run,) = reader.runs()
    assert run["columns"] == columns(controller.manifest)
    assert run["columns"][:4] == ["sp level", "pv level", "pv T", "mv valve"]
    # a part of it, by id and by time, within a block and across
    assert [i for i, _, _ in reader.scans(after_id=595)] == list(range(596, len(given) + 1))
    assert [s.time_s - 1e9 for _, _, s in reader.scans(begin_s=1e9 + 598.5, end_s=1e9 + 602)] == [599, 600, 601, 602]
    reader.close()
    base = sqlite3.connect(tmp_path / "loop.journal")
    assert base.execute("select count(*) from block").fetchone() == (3,)


def test_a_pack_is_smaller_than_its_rows() -> None:
    rng = np.random.default_rng(0)
    rows = [
        (k, 1, 1e9 + k, "AUTO", np.array([0.5, rng.normal(300, 0.1), 40.0]).tobytes(), None, None) for k in range(600)
    ]
    assert len(packed(rows)) < 600 * 4 * 8 / 3
    assert [s.time_s for s in unpacked(packed(rows))] == [1e9 + k for k in range(600)]


def test_a_journal_goes_on_where_it_was(tmp_path: Path, controller: Controller) -> None:
    path = tmp_path / "loop.journal"
    for part in range(3):
        journal = Journal(path)
        journal.begin(controller.manifest, controller.sha256, 1e9 + part)
        for scan in scans(10, part):
            journal.scan(scan)
        journal.close()
    reader = JournalReader(path)
    assert [(i, run) for i, run, _ in reader.scans()] == [(10 * r + k + 1, r + 1) for r in range(3) for k in range(10)]
    reader.close()


def test_the_oldest_go_where_it_would_grow_too_large(tmp_path: Path, controller: Controller) -> None:
    path, sizes, n = tmp_path / "loop.journal", [], FRESH + 10 * BLOCK_SCANS
    for _ in range(4):
        journal = Journal(path, max_mb=0.2)
        journal.begin(controller.manifest, controller.sha256, 1e9)
        for scan in scans(n):
            journal.scan(scan)
        journal.close()
        sizes.append(path.stat().st_size)
    reader = JournalReader(path)
    ids = [i for i, _, _ in reader.scans()]
    reader.close()
    assert ids == list(range(ids[0], 4 * n + 1))  # no gap within
    assert ids[0] > 3 * n - BLOCK_SCANS
    assert sizes[3] < 1.05 * sizes[1] < 1_500_000


def test_events_are_bounded_and_no_alarm_is_lost_that_somebody_has_yet_to_see(
    tmp_path: Path, controller: Controller
) -> None:
    path = tmp_path / "loop.journal"

    def event(k: int, kind: Kind, what: str, **more: Any) -> EventEntry:
        return EventEntry(1e9 + k, kind, "loop", what, "", **more)

    def written(events: list[EventEntry]) -> None:
        journal = Journal(path, max_mb=1.0)
        for e in events:
            journal.event(e)
        journal.keep("monitor", "learnt")
        journal.close()

    written([
        event(0, "fault", "standing and seen", alarm="monitor gain", raised=True),
        event(1, "acknowledged", "standing and seen", about=1),
        event(2, "fault", "over and not seen", alarm="fault", raised=True),
        event(3, "fault", "over", alarm="fault"),
        event(4, "fault", "over and seen", alarm="fault", raised=True),
        event(5, "fault", "over again", alarm="fault"),
        event(6, "acknowledged", "over and seen", about=5),
        event(7, "connection", "standing", alarm="connection", raised=True),
        *[event(8 + k, "change", f"set point {k}") for k in range(5 * LEAST_EVENTS)],
    ])  # fmt: skip
    reader = JournalReader(path)
    found = reader.events()
    assert LEAST_EVENTS <= len(found) <= (1 + EVENT_SLACK) * LEAST_EVENTS
    assert [i for i, _ in found[:7]] == [1, 2, 3, 4, 6, 8, found[6][0]]  # 6 is the newest of its alarm
    assert [e.what for _, e in found[6:]] == [f"set point {k}" for k in range(5 * LEAST_EVENTS)][6 - len(found) :]
    assert [e.event.what for e in reader.active()] == ["standing", "standing and seen"]
    shown = {e.event.what: e for e in reader.entries()}
    assert shown["standing and seen"].acknowledged is not None
    assert (shown["over and not seen"].over_s, shown["over and not seen"].acknowledged) == (1e9 + 3, None)
    assert "over and seen" not in shown
    assert reader.learnt("monitor") == "learnt"
    size, last = path.stat().st_size, found[-1][0]
    reader.close()
    # Faults that come and go, and that nobody ever acknowledges, are bounded too.
    for _ in range(3):
        written([event(9, "fault", "flaps" * raised, alarm="flap", raised=raised) for _ in range(5 * LEAST_EVENTS)
                 for raised in (True, False)])  # fmt: skip
    reader = JournalReader(path)
    assert len(reader.events()) <= (1 + EVENT_SLACK) * LEAST_EVENTS
    assert reader.events()[-1][0] == last + 30 * LEAST_EVENTS
    assert [e.event.what for e in reader.active()] == ["standing", "standing and seen"]
    reader.close()
    assert path.stat().st_size < 4 * size


def test_runs_go_with_their_last_scan(tmp_path: Path, controller: Controller) -> None:
    path = tmp_path / "loop.journal"
    for _ in range(6):
        journal = Journal(path, max_mb=0.2)
        journal.begin(controller.manifest, controller.sha256, 1e9)
        for scan in scans(4 * BLOCK_SCANS):
            journal.scan(scan)
        journal.close()
    reader = JournalReader(path)
    runs = {run["id"] for run in reader.runs()}
    assert runs == {run for _, run, _ in reader.scans()}
    assert 1 not in runs
    assert 6 in runs
    reader.close()


def test_a_second_writer_is_refused_and_the_first_goes_on(tmp_path: Path, controller: Controller) -> None:
    path, link = tmp_path / "loop.journal", tmp_path / "link.journal"
    first = Journal(path)
    link.symlink_to(path)
    for name in (path, link):
        with pytest.raises(LoopError, match=rf"{name.name} is written by another loop \(process {os.getpid()}\); end"):
            Journal(name)
    script = "import pathlib, sys, loopwright.serving.journal as j; j.Journal(pathlib.Path(sys.argv[1]))"
    other = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=False)
    assert other.returncode == 1
    assert f"{path} is written by another loop (process {os.getpid()})" in other.stderr
    first.begin(controller.manifest, controller.sha256, 1e9)
    given = scans(FRESH + 2 * BLOCK_SCANS)
    for scan in given:
        first.scan(scan)
    first.close()
    reader = JournalReader(path)
    assert all(same(a, b) for a, (_, _, b) in zip(given, reader.scans(), strict=True))
    reader.close()
    Journal(link).close()


def test_runs_that_alternate_lose_nothing_when_they_are_packed(tmp_path: Path, controller: Controller) -> None:
    """Two loops that wrote one journal, before a second one was refused, left such files."""
    path, given = tmp_path / "loop.journal", scans(FRESH + 2 * BLOCK_SCANS)
    journal = Journal(path)
    for _ in range(2):
        journal.begin(controller.manifest, controller.sha256, 1e9)
    journal.close()
    base, rng = sqlite3.connect(path), np.random.default_rng(0)
    runs = [1 + int(rng.random() < 0.5) for _ in given]
    rows = [(run, s.time_s, s.mode, np.array(s.numbers).tobytes()) for run, s in zip(runs, given, strict=True)]
    base.executemany("insert into scan (run, time, mode, numbers) values (?, ?, ?, ?)", rows)
    base.commit()
    base.close()
    journal = Journal(path)
    journal.event(EventEntry(1e9, "change", "anna", "mode AUTO"))
    journal.close()
    reader = JournalReader(path)
    found = list(reader.scans())
    assert [(i, run) for i, run, _ in found] == [(k + 1, run) for k, run in enumerate(runs)]
    assert all(np.array_equal(a.numbers, b.numbers, equal_nan=True) for a, (_, _, b) in zip(given, found, strict=True))
    assert len(list(reader.scans(after_id=100))) == len(given) - 100
    reader.close()


def test_a_reader_holds_one_block_at_a_time(tmp_path: Path, controller: Controller) -> None:
    path = tmp_path / "loop.journal"
    journal = Journal(path)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    for scan in scans(FRESH + 30 * BLOCK_SCANS):
        journal.scan(scan)
    journal.close()
    base = sqlite3.connect(path)
    (whole,) = base.execute("select sum(length(data)) from block").fetchone()
    base.close()
    reader = JournalReader(path)
    found = reader.scans()
    tracemalloc.start()
    for _ in range(3 * BLOCK_SCANS):
        next(found)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    found.close()
    reader.close()
    assert most < whole


def test_what_is_no_journal_is_named(tmp_path: Path) -> None:
    foreign = tmp_path / "other.db"
    base = sqlite3.connect(foreign)
    base.execute("create table t (a)")
    base.commit()
    base.close()
    with pytest.raises(LoopError, match=r"other.db is no journal of this release"):
        Journal(foreign)
    (tmp_path / "text").write_text("not a database at all, and longer than a header of one" * 50)
    with pytest.raises(LoopError, match="text is no journal, or cannot be written: file is not a database"):
        Journal(tmp_path / "text")
    with pytest.raises(LoopError, match="is not here"):
        JournalReader(tmp_path / "nowhere")


def test_a_disk_that_takes_nothing_loses_nothing(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    journal = Journal(tmp_path / "loop.journal", tell=told.append)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    write, full = journal._write, [True] * 3

    def sometimes() -> None:
        if full:
            full.pop()
            raise sqlite3.OperationalError("database or disk is full")
        write()

    monkeypatch.setattr(journal, "_write", sometimes)
    given = scans(5)
    for scan in given:
        journal.scan(scan)
    while full:
        journal._thread.join(0.05)
    journal.close()
    assert told == [
        "the journal cannot be written: OperationalError: database or disk is full",
        "the journal writes again",
    ]
    reader = JournalReader(tmp_path / "loop.journal")
    assert all(same(a, b) for a, (_, _, b) in zip(given, reader.scans(), strict=True))
    reader.close()


def test_what_a_full_disk_costs_is_said_and_no_run_is_lost(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More waits than may: the oldest scans go, and the rest is still of a run."""
    monkeypatch.setattr(writer, "WAITING_ENTRIES", 20)
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    told: list[str] = []
    journal = Journal(tmp_path / "loop.journal", tell=told.append)
    write, full = journal._write, [True]

    def sometimes() -> None:
        if full:
            raise sqlite3.OperationalError("database or disk is full")
        write()

    monkeypatch.setattr(journal, "_write", sometimes)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    journal.event(EventEntry(1e9, "fault", "loop", "PV T: bad", alarm="fault", raised=True))
    given = scans(50)
    for scan in given:
        journal.scan(scan)
    assert within(20, lambda: journal.lost == 32 and journal.trouble != "")  # the run, the event, 18 scans stay
    full.clear()
    journal.close()
    loss = "; 32 scans and events are lost that the disk did not take"
    assert told[-1] == f"the journal writes again{loss}"
    assert sorted(told[:-1]) == [
        "the journal cannot be written: OperationalError: database or disk is full",
        "the journal has 20 scans and events that wait: from now on the oldest are lost",
    ]
    reader = JournalReader(tmp_path / "loop.journal")
    found = list(reader.scans())
    assert [run for _, run, _ in found] == [1] * 18
    assert all(same(a, b) for a, (_, _, b) in zip(given[-18:], found, strict=True))
    assert len(reader.runs()) == 1
    newest, *rest = [e for e in reader.entries() if e.event.raised]
    assert newest.event.what == f"the journal could not be written{loss}"
    assert newest.over_s is not None
    assert [e.event.what for e in rest] == ["PV T: bad"] == [e.event.what for e in reader.active()]
    reader.close()


@pytest.mark.parametrize(("fsync", "synchronous"), [("crash", 1), ("power loss", 2)])
def test_each_write_waits_for_the_disk_where_a_power_loss_must_cost_nothing(
    tmp_path: Path, fsync: Any, synchronous: int
) -> None:
    """SQLite syncs its log at each commit with ``synchronous`` 2 (full), and only at checkpoints with 1 (normal)."""
    journal = Journal(tmp_path / "loop.journal", fsync=fsync)
    assert journal._base.execute("pragma synchronous").fetchone() == (synchronous,)
    assert journal._base.execute("pragma journal_mode").fetchone() == ("wal",)
    journal.close()


def test_a_write_that_hangs_makes_nothing_grow(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "WAITING_ENTRIES", 20)
    monkeypatch.setattr(writer, "STALL_S", 0.0)
    told: list[str] = []
    journal = Journal(tmp_path / "loop.journal", tell=told.append)
    write, hangs, answers = journal._write, threading.Event(), threading.Event()

    def slow() -> None:
        hangs.set()
        answers.wait(60)
        write()

    monkeypatch.setattr(journal, "_write", slow)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    assert hangs.wait(20)
    given = scans(50)
    for scan in given:
        journal.scan(scan)
    assert (journal.behind, journal.lost) == (20, 31)  # the run is being written; 19 scans wait
    assert journal.trouble == "the disk has not answered for 0 s"
    answers.set()
    journal.close()
    loss = "; 31 scans and events are lost that the disk did not take"
    assert told == [
        "the journal cannot be written: the disk has not answered for 0 s",
        "the journal has 20 scans and events that wait: from now on the oldest are lost",
        f"the journal writes again{loss}",
    ]
    reader = JournalReader(tmp_path / "loop.journal")
    assert all(same(a, b) for a, (_, _, b) in zip(given[-19:], reader.scans(), strict=True))
    assert f"the journal could not be written{loss}" in [e.event.what for e in reader.entries()]
    reader.close()


def test_a_disk_that_hangs_for_good_is_not_waited_for(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "CLOSE_S", 0.05)
    told, answers = list[str](), threading.Event()
    journal = Journal(tmp_path / "loop.journal", tell=told.append)
    write = journal._write
    monkeypatch.setattr(journal, "_write", lambda: write() if answers.wait(60) else None)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    journal.scan(scans(1)[0])
    journal.close()
    assert told == ["the journal's disk does not answer: the last 1 scans and events are lost"]
    assert journal.lost == 1  # the run is neither
    answers.set()
    journal._thread.join(60)
    journal.close()
    assert journal.lost == 1


def deleted(path: Path) -> None:
    path.unlink()


def moved_with_its_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))


def without_its_log(path: Path) -> None:
    path.with_name(path.name + "-wal").unlink()


def without_its_lock(path: Path) -> None:
    path.with_name(path.name + ".lock").unlink()


def replaced(path: Path) -> None:
    path.unlink()
    path.write_text("of somebody else")


@pytest.mark.parametrize("at_the_end", [False, True])
@pytest.mark.parametrize("harm", [deleted, moved_with_its_folder, without_its_log, without_its_lock, replaced])
def test_a_file_that_goes_while_it_is_written_is_made_again_with_its_rows(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch, harm: Any, at_the_end: bool
) -> None:
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    path, told, given = tmp_path / "plant" / "loop.journal", list[str](), scans(40)
    path.parent.mkdir()
    journal = Journal(path, tell=told.append)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    for scan in given[:25]:
        journal.scan(scan)
    assert within(20, lambda: journal.behind == 0)
    harm(path)
    for scan in given[25 : 25 if at_the_end else None]:
        journal.scan(scan)
    if not at_the_end:
        assert within(20, lambda: path.is_file() and journal.behind == 0)
        if harm is without_its_lock:
            with pytest.raises(LoopError, match="is written by another loop"):
                Journal(path)
    journal.close()
    assert (journal.lost, journal.trouble) == (0, "")
    reader = JournalReader(path)
    found = list(reader.scans())
    assert [(id_, run) for id_, run, _ in found] == [(k + 1, 1) for k in range(25 if at_the_end else 40)]
    assert all(same(a, b) for a, (_, _, b) in zip(given, found, strict=False))
    alarms = [e.event.alarm for e in reader.entries() if e.event.raised]
    assert alarms == ["journal"] * (harm is not without_its_lock)
    assert (len(told), reader.active()) == (len(alarms), [])
    reader.close()
    aside = path.with_name("loop.journal.aside-1")
    assert (aside.read_text() if aside.exists() else "") == ("of somebody else" if harm is replaced else "")


def written(
    path: Path, controller: Controller, given: list[ScanEntry], tell: Callable[[str], None] = lambda _: None
) -> Journal:
    """An open journal that holds some scans more."""
    journal = Journal(path, tell=tell)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    for scan in given:
        journal.scan(scan)
    assert within(20, lambda: journal.behind == 0)
    return journal


def done(act: Callable[[], Any]) -> bool:
    """Whether it could be done: the writer may have the file locked."""
    try:
        act()
    except sqlite3.OperationalError:
        return False
    return True


def written_out(path: Path) -> int:
    """The size of a journal's file once all of its log is in it."""

    def all_of_it() -> bool:
        with closing(sqlite3.connect(path)) as base:
            return bool(base.execute("pragma wal_checkpoint(truncate)").fetchone()[0] == 0)

    assert within(20, all_of_it)
    return path.stat().st_size


def cut_to_half(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def cut_by_a_tenth(path: Path) -> None:
    os.truncate(path, int(0.9 * path.stat().st_size))


def cut_to_nothing(path: Path) -> None:
    os.truncate(path, 0)


@pytest.mark.parametrize("harm", [cut_to_half, cut_by_a_tenth, cut_to_nothing])
def test_a_file_that_cannot_be_read_any_more_costs_its_rows_and_they_are_counted(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch, harm: Any
) -> None:
    """Those of earlier runs too. Those that see rows by id see the new ones."""
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)

    path, given = tmp_path / "loop.journal", scans(4040)
    written(path, controller, given[:15]).close()  # an earlier run
    journal = written(path, controller, given[15:4024])
    path.chmod(0o640)
    written_out(path)
    journal.scan(given[4024])
    assert within(20, lambda: journal.behind == 0)
    harm(path)
    for scan in given[4025:]:
        journal.scan(scan)
    journal.close()
    assert journal.lost == 4025
    reader = JournalReader(path)
    assert [(id_, run) for id_, run, _ in reader.scans()] == [(k + 4026, 1) for k in range(15)]
    assert [e.event.alarm for e in reader.entries() if e.event.raised] == ["journal"]
    reader.close()
    assert path.with_name("loop.journal.aside-1").is_file()
    assert path.stat().st_mode & 0o777 == 0o640
    assert not list(tmp_path.glob("*.new*"))


def test_an_old_copy_over_the_file_costs_the_rows_that_it_lacks(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``cp`` writes it: the file keeps its number, and the copy is sound."""
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    path, given = tmp_path / "loop.journal", scans(4040)
    written(path, controller, given[:15]).close()
    old = path.read_bytes()
    journal = written(path, controller, given[15:4024])
    written_out(path)
    journal.scan(given[4024])
    assert within(20, lambda: journal.behind == 0)
    path.write_bytes(old)
    for scan in given[4025:]:
        journal.scan(scan)
    journal.close()
    with closing(JournalReader(path)) as reader:
        found = [id_ for id_, _, _ in reader.scans()]
        assert {run for _, run, _ in reader.scans()} <= {run["id"] for run in reader.runs()}
        assert [e.event.alarm for e in reader.entries() if e.event.raised] == ["journal"]
    assert found[-15:] == [k + 4026 for k in range(15)]
    assert 0 < journal.lost == 4040 - len(found)


def test_rows_about_a_gap_keep_their_ids_when_they_are_packed(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that was made again with the rows that are left has one."""
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    path, given = tmp_path / "loop.journal", scans(FRESH + 2 * BLOCK_SCANS)
    journal = written(path, controller, given[:100])
    with closing(sqlite3.connect(path)) as base:
        assert within(20, lambda: done(lambda: base.execute("delete from scan where id between 40 and 60")))
        base.commit()
    for scan in given[100:]:
        journal.scan(scan)
    journal.close()
    with closing(JournalReader(path)) as reader:
        found = {id_: scan for id_, _, scan in reader.scans()}
    assert list(found) == [k + 1 for k in range(len(given)) if not 40 <= k + 1 <= 60]
    assert all(same(given[id_ - 1], scan) for id_, scan in found.items())


def test_a_file_that_somebody_vacuums_is_not_cut(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    path, told, given = tmp_path / "loop.journal", list[str](), scans(3010)
    journal = written(path, controller, given[:2999], told.append)
    size = written_out(path)
    journal.scan(given[2999])
    assert within(20, lambda: journal.behind == 0)
    with closing(sqlite3.connect(path)) as base:
        assert within(20, lambda: done(lambda: base.execute("vacuum")))
    assert written_out(path) < size
    for scan in given[3000:]:
        journal.scan(scan)
    journal.close()
    assert (told, journal.lost) == ([], 0)
    with closing(JournalReader(path)) as reader:
        assert len(list(reader.scans())) == 3010


def test_a_file_system_that_numbers_files_anew_is_believed_no_more(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    numbers, real = itertools.count(), Path.stat

    def anew(path: Path, **given: Any) -> os.stat_result:
        found = real(path, **given)
        return os.stat_result((found[0], next(numbers), *found[2:])) if path.parent == tmp_path else found

    monkeypatch.setattr(Path, "stat", anew)
    told, given = list[str](), scans(20)
    journal = Journal(tmp_path / "loop.journal", tell=told.append)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    for scan in given:
        journal.scan(scan)
        assert within(20, lambda: journal.behind == 0)
    journal.close()
    assert journal.lost == 0
    assert len(told) == 3
    assert "is noticed no more" in told[-1]
    with closing(JournalReader(tmp_path / "loop.journal")) as reader:
        assert len(list(reader.scans())) == 20


def test_a_copy_that_takes_long_is_told_as_one(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    monkeypatch.setattr(writer, "STALL_S", 0.0)
    begun, ends, copied = threading.Event(), threading.Event(), writer.copied

    def slow(*given: Any) -> Path | None:
        begun.set()
        ends.wait(60)
        return copied(*given)

    monkeypatch.setattr(writer, "copied", slow)
    told, given = list[str](), scans(3)
    journal = written(tmp_path / "loop.journal", controller, given[:1], told.append)
    journal.path.unlink()
    journal.scan(given[1])
    assert begun.wait(20)
    told.clear()
    journal.trouble = ""
    journal.scan(given[2])
    assert told == ["the journal cannot be written: its file is being made again for 0 s"]
    ends.set()
    journal.close()
    assert (journal.lost, journal.trouble) == (0, "")


@pytest.mark.parametrize(("gone", "lost"), [(False, 46), (True, 76)])
def test_what_a_disk_that_is_full_at_the_end_costs_is_counted(
    tmp_path: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch, gone: bool, lost: int
) -> None:
    """A deleted file that cannot be made again costs what stood in it, too."""
    monkeypatch.setattr(writer, "FLUSH_S", 0.001)
    told: list[str] = []
    journal = Journal(tmp_path / "loop.journal", tell=told.append)
    journal.begin(controller.manifest, controller.sha256, 1e9)
    for scan in scans(30):
        journal.scan(scan)
    assert within(20, lambda: journal.behind == 0)

    def full(*_: Any) -> Any:
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(writer, "copied", full)
    monkeypatch.setattr(journal, "_write", full)
    if gone:
        journal.path.unlink()
    for scan in scans(45):
        journal.scan(scan)
    journal.event(EventEntry(1e9, "change", "loop", "ended"))
    journal.keep("monitor", "learnt")
    journal.close()
    assert journal.lost == lost
    assert f"the last {lost} scans and events are lost" in told[-1]


def test_an_alarm_that_is_over_stays_over() -> None:
    """One that became worse before it ended: the first event is kept for whoever has not seen it, with its end."""
    given = [("gain", True, 0), ("gain", True, 0), ("", False, 2), ("gain", False, 0), *[("", False, 0)] * 3000]
    before, after = rotated(given, LEAST_EVENTS)
    assert before == after == []


EVENTS = st.lists(
    st.tuples(st.sampled_from(["", "", "fault", "gain", "connection"]), st.booleans(), st.integers(0, 40)), max_size=60
)


@given(EVENTS, st.integers(1, 40))
@settings(max_examples=100, deadline=None)
def test_the_same_alarms_are_active_before_and_after_the_oldest_events_went(
    given: list[tuple[str, bool, int]], most: int
) -> None:
    before, after = rotated(given, most)
    assert before == after


def rotated(given: list[tuple[str, bool, int]], most: int) -> tuple[list[int], list[int]]:
    """The active alarms before and after the events, as (alarm, raised, about), were shortened to ``most``."""
    base = sqlite3.connect(":memory:")
    base.executescript(TABLES)
    rows = [(1e9 + i, "change", "loop", "", "", alarm, alarm != "" and raised, 0 if alarm else about)
            for i, (alarm, raised, about) in enumerate(given)]  # fmt: skip
    base.executemany(f"insert into event ({EVENT}) values (?, ?, ?, ?, ?, ?, ?, ?)", rows)
    reader = JournalReader.__new__(JournalReader)
    reader._base = base
    before = [e.id for e in reader.active()]
    shorten_events(base, most)
    after = [e.id for e in reader.active()]
    base.close()
    return before, after


def test_a_trial_that_begins_anew_at_each_scan_is_told_once(tmp_path: Path, controller: Controller) -> None:
    """Its reason holds a number that changes."""
    journal, said = Journal(tmp_path / "loop.journal"), list[str]()
    recorder = Recorder(journal, said.append)
    successor = SimpleNamespace(reason="", controller=controller)
    for k in range(100):
        successor.reason = f"PV T = {400 + k / 7:.4g} is outside its range"
        recorder._tried(SimpleNamespace(successor=successor))  # type: ignore[arg-type]
    journal.close()
    assert len(said) == 1


def test_the_metrics_tell_what_the_journal_lost() -> None:
    about = {"card": {"law": "pi", "case": "tank", "sha256": "0", "file": "pi.onnx"}, "info": [],
             "signals": {name: [] for name in ("sp", "pv", "mv", "dv")}}  # fmt: skip
    state = {"alive": True, "mode": "AUTO", "time": 1.0, "journal": "", "journal_lost": 32}
    assert "loopwright_journal_lost_total 32.0" in metrics_text(about, state).splitlines()
