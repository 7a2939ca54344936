"""A loop that runs is steered from its own machine, and a controller is swapped in it.

A machine that is busy may hold the loop for some scans at any time: what is asked of it holds nonetheless.
"""

from __future__ import annotations

import csv
import getpass
import json
import math
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from killers import blind_children, killer
from plant_servers import UNKNOWN, Plant, RunningLoop, spoil
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving import Controller, LoopError, Mode
from loopwright.serving.journal import JournalReader
from loopwright.serving.journal.entries import Entry
from loopwright.serving.monitor import Monitor, Verdict
from loopwright.serving.page.app import candidates
from loopwright.serving.station.control import ask

pytest_plugins = ["small_laws"]
ARTIFACTS = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr"
SPEED = 2.5  # periods of .2 s


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), "thiosulfate_cstr", SPEED, "--noise")
    made.start()
    yield made
    made.end()


@pytest.fixture
def loop(plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningLoop]:
    monkeypatch.chdir(tmp_path)
    for name in ("pid", "inverse_dob", "incad"):
        shutil.copy(ARTIFACTS / f"{name}.onnx", tmp_path)
    assert main(["loop", "init", "pid.onnx", "--endpoint", plant.endpoint]) == 0
    path = tmp_path / "loop.toml"
    text = path.read_text()
    assert 'page = "127.0.0.1:8080"' in text
    text = re.sub("max_age_s = .*", "max_age_s = 5", text)  # this machine has other work beside it
    path.write_text(f"speed = {SPEED}\n" + text.replace('page = "', '# page = "'))
    made = RunningLoop(path)
    yield made
    made.end()


def loopwright(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    capsys.readouterr()
    status = main(["loop", *words])
    said = capsys.readouterr()
    return status, said.out + said.err


def done(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What a change did; asked again while the loop has just lost its plant."""
    said = ""

    def accepted() -> bool:
        nonlocal said
        status, said = loopwright(capsys, *words)
        assert status == 0 or UNKNOWN in said, said
        return status == 0

    assert within(20, accepted)
    return said


def state(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    status, said = loopwright(capsys, "state")
    assert status == 0
    return json.loads(said)  # type: ignore[no-any-return]


def becomes(capsys: pytest.CaptureFixture[str], mode: str) -> bool:
    return within(20, lambda: state(capsys)["mode"] == mode)


def test_modes_set_points_and_mvs(
    loop: RunningLoop, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    who = ("--who", "anna", "--reason", "start of the shift")
    assert state(capsys)["mode"] == "SHADOW"
    assert done(capsys, "mode", "manual", *who).startswith("mode SHADOW -> MANUAL")
    assert becomes(capsys, "MANUAL")
    done(capsys, "mv", "T_j=260", *who)
    done(capsys, "sp", "C_A=0.5", *who)
    done(capsys, "mode", "auto", *who)

    def good() -> bool:
        now = state(capsys)
        return (now["mode"], now["sp"], now["quality"]) == ("AUTO", {"C_A": 0.5}, ["Good", "Good", "Good"])

    assert within(20, good)
    killer(tmp_path / "killer.onnx", loop.station.manifest)
    blind_children(monkeypatch, tmp_path / "blind")
    for words, refusal in (
        (("mode", "fast"), "mode is 'FAST'; "),
        (("sp", "C_A=2"), "the set point C_A = 2.0 mol/l is outside [0, 1] mol/l"),
        (("sp", "C_A=nan"), "the set point C_A is nan; it must be a number"),
        (("sp", "C_B=1"), "there is no set point 'C_B'; did you mean 'C_A'?"),
        (("mv", "T_j=300"), "the MV is set by hand in MANUAL only; the loop is in "),
        (("sp", "C_A"), "'C_A' is no NAME=VALUE with a number"),
        (("swap", "--back"), "no controller was replaced since this loop began"),
        (("swap", "--keep"), "no controller is on trial"),
        (("swap", "nowhere.onnx"), "nowhere.onnx: the file cannot be read"),
        (("swap", "pid.onnx"), "is in charge already"),
        (("swap", "killer.onnx"), "it ended the process that tried its first steps (SIGSEGV)"),
        (("mode", "auto", "--who", " "), "who is empty: a change is written down with a name"),
    ):
        status, said = loopwright(capsys, *words)
        assert status == 2
        assert refusal in said
        assert said.count("\n") == 1
    assert within(20, lambda: loop.station.journal.behind == 0)
    events = loop.events()
    assert "change anna: mode SHADOW -> MANUAL" in events
    assert "change anna: MV T_j 250 -> 260 K" in events
    refused = [event for event in events if "refused" in event and UNKNOWN not in event]
    assert refused == []  # what is refused there never came to the loop


def test_who_asks_reads_what_the_last_scan_left(
    loop: RunningLoop, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The monitor works in the loop's thread; another one that read it while it works would see half of a scan."""
    threads = set[int | None]()
    kind = type(loop.station.watching.monitor)
    verdicts = kind.verdicts

    def told(self: Monitor) -> list[Verdict]:
        threads.add(threading.get_ident())
        return verdicts(self)

    monkeypatch.setattr(kind, "verdicts", told)
    first = state(capsys)["scan"]
    assert within(20, lambda: state(capsys)["scan"] > first + 3)
    assert threads == {loop.thread.ident}


def test_a_controller_is_tried_takes_over_and_is_put_back(
    loop: RunningLoop, capsys: pytest.CaptureFixture[str]
) -> None:
    def law() -> str:
        return loop.station.loop.controller.manifest.law if loop.station.loop is not None else ""

    done(capsys, "mode", "auto")
    assert "loop.toml still names the old file" in done(capsys, "swap", "inverse_dob.onnx", "--trial", "8")
    successor = state(capsys)["successor"]
    assert successor is None or successor["law"] == "inverse_dob"
    assert within(60, lambda: law() == "inverse_dob")  # after good scans in a row
    assert within(10, lambda: loop.station.watching.monitor.manifest.law == "inverse_dob")
    assert loop.station.watching.monitor.trouble == ""
    assert loopwright(capsys, "swap", "incad.onnx", "--trial", "1000")[0] == 0
    assert within(20, lambda: state(capsys)["beside"] is not None)
    assert loopwright(capsys, "swap", "--keep")[0] == 0
    status, said = loopwright(capsys, "swap", "--back", "--trial", "3")
    assert status == 0
    assert "still names the old file" not in said
    assert "a restart brings the controller that loop.toml names" in said
    assert within(60, lambda: law() == "pid")
    assert loop.station.watching.monitor.trouble == ""
    loop.station.end()
    loop.thread.join(20)
    with closing(JournalReader(loop.settings.journal.file)) as reader:
        assert [run["controller"].split()[0] for run in reader.runs()] == ["pid", "inverse_dob", "pid"]
        rows = list(reader.scans())
        columns = {run["id"]: run["columns"] for run in reader.runs()}
    assert all(len(scan.numbers) == len(columns[run]) for _, run, scan in rows)
    beside = [scan.numbers[columns[run].index("beside T_j")] for _, run, scan in rows]
    assert sum(value == value for value in beside) >= 8 + 3
    said_by_loop = [e for e in loop.events() if e.startswith("swap loop: ") and "begins anew" not in e]
    assert "inverse_dob (inverse_dob.onnx" in said_by_loop[0]
    assert "has the plant, after pid" in said_by_loop[0]


def level(law: Any, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
    """Adds to the applied MV; reads what it controls and nothing else."""
    return law.limited(mv_applied + 20.0 * (sp - pv), mv_applied), state, pv[..., :0]


def test_a_controller_that_reads_fewer_pvs_takes_over(
    loop: RunningLoop,
    plant: Plant,
    make_formula: Callable[..., Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As one that was made of the loop's own journal: everything is read, shown and written down as before."""
    m = Controller(ARTIFACTS / "pid.onnx").manifest
    c_a = replace(m.pv[0], high=0.99)
    narrow = Signals(m.period_s, m.sp, (c_a,), (), m.mv)
    export(make_formula(level, signals=narrow), tmp_path / "level.onnx", case="thiosulfate_cstr", provenance={})
    done(capsys, "mode", "auto")
    assert loopwright(capsys, "swap", "level.onnx", "--trial", "4")[0] == 2  # it was never validated
    assert loopwright(capsys, "swap", "level.onnx", "--trial", "4", "--accept-unproven")[0] == 0
    assert within(60, lambda: state(capsys)["replaced"] is not None)
    assert within(10, lambda: loop.station.watching.monitor.manifest.law == "formula")
    before = len(loop.commands)
    assert within(60, lambda: len(loop.since(before, Mode.AUTO)) > 10)
    assert within(20, lambda: list(state(capsys)["pv"] or ()) == ["C_A", "T"])
    assert loop.station.watching.monitor.trouble == ""
    about = ask(loop.settings.journal.file, {"do": "about"})
    assert [(s["name"], s["high"]) for s in about["signals"]["pv"]] == [("C_A", 0.99), ("T", m.pv[1].high)]
    assert (about["card"]["law"], about["card"]["file"]) == ("formula", "level.onnx")
    rows = candidates(tmp_path / about["card"]["file"], None, Path(about["first"]))
    assert [row["file"] for row in rows] == ["incad.onnx", "inverse_dob.onnx", "pid.onnx"]
    spoil(plant, "PV.T", "bad")
    assert within(20, lambda: "PV T: BadSensorFailure" in state(capsys)["reason"])
    spoil(plant, "PV.T", "")
    assert becomes(capsys, "AUTO")
    assert loopwright(capsys, "swap", "--back", "--trial", "2")[0] == 0
    assert within(60, lambda: state(capsys)["sha256"] == loop.station.controller.sha256)
    before = len(loop.commands)
    assert within(60, lambda: len(loop.since(before, Mode.AUTO)) > 2)  # by the one that is back
    loop.end()
    assert loopwright(capsys, "export", str(loop.settings.journal.file))[0] == 0
    with (tmp_path / "loop.csv").open(newline="") as text:
        exported = list(csv.DictReader(text))
    assert sum(bool(row["T.PV"]) for row in exported) > 10
    tags = (tmp_path / "loop-tags.csv").read_text().splitlines()
    assert {row["tag"] for row in csv.DictReader(tags)} >= {"C_A.PV", "T.PV"}
    with closing(JournalReader(loop.settings.journal.file)) as reader:
        assert [run["controller"].split()[0] for run in reader.runs()] == ["pid", "formula", "pid"]
        places = {run["id"]: run["columns"].index("pv T") for run in reader.runs()}
        read = {run: scan.numbers[places[run]] for _, run, scan in reader.scans() if not scan.reason}
    assert set(read) == set(places)
    assert all(math.isfinite(value) for value in read.values())


def test_an_alarm_is_acknowledged_once(loop: RunningLoop, plant: Plant, capsys: pytest.CaptureFixture[str]) -> None:
    done(capsys, "mode", "auto")
    spoil(plant, "PV.T", "bad")
    assert within(20, lambda: "fault loop: PV T: BadSensorFailure" in loop.events())
    spoil(plant, "PV.T", "")

    def modes() -> list[str]:
        changes = [e for e in loop.events() if e.startswith("change ") and "mode" in e]
        return [e for e in changes if UNKNOWN not in e]

    assert within(20, lambda: modes()[-1] == "change loop: mode HOLD -> AUTO")
    by_whom, *others = modes()
    assert by_whom == f"change {getpass.getuser()}: mode SHADOW -> AUTO"
    holds = ["change loop: mode AUTO -> HOLD", "change loop: mode HOLD -> AUTO"]
    assert others == (holds * len(others))[: len(others)]  # the bad sensor's, and those of a busy machine
    journal = loop.settings.journal.file

    def alarm_is_over() -> Entry | None:
        with closing(JournalReader(journal)) as reader:
            found = [e for e in reader.entries() if e.event.raised and e.event.what == "PV T: BadSensorFailure"]
        return found[-1] if found and found[-1].over_s is not None else None  # the oldest of them

    assert within(20, lambda: alarm_is_over() is not None)
    assert within(20, lambda: "fault loop: over: PV T: BadSensorFailure" in loop.events())
    alarm = alarm_is_over()
    assert alarm is not None
    assert alarm.acknowledged is None
    request = {"do": "acknowledge", "value": alarm.id, "who": "anna", "reason": "the sensor was cleaned"}
    assert ask(journal, request) == {"done": "acknowledged: PV T: BadSensorFailure"}
    with closing(JournalReader(journal)) as reader:

        def seen() -> bool:
            entry = reader.entry(alarm.id)
            return entry is not None and entry.acknowledged is not None and entry.acknowledged.who == "anna"

        assert within(10, seen)
    for value, words in (
        (alarm.id, "anna has acknowledged it already"),
        (10**6, "there is no alarm"),
        ("x", "there is no"),
    ):
        with pytest.raises(LoopError, match=words):
            ask(journal, {**request, "value": value})
    for wrong, words in (
        ([], 'a request is an object with "do"'),
        ({"do": "mode", "value": "AUTO"}, "who is empty"),
        ({**request, "do": "fly"}, "the loop cannot 'fly'"),
        ({**request, "why": 1}, "a request has no 'why'"),
        ({**request, "reason": "a\nb"}, "reason must be a line of at most 300 characters"),
        ({**request, "do": "swap", "value": {"file": "incad.onnx", "trial": 0}}, "trial is 0; it must be"),
    ):
        with pytest.raises(LoopError, match=words):
            ask(journal, wrong)  # type: ignore[arg-type]


def test_without_a_loop_it_is_one_line(loop: RunningLoop, capsys: pytest.CaptureFixture[str]) -> None:
    loop.end()
    assert loopwright(capsys, "mode", "auto") == (
        2, "loopwright loop: no loop runs with this journal; `loopwright loop run` starts it\n",
    )  # fmt: skip
