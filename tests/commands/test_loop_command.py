"""``loopwright loop`` as a person uses it: write a loop.toml, try it, run it, make data of its journal."""

from __future__ import annotations

import os
import re
import socket
import sqlite3
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plant_servers import Plant, RunningLoop, spoil
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.export.controller_file import with_evidence
from loopwright.serving import Controller, LoopError, Signal
from loopwright.serving.journal import Journal
from loopwright.serving.opcua.inspection import _refused, _unfit, inspected
from loopwright.serving.opcua.nameplates import other_unit
from loopwright.serving.opcua.plan import Role, Row
from loopwright.serving.opcua.settings import Nodes, Point, Server
from loopwright.serving.station.command import JOURNAL_LOST, doubts
from loopwright.serving.station.mv_lock import Lease
from loopwright.serving.station.settings import Settings

ROOT = Path(__file__).parents[2]
PID = ROOT / "artifacts" / "thiosulfate_cstr" / "pid.onnx"


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), "thiosulfate_cstr", 5.0, "--types", "REAL")
    made.start()
    yield made
    made.end()


@pytest.fixture
def settings(plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A loop.toml for that plant, five times as fast as the clock."""
    monkeypatch.chdir(tmp_path)
    assert main(["loop", "init", str(PID), "--endpoint", plant.endpoint]) == 0
    path = tmp_path / "loop.toml"
    # Another program may listen at the port that a loop.toml begins with.
    path.write_text("speed = 5.0\n" + path.read_text().replace("127.0.0.1:8080", "127.0.0.1:0"))
    return path


def changed(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_the_way_from_a_controller_to_training_data(
    settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]
) -> None:
    """Signed and encrypted, REAL nodes, AUTO."""
    assert stat.S_IMODE(os.stat("loop-key.pem").st_mode) == 0o600
    assert main(["loop", "check"]) == 0
    said = capsys.readouterr().out
    assert "nothing would stop the loop" in said
    assert [line.split()[:2] for line in said.splitlines() if line.startswith("PV")] == [["PV", "C_A"], ["PV", "T"]]
    assert "note: server_certificate is not set" in said
    changed(settings, 'start = "SHADOW"', 'start = "AUTO"')
    before = len(plant.actuator())
    assert main(["loop", "run", "--scans", "25"]) == 0
    said = capsys.readouterr().out
    assert "loop.toml: started in AUTO" in said
    assert "server_certificate" not in said  # nobody stands between the loop and a plant for trials
    assert "25 scans" in said or "missed" in said
    assert re.search(r"ended in (AUTO|HOLD): the plant keeps T_j at [\d.]+ K, and this loop moves it no more", said)
    for row in plant.actuator()[before:]:
        assert row["asked"] == [float(np.float32(row["asked"][0]))]
    assert main(["loop", "export", "loop.journal"]) == 0
    assert "`loopwright new NAME loop.csv --tags loop-tags.csv --period 0.5`" in capsys.readouterr().out
    table = pd.read_csv("loop.csv")
    assert list(table.columns) == ["time", "C_A.PV", "T.PV", "T_j.OP", "C_A.SP", "MODE"]
    assert set(table["MODE"]) <= {"AUTO", "HOLD"}
    assert table.loc[table["MODE"] == "AUTO", "T.PV"].between(200, 600).all()  # in HOLD there may be none
    assert table["T.PV"].notna().any()
    times = pd.to_datetime(table["time"])
    assert times.is_monotonic_increasing
    before_text = Path("loop.csv").read_text()
    assert main(["loop", "export", "loop.journal"]) == 2
    assert "loop.csv is there already; name another file by --out, or write over it" in capsys.readouterr().err
    assert Path("loop.csv").read_text() == before_text
    assert main(["loop", "export", "loop.journal", "--replace"]) == 0


def test_a_shadow_writes_nothing_but_its_heartbeat(
    settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]
) -> None:
    before = len(plant.actuator())
    assert main(["loop", "run", "--scans", "15"]) == 0
    said = capsys.readouterr().out
    assert "(law T_j" in said
    assert "ended in SHADOW: this loop does not write, and the plant keeps what others set" in said
    assert len({row["asked"][0] for row in plant.actuator()[before:]}) == 1


def test_what_the_journal_lost_is_in_the_exit_status(
    settings: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Journal) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(Journal, "_write", full)
    assert main(["loop", "run", "--scans", "2"]) == JOURNAL_LOST == 3
    lost = re.search(r"(\d+) scans and events are lost$", capsys.readouterr().out.splitlines()[-1])
    assert lost is not None
    assert int(lost[1]) >= 4  # two scans, the start and the end


def test_check_names_what_would_stop_the_loop(settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]) -> None:
    changed(settings, 's=PV.C_A"', 's=PV.nothing"')
    changed(
        settings,
        'T = "nsu=urn:loopwright:plant;s=PV.T"',
        'T = { node = "nsu=urn:loopwright:plant;s=PV.T", scale = 9.0 }',
    )
    changed(settings, 'node = "nsu=urn:loopwright:plant;s=MV.T_j"', 'node = "nsu=urn:loopwright:plant;s=RB.T_j"')
    assert main(["loop", "check"]) == 2
    said = capsys.readouterr().err
    assert "would stop the loop: PV C_A: its quality is BadNodeIdUnknown; the server has no node nsu=" in said
    assert "outside 200 .. 600 K; another unit?" in said
    assert "would stop the loop: MV T_j, written: it may not be written by this user" in said


def test_check_refuses_another_unit_unless_it_is_explained(
    settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(
        settings,
        'T = "nsu=urn:loopwright:plant;s=PV.T"',
        'T = { node = "nsu=urn:loopwright:plant;s=PV.T", unit = "degC" }',
    )
    assert main(["loop", "check"]) == 2
    assert "would stop the loop: PV T: the server says the unit is K, loop.toml says degC" in capsys.readouterr().err
    changed(settings, 'unit = "degC"', 'unit = "K"')
    assert main(["loop", "check"]) == 0


@pytest.mark.parametrize("start", ["SHADOW", "AUTO"])
def test_run_refuses_what_check_finds_wrong_for_good(
    settings: Path, plant: Plant, start: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another unit, a node that is not there; a node that may not be written stops only a loop that is to write."""
    text = settings.read_text().replace('start = "SHADOW"', f'start = "{start}"')
    t_at, mv_at = '"nsu=urn:loopwright:plant;s=PV.T"', 'node = "nsu=urn:loopwright:plant;s=MV.T_j"'
    before = len(plant.actuator())
    for old, new, words in (
        (f"T = {t_at}", f'T = {{ node = {t_at}, unit = "degC" }}', "PV T: the server says the unit is K"),
        ("s=PV.T", "s=PV.TT", "PV T: its quality is BadNodeIdUnknown; the server has no node"),
        *[(mv_at, mv_at.replace("s=MV", "s=RB"), "MV T_j, written: it may not be written by this user")]
        * (start == "AUTO"),
    ):
        assert old in text
        settings.write_text(text.replace(old, new, 1))
        assert main(["loop", "run", "--scans", "3"]) == 2
        said = capsys.readouterr()
        assert said.err.startswith(f"would stop the loop: {words}")
        assert said.out == ""
    assert not Path("loop.journal").exists()
    assert len({row["asked"][0] for row in plant.actuator()[before:]}) <= 1


def test_run_begins_while_a_sensor_is_bad(settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]) -> None:
    """It may come back at any time."""
    spoil(plant, "PV.T", "bad")
    try:
        assert main(["loop", "run", "--scans", "20"]) == 0
    finally:
        spoil(plant, "PV.T", "")
    assert "BadSensorFailure" in capsys.readouterr().out


HALF = 'hand_back = { node = "nsu=urn:loopwright:plant;s=Control.Owner", value = 0.5 }'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('then = "stay"', 'then = "safe"\nsafe = { T_j = 900 }\nrate = { T_j = 1 }', "the safe MV T_j = 900"),
        ("transfer_s = 10", "transfer_s = -5", "transfer_s is -5"),
        (
            "watchdog_scans = 3",
            f"watchdog_scans = 3\n{HALF}",
            "value is 0.5; no number of the type Int32 lies near 0.5",
        ),
        ('file = "loop.journal"', 'file = "nowhere/loop.journal"', "there is no folder"),
        ('file = "loop.journal"', 'file = "loop.toml"', "loop.toml is no journal"),
        (
            'page = "127.0.0.1:0"',
            'page = { listen = "127.0.0.1:0", token_file = "none.txt" }',
            "page.token_file cannot be read",
        ),
        (
            'page = "127.0.0.1:0"',
            'page = { listen = "127.0.0.1:0", certificate = "loop-certificate.der", private_key = "loop-key.pem" }',
            "the page's certificate or key cannot be used",
        ),
    ],
)
def test_what_would_stop_the_loop_is_said_by_check_and_not_by_the_plant(
    settings: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, words: str
) -> None:
    changed(settings, old, new)
    capsys.readouterr()
    assert main(["loop", "check"]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert "nothing would stop the loop" not in said.out


def test_check_tells_of_a_port_and_an_mv_that_others_have(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        changed(settings, "127.0.0.1:0", taken)
        read = Settings.read(settings)
        lease = Lease(read.server.endpoint, [p.node for p in read.nodes.points("mv").values()])
        capsys.readouterr()
        assert main(["loop", "check"]) == 2
        lease.release()
    port, lock = sorted(capsys.readouterr().err.splitlines(), key=lambda line: "written by" in line)
    assert port.startswith(f"would stop the loop: the page cannot listen at {taken}")
    assert f"is written by another loop (process {os.getpid()}); end that one first" in lock


def test_check_says_what_a_numbered_namespace_is_and_finds_an_mv_that_is_spelt_otherwise(
    settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]
) -> None:
    settings.write_text(settings.read_text().replace("nsu=urn:loopwright:plant;", "ns=2;"))
    read = Settings.read(settings)
    found = inspected(Controller(PID).manifest, read.server, read.nodes, 0.05)
    capsys.readouterr()
    assert main(["loop", "check"]) == 0
    named = "note: namespace 2: it is urn:loopwright:plant now; write nsu=urn:loopwright:plant;s="
    assert named in capsys.readouterr().out
    other = Lease("opc.tcp://plant.invalid:4840", ["nsu=urn:loopwright:plant;s=MV.T_j"])
    other.claim(found.identity.writes)
    try:
        assert main(["loop", "check"]) == 2
        assert f"is written by another loop (process {os.getpid()})" in capsys.readouterr().err
        assert main(["loop", "run", "--scans", "1"]) == 2
        assert f"is written by another loop (process {os.getpid()})" in capsys.readouterr().err
    finally:
        other.release()


def test_check_beside_the_loop_itself_finds_nothing_wrong(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    running = RunningLoop(settings)
    try:
        capsys.readouterr()
        assert main(["loop", "check"]) == 0
    finally:
        running.end()
    assert f"note: this loop runs already (process {os.getpid()})" in capsys.readouterr().out
    assert main(["loop", "check"]) == 0
    assert "runs already" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "kind", "words"),
    [
        (2, "Boolean", "neither 0 nor 1"),
        (1, "Boolean", ""),
        (0.5, "Int32", "Int32"),
        (-1, "Byte", "Byte"),
        (0.1, "Float", ""),
    ],
)
def test_a_number_that_hands_the_plant_back_fits_its_nodes_type(value: float, kind: str, words: str) -> None:
    found = _unfit(value, kind)
    assert words in found
    assert bool(found) is bool(words)


@pytest.mark.parametrize(("shown", "stops"), [(610.0, False), (621.0, True)])
def test_check_agrees_with_the_guards_on_a_pv_beyond_its_range(
    settings: Path, capsys: pytest.CaptureFixture[str], shown: float, stops: bool
) -> None:
    """The range of T ends at 600 K, and guards.margin allows 20 K more."""
    changed(
        settings,
        'T = "nsu=urn:loopwright:plant;s=PV.T"',
        f'T = {{ node = "nsu=urn:loopwright:plant;s=PV.T", scale = 1e-9, offset = {shown} }}',
    )
    capsys.readouterr()
    assert main(["loop", "check"]) == (2 if stops else 0)
    said = capsys.readouterr()
    assert f"PV T: {shown:g} lies outside 200 .. 600 K; another unit?" in (said.err if stops else said.out)


def test_no_guard_looks_at_the_value_of_a_dv_a_set_point_or_a_node_that_is_written() -> None:
    signal, point = Signal("x", "K", 0.0, 100.0), Point("n")
    rows = [Row(role, point, signal) for role in (Role.PV, Role.MV, Role.DV, Role.SP)]
    rows.append(Row(Role.MV, point, signal, written=True))
    refused = [row.name for row in rows if _refused(row, signal, 110.0, 0.05)]
    assert refused == ["PV x", "MV x"]
    assert not _refused(rows[1], signal, 101.9, 0.05)
    assert _refused(rows[1], signal, 102.1, 0.05)


@pytest.mark.parametrize(
    ("server", "point", "words"),
    [
        ("K", Point("n"), ""),
        ("-", Point("n"), ""),
        (
            "°C",
            Point("n"),
            'the server says the unit is °C, the controller\'s is K: give scale and offset, or unit = "°C"',
        ),
        ("°C", Point("n", offset=273.15), ""),
        ("kelvin", Point("n", unit="kelvin"), ""),
        ("K", Point("n", unit="kelvin"), "the server says the unit is K, loop.toml says kelvin"),
    ],
)
def test_a_unit_is_the_controllers_or_explained(server: str, point: Point, words: str) -> None:
    assert other_unit(server, point, Signal("T", "K", 200.0, 600.0)).startswith(words)
    assert bool(other_unit(server, point, Signal("T", "K", 200.0, 600.0))) == bool(words)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("transfer_s = ", "transfer = ", "loop.toml: unknown key 'transfer'; did you mean 'transfer_s'?"),
        ('security = "Basic256Sha256"', 'security = "None"', "security is None: everyone on the network"),
        ("C_A = ", "C_B = ", "nodes.pv has 'C_B', which the controller has not; did you mean 'C_A'?"),
        ('sha256 = "', 'sha256 = "00', "not the pinned 00"),
        ('then = "stay"', 'then = "safe"', 'safe MVs go with then = "safe"'),
        ("margin = 0.05", 'margin = "wide"', "guards.margin is 'wide'; it must be a number"),
        ("frozen = 0", "frozen = 1", "frozen is 1; it must be 0 (never) or a number of samples of at least 2"),
        ("opc.tcp://", "http://", "it must begin with opc.tcp://"),
        ("opc.tcp://", "opc.tcp://user:secret@", "endpoint holds a user name"),
        ('# user = "loopwright"', 'user = "loopwright"', "user needs a password"),
        ("[journal]", "[journal", "is not TOML"),
    ],
)
def test_mistakes_are_one_line(
    settings: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, words: str
) -> None:
    changed(settings, old, new)
    assert main(["loop", "check"]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert "secret" not in said


def test_a_server_that_is_not_there_is_one_line(
    settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(settings, f":{plant.port}", ":1")
    assert main(["loop", "check"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        "loopwright loop: opc.tcp://127.0.0.1:1 refuses: nothing listens there; is the server running?"
    )


def test_a_password_comes_from_the_environment_or_a_file(settings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changed(settings, '# user = "loopwright"', 'user = "loopwright"')
    changed(settings, '# password_env = "LOOP_PASSWORD"', 'password_env = "LOOP_PASSWORD"')
    server = Settings.read(settings).server
    monkeypatch.delenv("LOOP_PASSWORD", raising=False)
    with pytest.raises(LoopError, match="the environment variable LOOP_PASSWORD, which holds the password, is not set"):
        server.password()
    monkeypatch.setenv("LOOP_PASSWORD", "from the environment")
    assert server.password() == "from the environment"
    changed(settings, 'password_env = "LOOP_PASSWORD"', 'password_file = "secret.txt"')
    (settings.parent / "secret.txt").write_text("from a file\n")
    assert Settings.read(settings).server.password() == "from a file"


def test_a_second_loop_on_the_same_mv_is_refused(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    read = Settings.read(settings)
    first = Lease(read.server.endpoint, [p.node for p in read.nodes.points("mv").values()])
    try:
        assert main(["loop", "run", "--scans", "1"]) == 2
        said = capsys.readouterr().err
        assert f"is written by another loop (process {os.getpid()}); end that one first" in said
    finally:
        first.release()


def test_what_is_there_is_not_written_over(settings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = settings.read_text()
    assert main(["loop", "init", str(PID)]) == 2
    assert "loop.toml is there already" in capsys.readouterr().err
    assert settings.read_text() == before
    assert main(["loop", "export", "nowhere.journal"]) == 2
    assert "nowhere.journal is not here" in capsys.readouterr().err


def test_a_journal_is_named_after_its_loop_and_a_second_one_uses_the_same_key(
    plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["loop", "init", str(PID), "--out", "reactor.toml"]) == 0
    assert "written: reactor.toml, and beside it loop-certificate.der" in capsys.readouterr().out
    key = Path("loop-key.pem").read_bytes()
    assert main(["loop", "init", str(PID), "--out", "second.toml"]) == 0
    assert "written: second.toml; it uses loop-certificate.der (for the server to trust)" in capsys.readouterr().out
    assert Path("loop-key.pem").read_bytes() == key
    assert Settings.read(Path("reactor.toml")).journal.file.name == "reactor.journal"


def test_a_signal_is_spoilt_and_mended_by_a_command(
    settings: Path, plant: Plant, capsys: pytest.CaptureFixture[str]
) -> None:
    at = ["--endpoint", plant.endpoint]
    assert main(["plant", "fault", "PV.T", "bad", *at]) == 0
    assert within(5, lambda: main(["loop", "check"]) == 2)
    assert "PV T: its quality is BadSensorFailure" in capsys.readouterr().err
    assert main(["plant", "fault", "PV.T", "ok", *at]) == 0
    assert within(5, lambda: main(["loop", "check"]) == 0)
    capsys.readouterr()
    assert main(["plant", "fault", "T", "bad", *at]) == 2
    assert "has no signal 'T'; write it as PV.NAME" in capsys.readouterr().err
    assert main(["plant", "fault", "PV.T", "bad", "--endpoint", "opc.tcp://127.0.0.1:1"]) == 2
    assert "no served plant answers at opc.tcp://127.0.0.1:1" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["speed = " + "9" * 5001, "x = " + "[" * 5000, "speed = inf", "speed = 1e999", "speed = nan", "\ud7ff="]
)
def test_a_loop_toml_that_cannot_be_read_is_one_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "loop.toml"
    path.write_text(f'controller = "c.onnx"\n{text}\n[server]\nendpoint = "opc.tcp://127.0.0.1:1"\n[nodes]\n')
    with pytest.raises(LoopError) as found:
        Settings.read(path)
    assert len(str(found.value).splitlines()) == 1
    assert len(str(found.value)) < 400


def test_a_mark_of_utf_8_before_a_loop_toml_is_none_of_its_text(settings: Path) -> None:
    settings.write_text("\ufeff" + settings.read_text())
    assert Settings.read(settings).speed == 5.0


def test_a_loop_that_begins_in_auto_needs_a_word_for_a_file_that_is_not_proven(
    plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with_evidence(PID, tmp_path / "new.onnx", {})
    assert main(["loop", "init", "new.onnx", "--endpoint", plant.endpoint]) == 0
    path = tmp_path / "loop.toml"
    text = path.read_text().replace("127.0.0.1:8080", "127.0.0.1:0")
    path.write_text(text)
    capsys.readouterr()
    assert main(["loop", "check"]) == 0  # in SHADOW it is said, and stops nothing
    assert "note: pid is not proven" in capsys.readouterr().out
    path.write_text(text.replace('start = "SHADOW"', 'start = "AUTO"'))
    assert main(["loop", "check"]) == main(["loop", "run", "--scans", "1"]) == 2
    assert capsys.readouterr().err.count("accept_unproven") == 2
    path.write_text("accept_unproven = true\n" + path.read_text())
    assert main(["loop", "check"]) == 0
    assert "note: pid is not proven" in capsys.readouterr().out


def test_a_server_that_is_not_pinned_is_told_of_a_real_plant_and_at_every_check() -> None:
    """A running loop says nothing of one at its own address, or of a plant that is simulated faster than the clock."""
    nodes = Nodes({"T": "T"}, {"u": "u"})

    def told(endpoint: str, speed: float, *, running: bool) -> bool:
        server = Server(endpoint, certificate=Path("c.der"), private_key=Path("k.pem"))
        lines = doubts(Settings(PID, server, nodes, speed=speed), running=running)
        return any("server_certificate" in line for line in lines)

    away, here = "opc.tcp://10.1.2.3:4840", "opc.tcp://127.0.0.1:4840"
    assert told(away, 1.0, running=True)
    assert not told(here, 1.0, running=True)
    assert not told(away, 10.0, running=True)
    assert told(here, 1.0, running=False)
