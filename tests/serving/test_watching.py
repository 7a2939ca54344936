"""The loop looks at its monitor's verdicts by scans: a clock that is set must not stop it from looking."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from processes import within

from loopwright.serving import Command, Controller, Mode
from loopwright.serving.clock import MACHINE_TIME
from loopwright.serving.journal import Journal, JournalReader
from loopwright.serving.monitor import Monitor, Verdict
from loopwright.serving.monitor.weekly import WeeklyCounts
from loopwright.serving.station.last_courses import LastCourses
from loopwright.serving.station.last_run import Steered
from loopwright.serving.station.recorder import MonitorRunner, Recorder
from loopwright.serving.station.station import Station

FILE = Path(__file__).parents[2] / "artifacts" / "ph_neutralization" / "pid.onnx"


def scan_of(controller: Controller, k: int, time_s: float) -> tuple[None, Command, float]:
    """One scan of a loop that holds."""
    m = controller.manifest
    mv, sp = np.array([s.middle for s in m.mv]), np.array([s.middle for s in m.sp])
    return None, Command(k, Mode.HOLD, sp, mv, None, None, fault="lost"), time_s


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    journal = Journal(tmp_path / "loop.journal")
    yield Recorder(journal, lambda _: None)
    journal.close()


def told(recorder: Recorder) -> list[str]:
    """What the journal says of the monitor, once all of it is written."""
    assert within(10, lambda: recorder.journal.behind == 0)
    with closing(JournalReader(recorder.journal.path)) as reader:
        return [event.what for _, event in reader.events() if event.kind == "monitor"]


@pytest.mark.parametrize("forgery", ["since_s", "text", "deep", "number", "list", "json"])
def test_a_forged_memory_in_the_journal_is_told_once_and_the_monitor_learns_anew(
    recorder: Recorder, forgery: str
) -> None:
    controller = Controller(FILE)
    state = Monitor(controller.manifest, started_s=1e9).state()
    state["parts"]["spread"]["since_s"] = [1e15]
    forged = {
        "since_s": json.dumps(state), "text": '"x"', "deep": "[" * 100_000, "number": "1" * 10_000, "list": "[]",
        "json": "{",
    }  # fmt: skip
    recorder.journal.keep(f"monitor {controller.sha256}", forged[forgery])
    assert told(recorder) == []
    watching = MonitorRunner(controller, recorder)
    (said,) = told(recorder)
    assert "learns anew" in said
    watching.seen(controller, scan_of(controller, 0, 1e9))
    assert watching.monitor.verdicts()
    watching.keep()
    assert len(told(recorder)) == 1
    MonitorRunner(controller, recorder)  # the next start finds what this one kept
    assert len(told(recorder)) == 1


def test_a_monitor_whose_numbers_are_none_is_not_kept_and_learns_anew(recorder: Recorder) -> None:
    controller = Controller(FILE)
    watching = MonitorRunner(controller, recorder)
    watching.keep()
    watching.monitor.hold.value = float("nan")
    watching.keep()
    (said,) = told(recorder)
    assert "not finite" in said
    assert watching.monitor.hold.value == 0.0
    MonitorRunner(controller, recorder)
    assert len(told(recorder)) == 1


def test_what_fails_in_watching_is_told_once_and_raises_nothing(
    recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller = Controller(FILE)
    watching = MonitorRunner(controller, recorder)

    def broken(*_: object) -> None:
        raise OverflowError("year 31690708 is out of range")

    monkeypatch.setattr(watching, "_seen", broken)
    for k in range(3):
        watching.seen(controller, scan_of(controller, k, 1e9 + k))
    (said,) = told(recorder)
    assert "OverflowError" in said


def station_that(did: list[str], write: Callable[..., object]) -> Station:
    """As much of a station as a scan is shown with; ``write`` writes it down."""
    controller = Controller(FILE)
    monitor = Monitor(controller.manifest, started_s=1e9)
    return cast(Station, SimpleNamespace(
        loop=SimpleNamespace(
            controller=controller, successor=None, replaced=None, operate=(), stepped=None, wishes={}, mv_wanted=(),
            sp=np.zeros(len(controller.manifest.sp)), manifest=controller.manifest,
            courses=SimpleNamespace(ends={}, finished=(), now_s=0.0, standing={}),
        ),
        _steered=Steered(), _courses=LastCourses(), settings=SimpleNamespace(speed=1.0),
        journal=SimpleNamespace(keep=lambda *_: None), time=MACHINE_TIME,
        _moved=lambda loop: None,
        scans=0, _faults=0, _missed_periods=0, _watchers=[lambda *_: did.append("others")], snapshot=None,
        recorder=SimpleNamespace(controller=controller, scan=write),
        watching=SimpleNamespace(seen=lambda *_: did.append("monitor"), monitor=monitor, weekly=WeeklyCounts()),
    ))  # fmt: skip


def test_a_scan_is_written_down_before_anybody_looks_at_it() -> None:
    did = list[str]()
    station = station_that(did, lambda *_: did.append("journal"))
    _, command, _ = scan_of(Controller(FILE), 0, 1e9)
    Station._observe(station, None, command)
    assert did == ["journal", "monitor", "others"]


def test_a_scan_that_cannot_be_written_down_is_shown() -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    station = station_that([], full)
    _, command, _ = scan_of(Controller(FILE), 0, 1e9)
    with pytest.raises(OSError, match="No space"):
        Station._observe(station, None, command)
    seen = station.snapshot
    assert seen is not None
    assert (seen.command, seen.faults, len(seen.verdicts) > 0) == (command, 1, True)


@pytest.mark.parametrize("set_by_s", [0.0, -3_600.0, 86_400.0])
def test_an_alarm_is_written_down_within_one_look_whatever_the_clock_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, set_by_s: float
) -> None:
    notes, kept = list[str](), list[str]()
    journal = SimpleNamespace(path=tmp_path / "none.journal", keep=lambda name, text: kept.append(name))
    recorder = SimpleNamespace(journal=journal, time=MACHINE_TIME, note=lambda *words, **_: notes.append(words[2]))
    controller = Controller(FILE)
    m = controller.manifest
    watching = MonitorRunner(controller, cast(Recorder, recorder))

    def scan(k: int, time_s: float) -> None:
        watching.seen(controller, scan_of(controller, k, time_s))

    scan(0, 1e9)
    verdicts = [Verdict("time in HOLD", "watch", "the loop holds")]
    monkeypatch.setattr(type(watching.monitor), "verdicts", lambda self: verdicts)
    scan(1, 1e9 + set_by_s + m.period_s)
    assert notes == ["time in HOLD: watch: the loop holds"]
    for k in range(2, 11):
        scan(k, 1e9 + set_by_s + k * m.period_s)
    assert len(notes) == 1
    assert kept
