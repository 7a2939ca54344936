"""A loop on a real OPC UA server, and what goes wrong between them that only a real one shows.

``test_world_faults.py`` has the others, in a world of its own time. With ``-s`` each fault is printed with the
periods that it took until HOLD and, once it was over, until AUTO.
"""

from __future__ import annotations

import shutil
import signal
from bisect import bisect_right
from collections.abc import Callable, Iterator
from itertools import groupby, pairwise
from pathlib import Path

import pytest
from plant_servers import CASE, Plant, RunningLoop, Wire
from processes import within
from served_plant import PERIOD_S, SPEED, begun, cut, mend, read, served, wired, write  # noqa: F401

from loopwright.serving import Mode
from loopwright.serving.journal import ScanEntry
from loopwright.serving.mv_readback import SAME_READ_BACK
from loopwright.serving.opcua.certificates import make

START = 250.0  # the MV of the plant's start

Fault = tuple[Callable[[Plant, Wire], None], Callable[[Plant, Wire], None]]


def faulty(tag: str, fault: str) -> Fault:
    return (lambda p, w: write(p, f"Faults.{tag}", fault)), (lambda p, w: write(p, f"Faults.{tag}", ""))


FAULTS: dict[str, tuple[Fault, str]] = {
    "bad quality": (faulty("PV.C_A", "bad"), "PV C_A: BadSensorFailure"),
    "an MV node that is deleted": (faulty("MV.T_j", "deleted"), "the server refuses T_j: Bad"),
    "half-open connection": ((cut, mend), "does not answer within"),
    "server frozen": (
        (lambda p, w: p.send(signal.SIGSTOP), lambda p, w: p.send(signal.SIGCONT)), "does not answer within",
    ),
    "server killed": ((lambda p, w: p.end(), lambda p, w: p.start()), "opc.tcp"),
}  # fmt: skip


CONNECTED = 40  # periods from the end of a fault until AUTO where the connection stands; a busy machine has its share
RECONNECTED = 200  # where it has to be made anew: pauses between two tries grow to 50 periods, and a try takes up to 10
CUT = {"half-open connection", "server frozen", "server killed"}
ANEW = {"server killed", "an MV node that is deleted"}  # then the MV's node is made anew


def show(capsys: pytest.CaptureFixture[str], name: str, until_hold: int, until_auto: int, reason: str) -> None:
    """A row of the table of faults."""
    with capsys.disabled():
        print(f"\n{name:28} HOLD after {until_hold:2} periods, AUTO {until_auto:3} after its end: {reason}")


def in_flight(found: list[ScanEntry]) -> set[float]:
    """The MVs of the last scans before each HOLD."""
    mv = 1 + 2  # behind sp and pv
    falls = [i for i in range(2, len(found)) if found[i].mode == "HOLD" != found[i - 1].mode]
    return {found[j].numbers[mv] for i in falls for j in (i - 2, i - 1)}


def stands(running: RunningLoop) -> bool:
    """Whether the MV does while the loop holds. None is written where nothing reads back one that was lost."""
    last = running.commands[-8:]
    return all(c.mode is Mode.HOLD for c in last) and len({tuple(c.mv.tolist()) for c in last if c.writes}) <= 1


def legal(found: list[ScanEntry], plant: Plant, since: int, besides: set[float]) -> None:
    """What the MV node held since then, period by period: in range, and changed by nothing but fresh commands.

    A value that is new there was commanded within the last scans. While the loop holds, the node stands still. What
    a server itself may do ``besides``: show START in a node that it made anew, or carry out, when it wakes up, what had
    reached it before it froze.
    """
    mv = 1 + 2  # behind sp and pv
    times, values = [s.time_s for s in found], [s.numbers[mv] for s in found]
    rows = plant.actuator()[since - 1 :]
    for before, row in pairwise(rows):
        (asked,) = row["asked"]
        assert 0 <= asked <= 500
        now = bisect_right(times, row["time"])
        fresh = set(values[max(0, now - 6) : now + 1])
        assert asked in {before["asked"][0], *fresh, *besides}, (row, fresh)
    for mode, group in groupby(found, key=lambda s: s.mode):
        within_it = [s.time_s for s in group][6:]  # what was on its way has arrived, or never will
        if mode == "HOLD" and within_it:
            stood = {row["asked"][0] for row in rows if within_it[0] <= row["time"] <= within_it[-1]} - besides
            assert not stood or max(stood) - min(stood) <= SAME_READ_BACK * 500, stood


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
    begun_at = len(running.commands)
    begin(plant, wire)
    until_hold = running.becomes(Mode.HOLD, 10)
    reason = running.commands[-1].fault

    def named() -> bool:
        """A busy machine may be the reason of the first scans."""
        return any(words in c.fault for c in running.commands[begun_at:] if c.mode is Mode.HOLD)

    assert within(20, named), {c.fault for c in running.commands[begun_at:]}
    running.becomes(Mode.HOLD, scans=10)
    assert within(20, lambda: stands(running))
    end(plant, wire)
    until_auto = running.becomes(Mode.AUTO, 60)
    running.becomes(Mode.AUTO, scans=5)
    running.end()
    found = running.scans()
    besides = {"server frozen": in_flight(found)}.get(name, {START} if name in ANEW else set())
    legal(found, plant, since, besides)
    assert len(found) == len(running.commands)  # every scan is in the journal
    show(capsys, name, until_hold, until_auto, reason)
    assert until_hold <= 5
    assert until_auto <= (RECONNECTED if name in CUT else CONNECTED)


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
    assert within(60, lambda: rejected in running.commands[-1].fault), running.told
    running.becomes(Mode.HOLD, scans=10)
    reason = running.commands[-1].fault
    assert within(20, lambda: stands(running))
    asked = {row["asked"][0] for row in strict.actuator()[-3:]}
    strict.end()
    shutil.copy(own, trusted)
    strict.start()
    until_auto = running.becomes(Mode.AUTO, 60)
    running.becomes(Mode.AUTO, scans=5)
    running.end()
    found = running.scans()
    assert asked == {START}  # the server's own start: nobody has written there
    legal(found, strict, since, {START})
    assert len(found) == len(running.commands)
    show(capsys, "certificate rejected", until_hold, until_auto, reason)
    assert until_hold <= 5
    assert until_auto <= RECONNECTED
