"""How a loop begins on its plant: it writes no MV that neither the plant, an operator nor the law has named."""

from __future__ import annotations

import json
import math
import shutil
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from processes import within as in_time
from still_station import still_machine

from loopwright.serving import ArtifactError, Controller, Mode, MonotonicClock, Sample
from loopwright.serving.clock import EndingClock, MachineTime, Time
from loopwright.serving.journal import JournalReader
from loopwright.serving.loop import Command, within
from loopwright.serving.opcua.nameplates import Identity
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.station import plant_side, station
from loopwright.serving.station.build_loop import another_before, namespaces_before
from loopwright.serving.station.command import _Lines
from loopwright.serving.station.mv_lock import Lease
from loopwright.serving.station.settings import Hold, JournalSettings, Settings
from loopwright.serving.station.station import Station
from loopwright.serving.station.views import state

PID = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr" / "pid.onnx"
NODES: dict[str, Any] = {"pv": {"C_A": "ns=2;s=a", "T": "ns=2;s=b"}, "mv": {"T_j": "ns=2;s=c"}}


class Plant:
    """In the place of the endpoint: what it shows, and what was written there."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.values: Values | None = None
        self.trouble, self.connections = "", 1
        self.written: list[float] = []
        self.shows(250.0)

    def shows(self, mv: float, fault: str = "") -> None:
        pv = np.array([0.9, math.nan if fault else 330.0])
        self.values = Values(0.0, pv, np.array([mv]), np.zeros(0), 0.0, fault, (0, 0, 0))

    def start(self) -> None:
        """Nothing: it is there."""

    def close(self) -> None:
        """Nothing."""

    def read(self) -> Sample:
        assert self.values is not None
        return Sample(self.values.pv, self.values.mv, self.values.dv, 0.0, self.values.fault)

    def write(self, mv: np.ndarray) -> None:
        self.written.append(float(mv[0]))


class SlowTime(MachineTime):
    """The machine's; scans wait for a period of half a second for 500."""

    def paced(self, speed: float) -> EndingClock:
        return MonotonicClock(1e-3)


@pytest.fixture
def make_station(tmp_path: Path) -> Callable[..., tuple[Station, Any]]:
    def make(start: str, time: Time | None = None, **changed: Any) -> tuple[Station, Any]:
        server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, connect_s=0.05)
        settings = Settings(
            changed.pop("controller", PID),
            server,
            Nodes(**NODES),
            start=start,  # type: ignore[arg-type]
            hold=Hold(recover_after=2),
            journal=JournalSettings(tmp_path / "loop.journal"),
            **changed,
        )
        machine = still_machine(tmp_path, Plant, time)
        made = Station(settings, controller=Controller(settings.controller), machine=machine)
        return made, made.endpoint

    return make


def test_a_station_takes_no_file_whose_first_steps_nobody_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path, *_: Any) -> Controller:
        raise ArtifactError(f"{path}: it ended the process")

    monkeypatch.setattr(station, "tried", refused)
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
    settings = Settings(PID, server, Nodes(**NODES), journal=JournalSettings(tmp_path / "loop.journal"))
    with pytest.raises(ArtifactError, match="it ended the process"):
        Station(settings)
    assert not list(tmp_path.iterdir())


def events(made: Station) -> list[str]:
    with closing(JournalReader(made.settings.journal.file)) as reader:
        return [f"{e.who}: {e.what}" for _, e in reader.events()]


@pytest.mark.parametrize("start", ["AUTO", "MANUAL"])
def test_a_loop_that_is_ended_while_it_waits_for_a_pv_writes_nothing(
    start: str, make_station: Callable[..., tuple[Station, Any]]
) -> None:
    made, plant = make_station(start)
    plant.shows(250.0, "PV T: Bad")
    thread = threading.Thread(target=made.run)
    thread.start()
    assert not in_time(0.2, lambda: made.scans > 0)
    made.end()
    thread.join(20)
    assert not thread.is_alive()
    assert (plant.written, made.scans) == ([], 0)
    assert events(made) == ["loop: ended before the first scan: nothing was written"]


def test_a_loop_that_is_ended_between_two_scans_does_not_wait_for_the_next(
    make_station: Callable[..., tuple[Station, Any]],
) -> None:
    made, plant = make_station("AUTO", SlowTime())
    thread = threading.Thread(target=made.run)
    thread.start()
    assert in_time(20, lambda: made.snapshot is not None)
    made.end()
    thread.join(60)
    assert not thread.is_alive()
    assert (len(plant.written), made.scans) == (1, 1)
    assert events(made)[-1] == "loop: ended"


@pytest.mark.parametrize("start", ["AUTO", "MANUAL"])
def test_an_actuator_outside_the_controllers_range_is_left_there(
    start: str, make_station: Callable[..., tuple[Station, Any]]
) -> None:
    """It stands at 550 K, and the controller's range ends at 500 K."""
    made, plant = make_station(start)
    plant.shows(550.0)
    reasons: list[str] = []
    journalled: list[Any] = []

    def seen(_: Sample | None, command: Command) -> None:
        reasons.append(command.fault)
        journalled.append(json.loads(json.dumps(state(made), allow_nan=False))["mv"])
        if made.scans == 8:
            assert plant.written == []
            plant.shows(498.0)

    made.watch(seen)
    made.run(12)
    assert journalled[:8] == [None] * 8
    assert "applied MV T_j is 550 K, outside its range" in reasons[7]
    assert plant.written[0] == 498.0
    assert not any("nan" in line for line in events(made))
    with closing(JournalReader(made.settings.journal.file)) as reader:
        rows = [scan.numbers[3] for _, _, scan in reader.scans()]  # behind a set point and two PVs
    assert len(rows) == 12
    assert all(math.isnan(mv) for mv in rows[:8])
    assert rows[8] == 498.0


def test_a_shadow_without_first_values_takes_no_middle_for_the_mv(
    make_station: Callable[..., tuple[Station, Any]],
) -> None:
    made, plant = make_station("SHADOW")
    plant.shows(250.0, "PV T: Bad")
    shown: list[Any] = []

    def seen(_: Sample | None, command: Command) -> None:
        shown.append((command.mode, json.loads(json.dumps(state(made), allow_nan=False))["mv"]))
        assert made.loop is not None
        if made.scans == 3:
            assert np.isnan(made.loop.mv).all()
            plant.shows(310.0)
        if made.scans == 5:
            made.loop.set_mode(Mode.MANUAL)

    made.watch(seen)
    made.run(8)
    assert shown[:5] == [(Mode.SHADOW, None)] * 5
    assert plant.written == [310.0] * 3


@pytest.mark.parametrize("named", [None, 0.7])
def test_a_shadow_that_began_without_the_plant_begins_where_the_plant_stands(
    named: float | None, make_station: Callable[..., tuple[Station, Any]]
) -> None:
    """At the PV, as it does with first values; a set point that somebody named stays. No number is shown before."""
    made, plant = make_station("SHADOW")
    plant.shows(math.nan, "PV T: Bad")
    said: list[str] = []
    made.tell = said.append
    lines = _Lines(made.manifest, said.append)

    def seen(sample: Sample | None, command: Command) -> None:
        lines.show(sample, command)
        assert made.loop is not None
        if made.scans == 2 and named is not None:
            made.loop.set_sp([named])
        if made.scans == 3:
            plant.shows(310.0)

    made.watch(seen)
    made.run(6)
    assert said[0] == "the plant gives no values yet: the loop goes on trying; Ctrl-C ends it"
    assert said[1] == "SHADOW  C_A 0.9 mol/l  PV T: Bad"
    assert said[-1].startswith(f"SHADOW  SP C_A {named or 0.9:g}  C_A 0.9 mol/l  T 330 K  T_j 310 K")
    assert not any("nan" in line for line in said)
    assert ("loop: set point C_A 0.9 mol/l" in events(made)) == (named is None)


def test_a_restart_with_another_controller_than_the_journals_last_one_is_told(
    make_station: Callable[..., tuple[Station, Any]],
) -> None:
    for _ in range(2):
        made, _ = make_station("SHADOW")
        made.run(2)
        assert not any("begins with" in line for line in events(made))
    last = made.journal.path
    other = Controller(PID.with_name("inverse_dob.onnx"))
    words = another_before(last, other)
    assert words.startswith(
        f"begins with inverse_dob.onnx ({other.sha256[:12]}); the journal's last controller was pid"
    )
    made, _ = make_station("SHADOW", controller=other.path)
    made.run(2)
    assert f"loop.toml: {words}" in events(made)


def test_a_set_point_of_the_plants_side_outside_its_range_takes_no_other_one_with_it(
    make_station: Callable[..., tuple[Station, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, _ = make_station("SHADOW")
    a = made.manifest.sp[0]
    signals = tuple(replace(a, name=name) for name in ("one", "two", "three"))
    made.plant_side.manifest = SimpleNamespace(sp=signals)

    class Loop:
        points = np.array([0.1, 0.2, 0.3])

        @property
        def sp(self) -> np.ndarray:
            return self.points.copy()

        def set_sp(self, wanted: Any) -> None:
            self.points = within(wanted, signals, "set point")

    loop: Any = Loop()
    made.plant_side.set_points(loop, {"one": 0.5, "two": 99.0, "three": 0.7})
    assert loop.sp.tolist() == [0.5, 0.2, 0.7]
    made.journal.close()
    said = events(made)
    assert [line.split(" (")[0] for line in said] == [
        f"plant: set point one 0.5 {a.unit}",
        f"plant: refused: set point two 99 {a.unit}",
        f"plant: set point three 0.7 {a.unit}",
    ]


def test_a_controller_that_is_tried_lies_beside_the_one_in_charge(
    make_station: Callable[..., tuple[Station, Any]], tmp_path: Path
) -> None:
    made, _ = make_station("SHADOW")
    shutil.copy(PID, tmp_path / "elsewhere.onnx")
    assert made._opened("pid.onnx", None).path == PID
    made.snapshot = SimpleNamespace(controller=Controller(tmp_path / "elsewhere.onnx"))  # type: ignore[assignment]
    assert made._opened("elsewhere.onnx", None).path == tmp_path / "elsewhere.onnx"


def test_a_loop_that_learns_from_its_server_that_another_one_writes_its_mv_does_not_begin_to_write(
    make_station: Callable[..., tuple[Station, Any]], tmp_path: Path
) -> None:
    """The other one spells host and node otherwise, so that each could start."""
    other = Lease("opc.tcp://plant.invalid:4840", ["nsu=urn:plant;s=c"], tmp_path / "locks")
    key = "urn:server 1.0 nsu=urn:plant;s=c"
    other.claim({key: "nsu=urn:plant;s=c"})
    made, plant = make_station("AUTO")
    made._identified(Identity({2: "urn:plant"}, {key: "ns=2;s=c"}))
    modes: list[Mode] = []

    def seen(_: Sample | None, command: Command) -> None:
        modes.append(command.mode)
        if made.scans == 3:
            other.release()
            assert made.loop is not None
            made.loop.set_mode(Mode.AUTO)

    made.watch(seen)
    made.run(5)
    assert modes == [Mode.SHADOW] * 3 + [Mode.AUTO] * 2
    assert len(plant.written) == 2
    alarms = [line for line in events(made) if "ns=2;s=c at opc.tcp://127.0.0.1:1 is written by another loop" in line]
    assert alarms
    assert namespaces_before(made.settings.journal.file, made.settings.server.endpoint) == {2: "urn:plant"}


@pytest.mark.parametrize("unproven", ["", "not proven: it locked up in 2 closed loops"])
def test_auto_by_the_plants_own_node_is_journalled_with_what_was_accepted(
    unproven: str, make_station: Callable[..., tuple[Station, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, _ = make_station("MANUAL", accept_unproven=True)
    monkeypatch.setattr(plant_side, "require_proven", lambda loop, accepted: unproven)
    loop: Any = SimpleNamespace(set_mode=lambda mode: None)
    made.plant_side.carried_out(lambda: made.plant_side.set_mode(loop, Mode.AUTO), "mode AUTO")
    made.plant_side.carried_out(lambda: made.plant_side.set_mode(loop, Mode.MANUAL), "mode MANUAL")
    made.journal.close()
    with closing(JournalReader(made.settings.journal.file)) as reader:
        found = [(e.what, e.reason) for _, e in reader.events()]
    assert found == [("mode AUTO", f"accepted though {unproven}" if unproven else ""), ("mode MANUAL", "")]
