"""Courses over a restart of a station: said, or taken back by the clock; what lies in the past is skipped."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from still_station import settings_of, still_machine

from loopwright.serving import Controller, ControlLoop, Sample
from loopwright.serving.journal import Journal, JournalReader
from loopwright.serving.station.last_courses import COURSES, DatedCourse, LastCourses
from loopwright.serving.station.settings import JournalSettings
from loopwright.serving.station.station import Station

pytest_plugins = ["small_laws", "operated_files", "course_files"]
SAMPLE = Sample(np.zeros(2), np.zeros(2), dv=np.zeros(1))
NOON = 1_790_000_000.0
POINTS = {"y0": [(2.0, 0.5), (20.0, 0.8), (40.0, 0.1)], "d0": [(0.0, 0.0), (30.0, 0.3)]}


def loop_of(controller: Controller) -> ControlLoop:
    return ControlLoop(controller, sp=[0.0, 0.0], mv=[0.0, 0.0])


def noted(act: Callable[..., None], loop: ControlLoop, *at: float) -> list[str]:
    found: list[str] = []
    act(loop, lambda what, reason: found.append(what), *at)
    return found


def followed(
    controller: Controller, scans: int, speed: float = 1.0, **straight: Any
) -> tuple[LastCourses, ControlLoop]:
    """The courses after so many scans, of which the last is at noon, and their loop."""
    loop = loop_of(controller)
    loop.set_course(POINTS, who="anna", **straight)
    kept = LastCourses()
    for k in range(scans):
        loop.scan(SAMPLE)
        kept = LastCourses.of(loop, kept, NOON + (k - scans + 1) / speed, speed)
    return kept, loop


def sp_of(loop: ControlLoop, scans: int) -> list[float]:
    return [float(loop.scan(SAMPLE).sp[0]) for _ in range(scans)]


@pytest.mark.parametrize("speed", [1.0, 10.0])
@pytest.mark.parametrize("down", [1, 14, 30])
def test_a_course_goes_on_where_it_would_be_by_the_clock(previewing: Controller, speed: float, down: int) -> None:
    """The set points of a loop that is down for some periods are those of one that ran through them."""
    kept, loop = followed(previewing, 5, speed)
    loop.gap(down - 1)
    again = loop_of(previewing)
    said = noted(kept.restore, again, NOON + down / speed, speed)
    assert len(said) == (2 if down > 25 else 1)  # the forecast may be over
    assert {n: of.who for n, of in again.courses.standing.items()} == dict.fromkeys(
        ["y0"] if down > 25 else ["y0", "d0"], "anna"
    )
    assert sp_of(again, 12) == pytest.approx(sp_of(loop, 12), abs=1e-6)


def test_a_ramp_goes_on_along_its_line(previewing: Controller) -> None:
    kept, loop = followed(previewing, 10, straight=["y0"])
    loop.gap(4)
    again = loop_of(previewing)
    noted(kept.restore, again, NOON + 5.0, 1.0)
    there, here = sp_of(again, 5), sp_of(loop, 5)
    assert there == pytest.approx(here, abs=1e-6)
    assert 0.5 < there[0] < 0.8


def test_one_that_is_over_is_said_and_left_alone(previewing: Controller) -> None:
    kept, _ = followed(previewing, 5)
    again = loop_of(previewing)
    said = noted(kept.restore, again, NOON + 1000.0, 1.0)
    assert len(said) == 1
    assert "y0" in said[0]
    assert "d0" in said[0]
    assert again.courses.standing == {}
    assert sp_of(again, 2) == [0.0, 0.0]


def test_without_restore_it_is_said_by_whom_and_until_when_and_nothing_is_set(previewing: Controller) -> None:
    kept, _ = followed(previewing, 5)
    again = loop_of(previewing)
    said = noted(kept.compare, again, NOON + 3.0)
    assert len(said) == 1
    assert all(word in said[0] for word in ("y0", "d0", "anna", "2026-09-21 14:13 UTC", "0.1 m"))
    assert again.courses.standing == {}
    assert noted(LastCourses().compare, again, NOON) == []


def test_one_that_is_wrong_now_takes_no_other_with_it(previewing: Controller, operated: Controller) -> None:
    kept, _ = followed(previewing, 5)
    far = {**kept.by_signal, "y1": DatedCourse(((NOON + 50, 99.0),), False, "anna")}
    again = loop_of(previewing)
    said = noted(replace(kept, by_signal=far).restore, again, NOON + 3.0, 1.0)
    assert len(said) == 2
    assert set(again.courses.standing) == {"y0", "d0"}
    other = ControlLoop(operated, sp=[300.0, 5.0], mv=[40.0, 0.5])
    assert len(noted(kept.restore, other, NOON, 1.0)) == 1


def test_the_courses_of_a_scan_are_those_before_it_unless_one_is_new(previewing: Controller) -> None:
    """So that nothing is written down at each scan, whose time is never on the grid."""
    kept, loop = followed(previewing, 3)
    loop.scan(SAMPLE)
    later = LastCourses.of(loop, kept, NOON + 1.013, 1.0)
    assert later == kept
    assert all(later.by_signal[n] is kept.by_signal[n] for n in kept.by_signal)
    loop.set_course({"y1": [(50, 0.3)]}, who="ben")
    loop.scan(SAMPLE)
    assert LastCourses.of(loop, later, NOON + 2.0, 1.0) != later
    loop.courses.end(["y0", "y1", "d0"])
    assert LastCourses.of(loop, later, NOON + 3.0, 1.0) == LastCourses()


POINT = '{"points": [[1, 2]], "straight": false, "who": "a"}'


@pytest.mark.parametrize(
    ("kept", "good"),
    [
        ("", 0),
        ("[]", 0),
        ("{", 0),
        ('{"sha256": 4}', 0),
        ('{"sha256": "x", "courses": [1]}', 0),
        ('{"sha256": "x", "courses": {"y0": 5, "y1": ' + POINT + "}}", 1),
        ('{"sha256": "x", "courses": {"y0": {"points": []}, "y1": {"points": [[1, "2"]], "who": "a"}}}', 0),
        ('{"sha256": "x", "courses": {"y0": {"points": [[1e300, 2]], "who": "a"}}}', 0),
        ('{"sha256": "x", "courses": {"y0": {"points": [[NaN, 2]], "who": "a"}}}', 0),
        ('{"sha256": "x", "courses": {"y0": {"points": [[1, 2]], "who": 7}}}', 0),
        ("[" * 5000, 0),
    ],
    ids=["none", "list", "cut", "number", "rows", "one", "empty", "late", "nan", "who", "deep"],
)
def test_a_journal_that_does_not_tell_stops_nothing(
    previewing: Controller, tmp_path: Path, kept: str, good: int
) -> None:
    with closing(Journal(tmp_path / "loop.journal")) as journal:
        if kept:
            journal.keep(COURSES, kept)
    found = LastCourses.before(tmp_path / "loop.journal")
    assert len(found.by_signal) == good
    assert len(noted(found.restore, loop_of(previewing), NOON, 1.0)) == good
    assert LastCourses.before(tmp_path / "none.journal") == LastCourses()


# ------------------------------------------------------------------------------------------------ a station of a file
def started(controller: Controller, folder: Path, restore: bool) -> Station:
    settings = settings_of(controller, journal=JournalSettings(folder / "loop.journal"), restore=restore)
    return Station(settings, controller=Controller(controller.path), machine=still_machine(folder))  # type: ignore[arg-type]


@pytest.mark.parametrize("restore", [True, False])
def test_a_station_that_is_restarted_says_what_stood_and_takes_it_back(
    previewing: Controller, tmp_path: Path, restore: bool
) -> None:
    first = started(previewing, tmp_path, restore)

    def give(*_: object) -> None:
        if first.scans == 1:
            assert first.loop is not None
            first.loop.set_course({"y0": [(0, 0.5), (5000, 0.8)], "y1": [(0, 0.1), (9000, 1.0)]}, ["y1"], "anna")

    first.watch(give)
    first.run(6)
    second = started(previewing, tmp_path, restore)
    seen: list[float] = []
    second.watch(lambda _, command: seen.append(float(command.sp[0])))
    second.run(3)
    with closing(JournalReader(tmp_path / "loop.journal")) as reader:
        said = [e for _, e in reader.events() if e.who == "loop.toml" and "course of y0" in e.what]
        kept = json.loads(reader.learnt(COURSES) or "")
    assert len(said) == 1
    assert "anna" in said[0].what
    assert second.loop is not None
    stands = second.loop.courses.standing
    assert set(stands) == ({"y0", "y1"} if restore else set())
    assert set(kept["courses"]) == set(stands)
    assert seen == ([0.5] * 3 if restore else [0.0] * 3)
    if restore:
        assert stands["y1"].straight
        assert stands["y0"].who == "anna"
        assert stands["y0"].times_s[-1] == pytest.approx(5000.0, abs=30.0)
