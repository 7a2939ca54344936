"""Two loops on two machines that would write one MV: one writes, the other says who does."""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest
from asyncua import Client
from plant_servers import CASE, SPACE, Plant, RunningLoop, loop_toml
from processes import within

from loopwright.pipeline.__main__ import main
from loopwright.serving import Mode
from loopwright.serving.errors import LoopError
from loopwright.serving.opcua.nameplates import Identity
from loopwright.serving.opcua.node_lease import SCANS, NodeLease
from loopwright.serving.station.control import Control, ask, door
from loopwright.serving.station.housekeeping import PeriodicTask
from loopwright.serving.station.machine import Machine
from loopwright.serving.station.mv_lock import Lease, Locks, address_of

SPEED = 2.0  # periods of .25 s: a loop counts as gone after five without a renewal
LEASE = f'lease = "{SPACE}Control.Lease"'
PATIENT = "[guards]\nmax_age_s = 5"


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), CASE, SPEED)
    made.start()
    yield made
    made.end()


def machine(folder: Path, plant: Plant, start: str, nodes: str = LEASE, **parts: Any) -> RunningLoop:
    """A loop that another one finds by the node alone: its file locks lie in a folder of its own."""
    folder.mkdir(mode=0o700)
    made = loop_toml(folder, plant.endpoint, speed=SPEED, start=start, nodes=nodes, more=PATIENT)
    return RunningLoop(made, Machine(locks=folder, **parts))


def lease(plant: Plant, text: str | None = None) -> Any:
    """What the node holds; or write there."""

    async def act() -> Any:
        async with Client(plant.endpoint) as client:
            index = await client.get_namespace_index("urn:loopwright:plant")
            node = client.get_node(f"ns={index};s=Control.Lease")
            return await node.read_value() if text is None else await node.write_value(text)

    with ThreadPoolExecutor(1) as apart:
        return apart.submit(asyncio.run, act()).result()


def mode(loop: RunningLoop) -> tuple[Mode, str]:
    assert loop.station.snapshot is not None
    return loop.station.snapshot.command.mode, loop.station.snapshot.command.fault


def test_the_second_loop_holds_until_the_first_is_gone(plant: Plant, tmp_path: Path) -> None:
    """Neither is told of a lease: both find the plant's own."""
    first = machine(tmp_path / "a", plant, "AUTO", nodes="")
    assert within(20, lambda: first.station.endpoint.sender.lease.held and mode(first)[0] is Mode.AUTO)
    second = machine(tmp_path / "b", plant, "SHADOW", nodes="")
    try:
        # A shadow beside it needs no lease and takes none.
        assert within(10, lambda: second.station.scans > 10)
        owner = first.station.endpoint.sender.lease.owner
        assert within(20, lambda: lease(plant).startswith(owner))  # one that lost the plant for a moment takes it anew
        second.does("mode", "AUTO")
        refused = f"the plant is controlled by {owner}"
        assert within(20, lambda: any(refused in c.fault and c.mode is Mode.HOLD for c in second.commands))
        before = len(plant.actuator())
        assert within(20, lambda: len(plant.actuator()) > before + 10)
        assert not second.station.endpoint.sender.lease.held
        assert within(20, lambda: mode(first)[0] is Mode.AUTO)  # a busy machine may hold it for a moment
        first.end()
        assert within(30, lambda: second.station.endpoint.sender.lease.held and mode(second)[0] is Mode.AUTO)
        second.does("mode", "SHADOW")
        assert within(20, lambda: lease(plant) == "")
    finally:
        first.station.end()
        second.end()


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ("Lease", "Lease", ""),
        ("Control.Lease", "Control.NoLease", "its quality is BadNodeIdUnknown; the server has no node"),
        ("Control.Lease", "PV.T", "its type Double holds no text; it must be a String"),
        (
            "[nodes]",
            '[nodes]\nwatchdog = "nsu=urn:loopwright:plant;s=NoDog"',
            "watchdog: its quality is BadNodeIdUnknown",
        ),
    ],
)
def test_a_check_tells_of_a_lease_or_a_watchdog_that_would_stop_the_loop(
    plant: Plant, tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, wrong: str
) -> None:
    path = loop_toml(tmp_path, plant.endpoint, speed=SPEED, nodes=LEASE, more=PATIENT)
    path.write_text(path.read_text().replace(old, new))
    lease(plant, "")
    assert main(["loop", "check", str(path)]) == (2 if wrong else 0)
    said = capsys.readouterr()
    assert "lease, written" in said.out
    assert wrong in said.err
    assert ("nothing would stop the loop" in said.out) is (not wrong)


@pytest.mark.parametrize(
    ("nodes", "row", "note"),
    [("", f"lease, written  {SPACE}Control.Lease", False), ('lease = "none"', "lease -", False)],  # asked for
)
def test_check_finds_the_lease_beside_the_mvs(
    plant: Plant, tmp_path: Path, capsys: pytest.CaptureFixture[str], nodes: str, row: str, note: bool
) -> None:
    lease(plant, "")
    assert main(["loop", "check", str(loop_toml(tmp_path, plant.endpoint, speed=SPEED, nodes=nodes))]) == 0
    said = capsys.readouterr().out
    assert any(line.split()[: len(row.split())] == row.split() for line in said.splitlines())
    assert ("note: lease: there is none" in said) is note


def test_a_lease_of_a_loop_that_was_killed_is_taken_over(plant: Plant, tmp_path: Path) -> None:
    lease(plant, "elsewhere:17:abc 41")
    loop = machine(tmp_path / "a", plant, "AUTO")
    try:
        assert within(30, lambda: loop.station.endpoint.sender.lease.held and mode(loop)[0] is Mode.AUTO)
        # Somebody else takes it: the next reading finds that out, and nothing is written any more.
        lease(plant, "elsewhere:18:def 1")
        refused = "the plant is controlled by elsewhere:18:def"
        assert within(20, lambda: any(refused in c.fault and c.mode is Mode.HOLD for c in loop.commands))
    finally:
        loop.end()


def test_a_lease_is_judged_by_whether_it_moves() -> None:
    node = NodeLease(0.1)
    assert node.other == ""
    node.seen("other:1:a 1")
    assert node.other == "other:1:a"
    for k in range(20):
        node.seen(f"other:1:a {k}")
        assert node.other == "other:1:a"
    for _ in range(SCANS):
        node.seen("other:1:a 19")
    assert node.other == ""
    node.held = True
    node.seen(f"{node.owner} 3")
    assert node.held
    node.seen("other:1:b 1")
    assert not node.held


def test_a_fast_loop_waits_as_long_as_a_slow_one_needs() -> None:
    """At 0.1 s beside a loop of 10 s, which renews once in a hundred readings."""
    node = NodeLease(0.1)
    for k in range(1_000):
        node.seen(f"slow:1:a 10 {k // 100}")
        assert node.other == "slow:1:a"
    for _ in range(SCANS * 100):
        node.seen("slow:1:a 10 9")
    assert node.other == ""
    for wrong in ("slow:1:a nan 1", "slow:1:a -3 1", "slow:1:a inf 1", "slow:1:a x 1"):
        for _ in range(SCANS + 1):
            node.seen(wrong)
        assert node.other == ""


def test_a_system_without_unix_users_is_told_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delattr("os.getuid")
    with pytest.raises(LoopError, match="runs on Linux and macOS; on Windows run it in WSL"):
        Lease("opc.tcp://plant", ["ns=2;s=MV.u"], tmp_path / "locks")
    assert not (tmp_path / "locks").exists()


def test_locks_are_kept_from_those_who_clean_temporary_folders(tmp_path: Path) -> None:
    nodes, folder = ["ns=2;s=MV.u", "ns=2;s=MV.v"], tmp_path / "locks"
    lease = Lease("opc.tcp://127.0.0.1:4841", nodes, folder)
    for path in folder.iterdir():
        os.utime(path, (0, 0))
    lease.tend()
    assert all(time.time() - path.stat().st_mtime < 600 for path in folder.iterdir())
    shutil.rmtree(folder)
    lease.tend()
    with pytest.raises(LoopError, match=rf"is written by another loop \(process {os.getpid()}\)"):
        Lease("opc.tcp://127.0.0.1:4841", nodes[1:], folder)
    # A second loop that came while the file was gone has the node: the first one says so, and keeps the other node.
    next(path for path in folder.iterdir() if path == lease._path(nodes[0])).unlink()
    other = Lease("opc.tcp://127.0.0.1:4841", nodes[:1], folder)
    os.utime(lease._path(nodes[1]), (0, 0))
    assert lease.lost == ""
    with pytest.raises(LoopError, match=r"MV.u at .* is written by another loop"):
        lease.tend()
    assert "MV.u at opc.tcp://127.0.0.1:4841 is written by another loop" in lease.lost
    assert time.time() - lease._path(nodes[1]).stat().st_mtime < 600
    other.release()
    lease.tend()
    assert lease.lost == ""
    lease.release()
    Lease("opc.tcp://127.0.0.1:4841", nodes, folder).release()


def test_a_loops_door_is_opened_anew_where_its_socket_was_removed(tmp_path: Path) -> None:
    journal = tmp_path / "loop.journal"
    control = Control(journal, lambda request: {"done": request["do"]})
    try:
        os.utime(control.path, (0, 0))
        control.tend()
        assert time.time() - control.path.stat().st_mtime < 600
        control.path.unlink()
        with pytest.raises(LoopError, match="no loop runs with this journal"):
            ask(journal, {"do": "state"})
        control.tend()
        assert ask(journal, {"do": "state"}) == {"done": "state"}
    finally:
        control.close()
    assert not control.path.exists()


def test_tending_goes_on_whatever_it_meets() -> None:
    said, calls = list[str](), list[int]()

    def act() -> None:
        calls.append(1)
        if len(calls) in {2, 3}:
            raise LoopError("another loop has it")

    tending = PeriodicTask(act, said.append, every_s=0.001)
    assert within(20, lambda: len(calls) > 5)
    tending.close()
    assert said == ["another loop has it", ""]


def test_a_station_tends_its_locks_and_its_door(plant: Plant, tmp_path: Path) -> None:
    loop = machine(tmp_path / "a", plant, "SHADOW", tended=partial(PeriodicTask, every_s=0.05))
    folder, journal = tmp_path / "a", loop.settings.journal.file
    try:
        locks = [path for path in folder.iterdir() if len(path.name) == 32]
        assert len(locks) == 1  # of the MV as it is spelt; a shadow leaves the others to the loop that writes
        for lock in locks:
            lock.unlink()
        door(journal).unlink()
        assert within(20, lambda: all(lock.exists() for lock in locks) and door(journal).exists())
        assert ask(journal, {"do": "state"})["mode"] == "SHADOW"
    finally:
        loop.end()


def test_a_loop_that_learns_that_another_one_has_its_lock_writes_no_more(plant: Plant, tmp_path: Path) -> None:
    gone = Event()

    def tending(act: Callable[[], None], trouble: Callable[[str], None]) -> PeriodicTask:
        return PeriodicTask(lambda: act() if gone.is_set() else None, trouble, every_s=0.05)

    loop = machine(tmp_path / "a", plant, "AUTO", tended=tending)
    node = loop.settings.nodes.points("mv")["T_j"].node
    try:
        assert within(20, lambda: mode(loop)[0] is Mode.AUTO)
        loop.station.lease._path(node).unlink()
        other = Lease(plant.endpoint, [node], tmp_path / "a")
        gone.set()
        assert within(20, lambda: mode(loop)[0] is Mode.SHADOW)
        loop.does("mode", "AUTO")
        scans = loop.station.scans
        assert within(20, lambda: loop.station.scans > scans + 5)
        assert mode(loop)[0] is Mode.SHADOW
        assert within(20, lambda: "change loop: mode AUTO -> SHADOW" in loop.events())
        events = loop.events()
        assert any(e.startswith("fault loop: ") and "is written by another loop" in e for e in events)
        other.release()
        loop.does("mode", "AUTO")
        assert within(20, lambda: mode(loop)[0] is Mode.AUTO)
        assert within(20, lambda: "fault loop: over: the locks of this loop are kept again" in loop.events())
    finally:
        loop.end()


def test_another_spelling_of_the_host_is_the_same_plant(tmp_path: Path) -> None:
    nodes = ["ns=2;s=MV.u"]
    one = Lease("opc.tcp://127.0.0.1:4841", nodes, tmp_path / "locks")
    spelt = ("localhost", "[::1]", "0.0.0.0", "[::]", "[::ffff:127.0.0.1]", "[::ffff:0.0.0.0]", socket.gethostname())
    for same in (*(f"opc.tcp://{host}:4841" for host in spelt), "opc.tcp://[::1]:4841/path"):
        with pytest.raises(LoopError, match="is written by another loop"):
            Lease(same, nodes, tmp_path / "locks")
    other = Lease("opc.tcp://localhost:4842", nodes, tmp_path / "locks")
    for lease in (one, other):
        lease.release()
    assert address_of("opc.tcp://no.such.host.invalid") == "no.such.host.invalid:4840"


def test_another_spelling_of_the_node_is_the_same_mv_once_the_server_is_known(tmp_path: Path) -> None:
    """Both are content before they are connected; the second one learns then that the MV is taken."""
    folder, key = tmp_path / "locks", "urn:server 1.0 nsu=urn:plant;s=MV.u"
    one = Lease("opc.tcp://127.0.0.1:4841", ["ns=2;s=MV.u"], folder)
    two = Lease("opc.tcp://plant.invalid:4841", ["nsu=urn:plant;s=MV.u"], folder)
    one.claim({key: "ns=2;s=MV.u"})
    one.claim({key: "ns=2;s=MV.u"})  # a connection that is made anew
    two.claim({key: "nsu=urn:plant;s=MV.u"})
    assert one.lost == ""
    assert two.lost.startswith("nsu=urn:plant;s=MV.u at opc.tcp://plant.invalid:4841 is written by another loop")
    with pytest.raises(LoopError):
        two.tend()
    one.claim({"another start of the server": "ns=2;s=MV.u"})
    two.tend()
    assert two.lost == ""
    one.claim({key: "ns=2;s=MV.u"})
    assert one.lost
    for lease in (one, two):
        lease.release()


NODE = "nsu=urn:plant;s=MV.u"


def known(start: float, *nodes: str) -> tuple[dict[str, str], dict[str, str]]:
    """What a loop claims at a server that started then."""
    return {f"urn:server {start} {n}": n for n in nodes}, {n: n for n in nodes}


def test_the_loop_that_writes_keeps_its_mv_when_the_server_starts_anew(tmp_path: Path) -> None:
    """All lock its nodes anew then: a loop that wrote nothing came first, and the one that wrote went to SHADOW."""
    folder, at = tmp_path / "locks", "opc.tcp://127.0.0.1:4841"
    writes, waits = Lease(at, ["ns=2;s=MV.u"], folder), Lease(at, [NODE], folder)
    writes.claim(*known(1.0, NODE))
    waits.claim(*known(1.0, NODE))
    assert waits.lost
    waits.disclaim()
    assert waits.lost
    waits.claim(*known(2.0, NODE))  # somebody even asks it to write before the other is back
    assert waits.lost
    assert [key for key in waits._held if key != NODE] == []
    waits.disclaim()
    writes.claim(*known(2.0, NODE))
    assert writes.lost == ""
    writes.disclaim()
    waits.tend()  # it only looks: the other one may claim again
    assert waits.lost == ""
    writes.claim(*known(2.0, NODE))
    assert writes.lost == ""
    writes.disclaim()
    waits.claim(*known(2.0, NODE))
    writes.claim(*known(2.0, NODE))
    assert (waits.lost, bool(writes.lost)) == ("", True)
    for lease in (writes, waits):
        lease.release()
    assert list(folder.iterdir()) == []


def test_of_two_loops_that_share_an_mv_one_has_all_of_its_own(tmp_path: Path) -> None:
    """Each had one MV of the other's, and neither wrote."""
    folder, at = tmp_path / "locks", "opc.tcp://127.0.0.1:4841"
    one, two = Lease(at, ["ns=2;s=a"], folder), Lease(at, ["ns=2;s=b"], folder)
    one.claim(*known(1.0, "nsu=p;s=b"))
    two.claim(*known(1.0, "nsu=p;s=a", "nsu=p;s=b"))
    assert two.lost
    three = Lease(at, ["ns=2;s=c"], folder)
    three.claim(*known(1.0, "nsu=p;s=a"))
    assert (one.lost, three.lost) == ("", "")
    for lease in (one, two, three):
        lease.release()


def test_the_alarm_of_another_loop_ends_with_that_loop(tmp_path: Path) -> None:
    """It was raised by whoever found out first, and ended by nobody."""
    folder, at, noted = tmp_path / "locks", "opc.tcp://127.0.0.1:4841", list[tuple[str, bool]]()
    recorder: Any = SimpleNamespace(
        note=lambda kind, *_, raised=False, **__: noted.append((kind, raised)) if kind == "fault" else None
    )
    loop: Any = SimpleNamespace(mode=Mode.AUTO)
    loop.set_mode = lambda mode: setattr(loop, "mode", mode)
    other = Lease(at, ["ns=2;s=MV.u"], folder)
    other.claim(*known(1.0, NODE))
    lease = Lease(at, [NODE], folder)
    locks = Locks(lease, recorder)
    locks.identified(Identity({}, *known(1.0, NODE)), writes=True)
    for _ in range(3):
        locks.keep(loop)
        locks.tend()
    assert loop.mode is Mode.SHADOW
    assert noted == [("fault", True)]
    other.release()
    locks.keep(loop)
    locks.tend()
    assert noted == [("fault", True), ("fault", False)]
    locks.untended("PermissionError")  # of a file beside the locks
    loop.mode = Mode.AUTO
    locks.keep(loop)
    locks.tend()
    assert loop.mode is Mode.AUTO
    assert noted[2:] == [("fault", True)]
    locks.untended("")
    assert noted[3:] == [("fault", False)]
    lease.release()


def test_an_address_to_which_linux_lets_a_socket_be_bound_is_no_address_of_this_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With net.ipv4.ip_nonlocal_bind = 1 it may be bound to any: all servers of the world were one."""
    monkeypatch.setattr(socket.socket, "bind", lambda *_: None)
    assert address_of("opc.tcp://192.0.2.7:4840") == "192.0.2.7:4840"
    assert address_of("opc.tcp://127.0.0.1:4840") == "this machine:4840"
