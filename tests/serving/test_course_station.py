"""A station takes courses: by requests and by the command, in its journal and its views."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from fake_loop import FakeLoop
from still_station import settings_of, still_machine

from loopwright.pipeline.__main__ import main
from loopwright.serving import Controller, LoopError, Sample
from loopwright.serving.journal import JournalReader
from loopwright.serving.loop import Command
from loopwright.serving.preview.course_file import courses_of
from loopwright.serving.station.build_loop import control_loop
from loopwright.serving.station.requests import Request, change
from loopwright.serving.station.settings import JournalSettings
from loopwright.serving.station.station import Station
from loopwright.serving.station.views import about, courses, state

pytest_plugins = ["small_laws", "operated_files", "course_files"]
COURSE = {"points": {"y0": [[2, 0.5]], "d0": [[0, 0.0], [3, 0.2]], "y1": [[50, 1.0]]}}


@pytest.fixture
def made(previewing: Controller, tmp_path: Path) -> Station:
    settings = settings_of(previewing, journal=JournalSettings(tmp_path / "loop.journal"))
    return Station(settings, controller=Controller(previewing.path), machine=still_machine(tmp_path))  # type: ignore[arg-type]


def ran(made: Station, scans: int, **at: Callable[[], None]) -> tuple[list[Command], list[str]]:
    """The commands and events of a run in which something happens after the scans ``s0``, ``s1``, ..."""
    commands: list[Command] = []

    def seen(_: Sample | None, command: Command) -> None:
        commands.append(command)
        if act := at.get(f"s{len(commands) - 1}"):
            act()

    made.watch(seen)
    made.run(scans)
    with closing(JournalReader(made.settings.journal.file)) as reader:
        return commands, [f"{e.kind} {e.who}: {e.what} ({e.reason})" for _, e in reader.events()]


def asked(made: Station, do: str, value: Any) -> Callable[[], None]:
    def act() -> None:
        assert made.loop is not None
        request = Request.read({"do": do, "value": value, "who": "anna", "reason": "batch 7"})
        made.ask(change(request, made.loop, lambda file, sha256: Controller(file)))

    return act


def test_a_course_is_followed_written_down_and_shown(made: Station) -> None:
    commands, events = ran(made, 8, s0=asked(made, "course", COURSE))
    assert [c.sp[0] for c in commands] == [0, 0, 0, 0.5, 0.5, 0.5, 0.5, 0.5]
    given = [line for line in events if line.startswith("change anna: course of ")]
    assert len(given) == 1
    assert all(word in given[0] for word in ("y0 1 points", "d0 2 points", "0.5 m at 2 s", "batch 7"))
    assert [line for line in events if "is over" in line] == [
        "change loop: the course of y0 is over ()",
        "change loop: the course of d0 is over ()",
    ]
    shown = state(made)["courses"]
    assert shown == {"y1": {"ends_in_s": 43.0, "at": 1.0, "who": "anna", "number": 3}}
    assert courses(made)["courses"] == [
        {"signal": "y1", "straight": False, "points": [(0.0, 1.0)], "who": "anna", "number": 3}
    ]
    assert about(made)["ahead"]["horizon"] == 12


def test_an_operators_set_point_ends_it_and_that_is_told(made: Station) -> None:
    commands, events = ran(
        made, 8, s0=asked(made, "course", COURSE), s1=asked(made, "sp", {"y0": 0.0}), s3=asked(made, "sp", {"y1": 0.2})
    )
    assert [c.sp[0] for c in commands] == [0] * 8  # also where it is set to what it is
    assert commands[-1].sp[1] == 0.2
    assert sum("the course of y0 ends" in line for line in events) == 1
    assert sum("the course of y1 ends" in line for line in events) == 1
    assert state(made)["courses"] == {}


def test_a_set_point_by_a_node_ends_it_and_that_is_told(made: Station) -> None:
    def by_node() -> None:
        made.endpoint.asked_sp = {"y1": 0.3}  # type: ignore[attr-defined]

    commands, events = ran(made, 6, s0=asked(made, "course", COURSE), s2=by_node)
    assert commands[-1].sp[1] == 0.3
    assert any(line.startswith("change plant: set point y1 0.3 m (the course of y1 ends") for line in events)


@pytest.mark.parametrize("value", [None, {"end": ["y0", "y1", "d0"]}])
def test_courses_are_ended_by_a_request(made: Station, value: Any) -> None:
    commands, events = ran(made, 6, s0=asked(made, "course", COURSE), s1=asked(made, "course", value))
    assert [c.sp[0] for c in commands] == [0] * 6
    assert sum("ends (batch 7)" in line for line in events) == 1


@pytest.mark.parametrize(
    "value",
    [
        None,
        {},
        5,
        [],
        {"end": ["y0"]},
        {"end": "y0"},
        {"points": {"y0": [[0, 9.0]]}},
        {"points": {"y0": 5}},
        {"points": None},
        {"points": {"y0": [[0, 0.5]]}, "straight": "y0"},
        {"points": {"y0": [[0, 0.5]]}, "straight": ["y1"]},
        {"points": {"y0": [[0, 0.5]]}, "more": 1},
    ],
    ids=str,
)
def test_a_request_that_cannot_be_is_one_clear_error(previewing: Controller, value: Any) -> None:
    loop = control_loop(settings_of(previewing), previewing, mv=[0.0, 0.0])
    with pytest.raises(LoopError) as error:
        change(Request.read({"do": "course", "value": value, "who": "anna"}), loop, lambda f, s: Controller(f))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("value", "entry"),
    [
        ({"points": {"y1": [[5, 0.1], [9, 0.2]], "y0": [[0, 0.5], [4, 9.0]]}}, "y0.2"),
        ({"points": {"y0": [[5, 0.5], [4, 0.5], [3, 9.0]]}}, "y0.2"),
        ({"points": {"d0": [[5, 0.5], [7, -99.0]]}}, "d0.2"),
        ({"points": {"y0": [[0, 0.5], [3, None]]}}, "y0.2"),
        ({"points": {"y0": [[0, 0.5], "soon"]}}, "y0.2"),
        ({"points": {"y0": [[-9, 0.5], [-2, 0.5]]}}, "y0.2"),
        ({"points": {"y7": [[5, 0.5]]}}, ""),
        ({"csv": "time,y0\n5,9.0\n"}, "csv"),
        ({"csv": "time,y0\nsoon,0.5\n"}, "csv"),
        ({"csv": "time,y7\n5,0.5\n"}, "csv"),
        ({"csv": "time,y0\n5,0.5\n", "straight": ["y1"]}, "csv"),
        ({"csv": ""}, "csv"),
        ({"csv": 5}, ""),
        ({"csv": "time,y0\n5,0.5\n", "points": {"y0": [[0, 0.5]]}}, ""),
    ],
    ids=str,
)
def test_a_refusal_names_the_point_or_the_file_apart_from_its_words(
    previewing: Controller, value: Any, entry: str
) -> None:
    loop = control_loop(settings_of(previewing), previewing, mv=[0.0, 0.0])
    with pytest.raises(LoopError) as error:
        change(Request.read({"do": "course", "value": value, "who": "anna"}), loop, lambda f, s: Controller(f))
    assert error.value.entry == entry
    assert loop.courses.standing == {}


def test_the_text_of_a_file_gives_courses_and_its_dates_are_the_clocks(made: Station) -> None:
    far = datetime.fromtimestamp(time.time() + 3600.0, UTC)
    text = f"\ufefftime,y0,d0\r\n0,,0\r\n900,0.5,0.2\r\n{far.isoformat()},0.25,\r\n"
    ran(made, 3, s0=asked(made, "course", {"csv": text, "straight": ["y0"]}))
    assert made.loop is not None
    found = made.loop.courses.standing
    assert {name: (of.straight, of.who) for name, of in found.items()} == {"y0": (True, "anna"), "d0": (True, "anna")}
    assert found["y0"].values[-2:].tolist() == [0.5, 0.25]
    assert found["y0"].times_s[-1] == pytest.approx(3600.0, abs=60.0)


def test_a_date_of_a_loop_that_outruns_the_clock_is_as_much_further_away() -> None:
    text = "time,y0\n2026-03-01T14:30,0.5\n7200,0.6\n"
    now = datetime(2026, 3, 1, 14, 0, tzinfo=UTC).timestamp()
    assert courses_of(text, now, "recipe.csv") == {"y0": [(1800.0, 0.5), (7200.0, 0.6)]}
    assert courses_of(text, now, "recipe.csv", speed=4.0) == {"y0": [(7200.0, 0.5), (7200.0, 0.6)]}


def test_the_points_that_are_shown_are_those_to_come_and_the_one_that_holds(made: Station) -> None:
    assert courses(made) == {"courses": []}  # before the first scan
    long = {"points": {"y0": [[0, 0.1], [1, 0.2], [3, 0.3], [90, 0.4], [100, 0.5]]}}
    ran(made, 8, s0=asked(made, "course", long))
    (row,) = courses(made)["courses"]
    assert row["points"] == [(-97.0, 0.3), (-10.0, 0.4), (0.0, 0.5)]  # from the course's own end
    assert state(made)["courses"]["y0"]["ends_in_s"] == 93.0


def test_a_law_that_does_not_read_it_is_one_clear_error(operated: Controller) -> None:
    loop = control_loop(settings_of(operated), operated, mv=[40.0, 0.5])
    value = {"points": {"T": [[0, 300.0]]}}
    with pytest.raises(LoopError, match="has no ahead"):
        change(Request.read({"do": "course", "value": value, "who": "anna"}), loop, lambda f, s: Controller(f))


def test_the_command_sends_a_file(
    previewing: Controller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    made = FakeLoop(tmp_path, previewing)
    toml = Path("loop.toml")
    toml.write_text(
        f'controller = "{previewing.path}"\n[server]\nendpoint = "opc.tcp://127.0.0.1:1"\nsecurity = "None"\n'
        f'insecure = true\n[nodes.pv]\n[nodes.mv]\n[journal]\nfile = "{made.journal.name}"\n'
    )
    Path("recipe.csv").write_text("time,y0,d0\n0,,0\n600,0.5,0.2\n")
    Path("wrong.csv").write_text("time,y0\nsoon,0.5\n")
    try:
        words = ["loop", "course", "recipe.csv", "--straight", "y0", "--who", "anna"]
        assert main(words) == 0
        assert made.changes[-1]["do"] == "course"
        assert made.changes[-1]["value"] == {
            "points": {"y0": [[600.0, 0.5]], "d0": [[0.0, 0.0], [600.0, 0.2]]}, "straight": ["y0"],
        }  # fmt: skip
        assert main(["loop", "course", "--end", "y0"]) == 0
        assert made.changes[-1]["value"] == {"end": ["y0"]}
        assert main(["loop", "course", "--end"]) == 0
        assert made.changes[-1]["value"] is None
        capsys.readouterr()
        assert main(["loop", "course", "wrong.csv"]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    finally:
        made.close()
