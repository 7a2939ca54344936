"""A loop on a real OPC UA server, and everything that goes wrong between them.

``pytest tests/serving/test_plant_faults.py -s`` prints for each fault how many periods it took until HOLD and, once it
was over, until AUTO.
"""

from __future__ import annotations

import asyncio
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua
from plant_servers import CASE, PID, ROOT, SPACE, Plant, RunningLoop, Wire, loop_toml
from processes import within

from serving import Controller, Mode
from serving.journal import Scan
from serving.opcua.certificates import make
from serving.opcua.settings import HandBack, ModeNode
from serving.standing import SAME
from serving.station.settings import Hold, Settings

SPEED = 2.5  # 0.5 s periods in 0.2 s
PERIOD_S = 0.5 / SPEED
RECOVER = 3
START = 250.0  # the MV of the plant's start


def begun(folder: Path, port: int, **changed: Any) -> RunningLoop:
    """A loop whose settings are ``changed``."""
    watched = f'heartbeat = "{SPACE}Control.Heartbeat"\nwatchdog = "{SPACE}Control.Watchdog"'
    settings = Settings.read(loop_toml(folder, f"opc.tcp://127.0.0.1:{port}", speed=SPEED, nodes=watched))
    nodes = replace(settings.nodes, **changed.pop("nodes", {}))
    server = replace(settings.server, connect_s=2.0, **changed.pop("server", {}))
    hold = changed.pop("hold", Hold(recover_after=RECOVER))
    return RunningLoop(replace(settings, nodes=nodes, server=server, hold=hold, **changed))


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), CASE, SPEED)
    made.start()
    yield made
    made.end()


def write(plant: Plant, tag: str, value: Any, kind: ua.VariantType | None = None) -> None:
    """As another client would."""

    async def act() -> None:
        async with Client(plant.endpoint) as client:
            index = await client.get_namespace_index("urn:loopwright:plant")
            await client.get_node(f"ns={index};s={tag}").write_value(ua.Variant(value, kind))

    asyncio.run(act())


def read(plant: Plant, tag: str) -> Any:
    async def act() -> Any:
        async with Client(plant.endpoint) as client:
            index = await client.get_namespace_index("urn:loopwright:plant")
            return await client.get_node(f"ns={index};s={tag}").read_value()

    return asyncio.run(act())


Fault = tuple[Callable[[Plant, Wire], None], Callable[[Plant, Wire], None]]


def faulty(tag: str, fault: str) -> Fault:
    return (lambda p, w: write(p, f"Faults.{tag}", fault)), (lambda p, w: write(p, f"Faults.{tag}", ""))


def slow(plant: Plant, wire: Wire) -> None:
    wire.delay_s = 2 * PERIOD_S


def fast(plant: Plant, wire: Wire) -> None:
    wire.delay_s = 0.0


def cut(plant: Plant, wire: Wire) -> None:
    wire.cut = True


def mend(plant: Plant, wire: Wire) -> None:
    wire.cut = False


FAULTS: dict[str, tuple[Fault, str]] = {
    "bad quality": (faulty("PV.C_A", "bad"), "PV C_A: BadSensorFailure"),
    "uncertain quality": (faulty("PV.T", "uncertain"), "PV T: UncertainSensorNotAccurate"),
    "a text instead of a number": (faulty("PV.C_A", "text"), "PV C_A: str instead of a number"),
    "not a number": (faulty("PV.C_A", "nan"), "PV C_A: nan: the sensor gives no number"),
    "a value that stands still": (faulty("PV.C_A", "frozen"), "the sample of PV C_A is"),
    "a node that is deleted": (faulty("PV.T", "deleted"), "PV T: BadNodeIdUnknown"),
    "an MV node that is deleted": (faulty("MV.T_j", "deleted"), "the server refuses T_j: Bad"),
    "a watchdog that stands": (faulty("Control.Watchdog", "frozen"), "the plant's watchdog has stood at"),
    "slow answers": ((slow, fast), "does not answer within"),
    "half-open connection": ((cut, mend), "does not answer within"),
    "server frozen": (
        (lambda p, w: p.send(signal.SIGSTOP), lambda p, w: p.send(signal.SIGCONT)), "does not answer within",
    ),
    "server killed": ((lambda p, w: p.end(), lambda p, w: p.start()), "opc.tcp"),
}  # fmt: skip


CONNECTED = 40  # periods from the end of a fault until AUTO where the connection stands; a busy machine has its share
RECONNECTED = 200  # where it has to be made anew: pauses between two tries grow to 50 periods, and a try takes up to 10
CUT = {"slow answers", "half-open connection", "server frozen", "server killed"}
ANEW = {"server killed", "an MV node that is deleted"}  # then the MV's node is made anew


@pytest.fixture
def wire(plant: Plant) -> Iterator[Wire]:
    made = Wire(plant.port)
    yield made
    made.close()


def show(capsys: pytest.CaptureFixture[str], name: str, until_hold: int, until_auto: int, reason: str) -> None:
    """A row of the table of faults."""
    with capsys.disabled():
        print(f"\n{name:28} HOLD after {until_hold:2} periods, AUTO {until_auto:3} after its end: {reason}")


def in_flight(found: list[Scan]) -> set[float]:
    """The MVs of the last scans before each HOLD."""
    mv = 1 + 2  # behind sp and pv
    falls = [i for i in range(2, len(found)) if found[i].mode == "HOLD" != found[i - 1].mode]
    return {found[j].numbers[mv] for i in falls for j in (i - 2, i - 1)}


def legal(found: list[Scan], plant: Plant, since: int, besides: set[float]) -> None:
    """What the MV node held since then, period by period: in range, and changed by nothing but fresh commands.

    A value that is new there was commanded within the last periods. While the loop holds, the node stands still. What
    a server itself may do ``besides``: show START in a node that it made anew, or carry out, when it wakes up, what had
    reached it before it froze.
    """
    mv = 1 + 2  # behind sp and pv
    commands = [(s.time_s, s.numbers[mv]) for s in found]
    rows = plant.actuator()[since - 1 :]
    for before, row in pairwise(rows):
        (asked,) = row["asked"]
        assert 0 <= asked <= 500
        fresh = {v for t, v in commands if row["time"] - 6 * PERIOD_S <= t <= row["time"] + PERIOD_S}
        assert asked in {before["asked"][0], *fresh, *besides}, (row, fresh)
    for mode, group in groupby(found, key=lambda s: s.mode):
        times = [s.time_s for s in group][6:]  # what was on its way has arrived, or never will
        if mode == "HOLD" and times:
            stood = {row["asked"][0] for row in rows if times[0] <= row["time"] <= times[-1]} - besides
            assert not stood or max(stood) - min(stood) <= SAME * 500, stood


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_holds_and_is_recovered_from(
    name: str, plant: Plant, wire: Wire, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (begin, end), words = FAULTS[name]
    before = len(plant.actuator())
    assert within(20, lambda: len(plant.actuator()) > before + 1)  # the last command of the loop before has arrived
    since = len(plant.actuator())
    running = begun(tmp_path, wire.port)
    assert running.ask(lambda loop: loop.set_sp([0.93]), "set point") == ""
    running.becomes(Mode.AUTO, scans=8)
    begin(plant, wire)
    until_hold = running.becomes(Mode.HOLD, 10)
    reason = running.commands[-1].reason
    running.becomes(Mode.HOLD, scans=10)
    reasons = {c.reason for c in running.commands if c.mode is Mode.HOLD}
    held = {tuple(c.mv.tolist()) for c in running.commands[-8:]}
    end(plant, wire)
    until_auto = running.becomes(Mode.AUTO, 60)
    running.becomes(Mode.AUTO, scans=5)
    n = len(running.commands)
    running.end()
    found = running.scans()
    assert any(words in r for r in reasons), reasons
    assert len(held) == 1
    besides = {"server frozen": in_flight(found)}.get(name, {START} if name in ANEW else set())
    legal(found, plant, since, besides)
    assert n <= len(found) <= n + 3  # every scan is in the journal
    show(capsys, name, until_hold, until_auto, reason)
    assert until_hold <= 5
    assert until_auto <= (RECONNECTED if name in CUT else CONNECTED)


def test_a_plant_whose_watchdog_stands_is_held_within_three_periods(plant: Plant, wire: Wire, tmp_path: Path) -> None:
    """Its values go on, with new source times: nothing else would tell."""
    running = begun(tmp_path, wire.port)
    try:
        running.becomes(Mode.AUTO, 120, scans=8)
        write(plant, "Faults.Control.Watchdog", "frozen")
        stood = read(plant, "Control.Watchdog")
        reason = f"the plant's watchdog has stood at {stood} for 3 scans"  # the first that is said: not for 4
        assert within(30, lambda: any(c.reason == reason and c.mode is Mode.HOLD for c in running.commands))
        running.becomes(Mode.HOLD, scans=10)
        write(plant, "Faults.Control.Watchdog", "")
        running.becomes(Mode.AUTO, 60)
    finally:
        write(plant, "Faults.Control.Watchdog", "")
        running.end()


LEARNT_WITHIN = 3  # of the loop's own periods: so soon a plant knows that its loop is gone


def test_a_plant_learns_within_three_periods_that_its_loop_was_killed(plant: Plant, tmp_path: Path) -> None:
    """By the server's own count of periods: a busy machine changes nothing about that."""
    served_period_s = PERIOD_S * SPEED  # of the plant's own time
    beats_at = f'heartbeat = "{SPACE}Control.Heartbeat"'
    path = loop_toml(tmp_path, plant.endpoint, speed=SPEED, nodes=beats_at)
    since = len(plant.actuator())
    command = [sys.executable, "-m", "pipeline", "loop", "run", str(path)]
    with (tmp_path / "said").open("w") as said:
        loop = subprocess.Popen(command, cwd=ROOT, stdout=said, stderr=said)
    try:

        def beats() -> int:
            rows = plant.actuator()[since:]
            return sum(a["beat"] != b["beat"] and b["alive"] for a, b in pairwise(rows))

        assert within(120, lambda: beats() > 10), (tmp_path / "said").read_text()
    finally:
        loop.kill()
        loop.wait()
    killed = len(plant.actuator())
    assert within(60, lambda: len(plant.actuator()) > killed + 10)
    rows = plant.actuator()
    last = max(i for i in range(since + 1, len(rows)) if rows[i]["beat"] != rows[i - 1]["beat"])
    assert last <= killed + 1
    learnt = next(i for i in range(last, len(rows)) if not rows[i]["alive"])
    silent_s = (rows[learnt]["k"] - rows[last]["k"]) * served_period_s
    assert 0 < silent_s <= LEARNT_WITHIN * Controller(PID).manifest.period_s
    assert not any(row["alive"] for row in rows[learnt:])
    assert read(plant, "Control.LoopAlive") is False
    assert len({row["asked"][0] for row in rows[learnt:]}) == 1  # the actuator keeps what it has


def test_an_mv_node_of_another_type_is_written_in_that_type(plant: Plant, wire: Wire, tmp_path: Path) -> None:
    """The server refuses, the loop holds and asks for the types anew, and goes on by itself."""
    running = begun(tmp_path, wire.port)
    running.becomes(Mode.AUTO, scans=8)
    for kind in ("int", ""):
        before = len(running.commands)
        write(plant, "Faults.MV.T_j", kind)
        assert within(20, lambda: any("BadTypeMismatch" in c.reason for c in running.commands[before:]))  # noqa: B023
        running.becomes(Mode.AUTO, scans=8)
        asked = [row["asked"][0] for row in plant.actuator()[-3:]]
        assert all((value == round(value)) is (kind == "int") for value in asked)
    running.end()


def test_the_plants_own_operator_sets_mode_and_set_point(plant: Plant, wire: Wire, tmp_path: Path) -> None:
    write(plant, "Control.Mode", 1, ua.VariantType.Int32)  # from before; no wish of now
    mode = ModeNode(f"{SPACE}Control.Mode", {"MANUAL": 0, "AUTO": 1, "SHADOW": 2})
    running = begun(tmp_path, wire.port, start="SHADOW", nodes={"mode": mode, "sp": {"C_A": f"{SPACE}SP.C_A"}})
    running.becomes(Mode.SHADOW, scans=6)
    write(plant, "Control.Mode", 0, ua.VariantType.Int32)
    running.becomes(Mode.MANUAL)
    write(plant, "Control.Mode", 1, ua.VariantType.Int32)
    running.becomes(Mode.AUTO)
    write(plant, "SP.C_A", 0.9)
    assert within(20, lambda: running.commands[-1].sp.tolist() == [0.9])
    write(plant, "SP.C_A", 1.7)
    assert within(20, lambda: any("refused: set point C_A 1.7" in line for line in running.told))
    assert running.commands[-1].sp.tolist() == [0.9]
    running.end()


@pytest.fixture
def strict(tmp_path: Path) -> Iterator[Plant]:
    """A plant whose server takes only clients that it trusts: the loop is one of them."""
    folder = tmp_path / "strict"
    folder.mkdir()
    make(tmp_path / "loop.der", tmp_path / "loop.pem")
    trusted = folder / "server" / "trusted"
    trusted.mkdir(parents=True)
    shutil.copy(tmp_path / "loop.der", trusted)
    made = Plant(folder, CASE, SPEED, "--only-trusted")
    made.start()
    yield made
    made.end()


def test_a_loop_whose_certificate_is_rejected_holds_until_it_is_trusted_again(
    strict: Plant, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The server is started anew with a trust list that lacks the loop's certificate, and then with one that has it."""
    trusted, own = strict.folder / "server" / "trusted" / "loop.der", tmp_path / "loop.der"
    secured = {"security": "Basic256Sha256", "certificate": own, "private_key": tmp_path / "loop.pem"}
    since = len(strict.actuator())
    running = begun(tmp_path, strict.port, server=secured)
    assert running.ask(lambda loop: loop.set_sp([0.93]), "set point") == ""
    running.becomes(Mode.AUTO, 120, scans=8)
    strict.end()
    until_hold = running.becomes(Mode.HOLD, 10)
    trusted.unlink()
    strict.start()
    rejected = f"let the server trust {own}"
    assert within(60, lambda: rejected in running.commands[-1].reason), running.told
    running.becomes(Mode.HOLD, scans=10)
    reason = running.commands[-1].reason
    held = {tuple(c.mv.tolist()) for c in running.commands[-8:]}
    asked = {row["asked"][0] for row in strict.actuator()[-3:]}
    strict.end()
    shutil.copy(own, trusted)
    strict.start()
    until_auto = running.becomes(Mode.AUTO, 60)
    running.becomes(Mode.AUTO, scans=5)
    n = len(running.commands)
    running.end()
    found = running.scans()
    assert len(held) == 1
    assert asked == {START}  # the server's own start: nobody has written there
    legal(found, strict, since, {START})
    assert n <= len(found) <= n + 3
    show(capsys, "certificate rejected", until_hold, until_auto, reason)
    assert until_hold <= 5
    assert until_auto <= RECONNECTED


def told(running: RunningLoop, words: str) -> list[str]:
    return [line for line in running.told if words in line]


def test_what_a_plant_shows_that_started_anew_is_no_wish_until_it_changes(tmp_path: Path) -> None:
    """Its set point and its mode are defaults then; after a mere outage of the network a new value is a wish."""
    plant = Plant(tmp_path, CASE, SPEED)
    plant.start()
    wire = Wire(plant.port)
    mode = ModeNode(f"{SPACE}Control.Mode", {"MANUAL": 0, "AUTO": 1, "SHADOW": 2})
    try:
        write(plant, "Control.Mode", 1, ua.VariantType.Int32)
        write(plant, "SP.C_A", 0.9)
        running = begun(tmp_path, wire.port, nodes={"mode": mode, "sp": {"C_A": f"{SPACE}SP.C_A"}})
        running.becomes(Mode.AUTO, scans=8)
        assert running.commands[-1].sp.tolist() == [0.9]

        cut(plant, wire)  # the network alone
        running.becomes(Mode.HOLD, scans=6)
        write(plant, "SP.C_A", 0.85)
        wire.cut = False
        running.becomes(Mode.AUTO, scans=5)
        assert within(20, lambda: running.commands[-1].sp.tolist() == [0.85])
        assert told(running, "started anew") == []

        plant.end()
        running.becomes(Mode.HOLD, scans=6)
        plant.start()
        assert read(plant, "Control.Mode") == 2  # SHADOW, and a set point that nobody asked for
        assert read(plant, "SP.C_A") != 0.85
        running.becomes(Mode.AUTO, scans=8)
        assert running.commands[-1].sp.tolist() == [0.85]
        assert len(told(running, "no wish of its operator until they change")) == 1
        assert len(told(running, ": it has started anew")) == 1

        write(plant, "SP.C_A", 0.8)
        assert within(20, lambda: running.commands[-1].sp.tolist() == [0.8])
        write(plant, "Control.Mode", 0, ua.VariantType.Int32)
        running.becomes(Mode.MANUAL)
        running.end()
    finally:
        wire.close()
        plant.end()


@pytest.mark.parametrize("spoilt", ["", "bad"])
def test_what_the_plants_operator_set_during_an_outage_is_not_written_over(
    spoilt: str, plant: Plant, wire: Wire, tmp_path: Path
) -> None:
    """HOLD goes on from where the MV stands, also while a PV is bad; MANUAL too."""
    running = begun(tmp_path, wire.port, hold=Hold(recover_after=60))  # it holds for all that is looked at below
    running.becomes(Mode.AUTO, 120, scans=8)
    for begin, moved in ((Mode.HOLD, 311.0), (Mode.MANUAL, 287.0)):
        if begin is Mode.MANUAL:
            assert running.ask(lambda loop: loop.set_mode(Mode.MANUAL), "mode MANUAL") == ""
            running.becomes(Mode.MANUAL, scans=3)
        cut(plant, wire)
        assert within(20, lambda: "does not answer" in running.commands[-1].reason)
        running.becomes(begin, scans=6)
        assert running.commands[-1].mv[0] != moved
        write(plant, "MV.T_j", moved)
        write(plant, "Faults.PV.T", spoilt)
        n = len(running.commands)
        since = len(plant.actuator())
        mend(plant, wire)
        assert within(30, lambda: running.commands[-1].mv.tolist() == [moved])  # noqa: B023
        assert within(20, lambda: len(running.commands) > n + 20)  # noqa: B023
        write(plant, "Faults.PV.T", "")
        running.becomes(begin, scans=5)
        rows = plant.actuator()[since + 1 :]
        assert len(rows) > 10
        assert {row["asked"][0] for row in rows} == {moved}
        assert told(running, f"the MV stands at T_j {moved:g} K, not at T_j ")
    running.end()


def test_a_plant_is_handed_back_and_asked_for_again(plant: Plant, wire: Wire, tmp_path: Path) -> None:
    running = begun(
        tmp_path,
        wire.port,
        nodes={"hand_back": HandBack(f"{SPACE}Control.Owner", 0)},
        hold=Hold(recover_after=RECOVER, max_s=1.0, then="hand back"),
    )
    running.becomes(Mode.AUTO, scans=5)
    write(plant, "Faults.PV.T", "bad")
    running.becomes(Mode.SHADOW)
    assert read(plant, "Control.Owner") == 0
    write(plant, "Faults.PV.T", "")
    running.becomes(Mode.SHADOW, scans=10)  # who has the plant now decides
    write(plant, "Control.Owner", 1, ua.VariantType.Int32)
    assert running.ask(lambda loop: loop.set_mode(Mode.AUTO), "mode AUTO") == ""
    running.becomes(Mode.AUTO, scans=5)
    running.end()


def test_a_servers_clock_may_be_an_hour_off_and_may_be_set(
    plant: Plant, wire: Wire, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ages are judged by how source times advance: an offset is none, and a clock that is set costs a few scans."""
    write(plant, "Faults.Clock", -3600.0)
    before = len(plant.actuator())
    assert within(20, lambda: len(plant.actuator()) > before + 1)  # the last command of the loop before has arrived
    since = len(plant.actuator())
    try:
        running = begun(tmp_path, wire.port)
        assert running.ask(lambda loop: loop.set_sp([0.93]), "set point") == ""
        running.becomes(Mode.AUTO, 120, scans=30)
        assert {c.mode for c in running.commands[10:]} == {Mode.AUTO}
        for offset, name in ((3600.0, "clock set 2 h ahead"), (0.0, "clock set 1 h back")):
            at = len(running.commands)
            write(plant, "Faults.Clock", offset)
            assert within(20, lambda: len(running.commands) > at + 12)  # noqa: B023
            running.becomes(Mode.AUTO, scans=20)
            modes = [c.mode for c in running.commands[at:]]
            assert set(modes) <= {Mode.AUTO, Mode.HOLD}
            if Mode.HOLD not in modes:
                with capsys.disabled():
                    print(f"\n{name:28} no HOLD")
                continue
            until_hold = modes.index(Mode.HOLD)
            held = len(modes) - modes[::-1].index(Mode.HOLD) - until_hold
            show(capsys, name, until_hold, held, running.commands[at + until_hold].reason)
            assert until_hold <= 5
            assert held <= CONNECTED
        assert Mode.HOLD in modes  # of the clock that was set back
        n = len(running.commands)
        running.end()
        found = running.scans()
        legal(found, plant, since, set())
        assert n <= len(found) <= n + 3
    finally:
        write(plant, "Faults.Clock", 0.0)
