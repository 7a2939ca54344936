"""A loop that runs is steered from its own machine, and a controller is swapped in it."""

from __future__ import annotations

import csv
import getpass
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from plant_servers import Plant, RunningLoop, spoil
from processes import within

from pipeline.__main__ import main
from pipeline.export.gate import export
from pipeline.plants.signals import Signals
from serving import Controller, LoopError
from serving.journal import JournalReader
from serving.page.candidates import candidates
from serving.station.control import ask

pytest_plugins = ["small_laws"]
ARTIFACTS = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr"


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), "thiosulfate_cstr", 5.0, "--noise")
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
    path.write_text("speed = 5.0\n" + text.replace('page = "', '# page = "'))
    made = RunningLoop(path)
    yield made
    made.end()


def loopwright(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    capsys.readouterr()
    status = main(["loop", *words])
    said = capsys.readouterr()
    return status, said.out + said.err


def test_modes_set_points_and_mvs(loop: RunningLoop, capsys: pytest.CaptureFixture[str]) -> None:
    who = ("--who", "anna", "--reason", "start of the shift")
    status, said = loopwright(capsys, "state")
    assert (status, json.loads(said)["mode"]) == (0, "SHADOW")
    assert loopwright(capsys, "mode", "manual", *who) == (0, "mode SHADOW -> MANUAL\n")
    assert loopwright(capsys, "mv", "T_j=260", *who)[0] == 0
    assert loopwright(capsys, "sp", "C_A=0.5", *who)[0] == 0
    assert loopwright(capsys, "mode", "auto", *who)[0] == 0
    state = json.loads(loopwright(capsys, "state")[1])
    assert (state["mode"], state["sp"], state["quality"]) == ("AUTO", {"C_A": 0.5}, ["Good", "Good", "Good"])
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
        (("mode", "auto", "--who", " "), "who is empty: a change is written down with a name"),
    ):
        status, said = loopwright(capsys, *words)
        assert status == 2
        assert refusal in said
        assert said.count("\n") == 1
    events = loop.events()
    assert "change anna: mode SHADOW -> MANUAL" in events
    assert "change anna: MV T_j 250 -> 260 K" in events
    assert not any("refused" in event for event in events)  # what is refused there never came to the loop


def test_a_controller_is_tried_takes_over_and_is_put_back(
    loop: RunningLoop, capsys: pytest.CaptureFixture[str]
) -> None:
    def law() -> str:
        return loop.station.loop.controller.manifest.law if loop.station.loop is not None else ""

    assert loopwright(capsys, "mode", "auto")[0] == 0
    status, said = loopwright(capsys, "swap", "inverse_dob.onnx", "--trial", "8")
    assert status == 0
    assert "loop.toml still names the old file" in said
    successor = json.loads(loopwright(capsys, "state")[1])["successor"]
    assert successor is None or successor["law"] == "inverse_dob"
    assert within(20, lambda: law() == "inverse_dob")
    assert within(10, lambda: loop.station.watching.monitor.manifest.law == "inverse_dob")
    assert loop.station.watching.monitor.trouble == ""
    assert loopwright(capsys, "swap", "incad.onnx", "--trial", "1000")[0] == 0
    assert within(10, lambda: json.loads(loopwright(capsys, "state")[1])["beside"] is not None)
    assert loopwright(capsys, "swap", "--keep")[0] == 0
    status, said = loopwright(capsys, "swap", "--back", "--trial", "3")
    assert status == 0
    assert "still names the old file" not in said
    assert "a restart brings the controller that loop.toml names" in said
    assert within(20, lambda: law() == "pid")
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
    assert loopwright(capsys, "mode", "auto")[0] == 0
    assert loopwright(capsys, "swap", "level.onnx", "--trial", "4")[0] == 0

    def state() -> Any:
        return json.loads(loopwright(capsys, "state")[1])

    assert within(20, lambda: state()["replaced"] is not None)
    assert within(10, lambda: loop.station.watching.monitor.manifest.law == "formula")
    before = loop.station.scans
    assert within(10, lambda: loop.station.scans > before + 10)
    now = state()
    assert (now["mode"], list(now["pv"]), now["reason"]) == ("AUTO", ["C_A", "T"], "")
    assert loop.station.watching.monitor.trouble == ""
    about = ask(loop.settings.journal.file, {"do": "about"})
    assert [(s["name"], s["high"]) for s in about["signals"]["pv"]] == [("C_A", 0.99), ("T", m.pv[1].high)]
    assert (about["card"]["law"], about["card"]["file"]) == ("formula", "level.onnx")
    rows = candidates(tmp_path / about["card"]["file"], None, Path(about["first"]))
    assert [row["file"] for row in rows] == ["incad.onnx", "inverse_dob.onnx", "pid.onnx"]
    spoil(plant, "PV.T", "bad")
    assert within(20, lambda: "PV T: BadSensorFailure" in state()["reason"])
    spoil(plant, "PV.T", "")
    assert within(20, lambda: state()["mode"] == "AUTO")
    assert loopwright(capsys, "swap", "--back", "--trial", "2")[0] == 0
    assert within(20, lambda: state()["sha256"] == loop.station.controller.sha256)
    before = loop.station.scans
    assert within(20, lambda: loop.station.scans > before + 2)  # by the one that is back
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
    assert loopwright(capsys, "mode", "auto")[0] == 0
    spoil(plant, "PV.T", "bad")
    assert within(20, lambda: any("PV T: BadSensorFailure" in event for event in loop.events()))
    spoil(plant, "PV.T", "")
    assert within(20, lambda: "fault loop: over: PV T: BadSensorFailure" in loop.events())
    assert within(20, lambda: loop.events()[-1] == "change loop: mode HOLD -> AUTO")
    assert [e for e in loop.events() if e.startswith("change ") and "mode" in e] == [
        f"change {getpass.getuser()}: mode SHADOW -> AUTO",
        "change loop: mode AUTO -> HOLD",
        "change loop: mode HOLD -> AUTO",
    ]
    journal = loop.settings.journal.file
    with closing(JournalReader(journal)) as reader:
        (alarm,) = [e for e in reader.entries() if e.event.raised]
    assert alarm.over_s is not None
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
