"""Everything that goes wrong between a loop and its plant, in a world of its own time: how soon it holds and goes on.

``pytest tests/serving/test_world_faults.py -s`` prints the table. ``test_plant_faults.py`` does some of it, and
what only a real server can do, with one.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from asyncua import ua
from plant_servers import PID
from world.invariants import Judge
from world.plant_server import PlantServer
from world.stations import RECOVER_AFTER, ScanSeen, Side
from world.virtual_time import VirtualTime

from loopwright.serving import Mode
from loopwright.serving.mv_readback import SAME_READ_BACK
from loopwright.serving.trust import Controller

ONE_PLANT_S = (0.0005, 0.005)  # one way of a message in a plant's own network
HELD = 40  # periods that a fault lasts
SOON = 6  # periods until HOLD: three for a watchdog, and answers that are waited for
GOES_ON = RECOVER_AFTER + 3  # periods from the end of a fault until AUTO where the connection stands
CLOCK_SET = 6  # scans in HOLD that a clock costs which is set
RECONNECTS_S = 10.0 * 1.6 + 5.0  # where it has to be made anew: the longest pause and a try


@dataclass
class Running:
    """A loop in AUTO on a plant of its own."""

    side: Side
    time: VirtualTime
    server: PlantServer
    judge: Judge

    @property
    def period_s(self) -> float:
        return self.server.manifest.period_s

    def periods(self, n: float) -> list[ScanSeen]:
        """The scans of so many periods."""
        self.judge.look()
        self.time.pass_until(self.time.now_s + n * self.period_s)
        return list(self.side.scans)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    time, controller = VirtualTime(), Controller(PID)
    server = PlantServer(controller.manifest, time, random.Random(5), takes_s=ONE_PLANT_S)
    side = Side("a", time, server, controller, tmp_path / "a", "AUTO", watchdog=True)
    side.begin()
    made = Running(side, time, server, Judge([side], server))
    assert [s.command.mode for s in made.periods(50)][-8:] == [Mode.AUTO] * 8
    yield made
    side.station.end()
    made.periods(100)
    assert side.rows() == side.scanned  # every scan is in the journal
    time.close()


Act = Callable[[PlantServer], object]


def shows(name: str, value: object) -> tuple[Act, Act]:
    return (lambda s: setattr(s.items[name], "shown", value)), (lambda s: setattr(s.items[name], "shown", None))


def rated(name: str, status: int) -> tuple[Act, Act]:
    good = ua.StatusCodes.Good
    return (lambda s: setattr(s.items[name], "status", status)), (lambda s: setattr(s.items[name], "status", good))


def stands(name: str) -> tuple[Act, Act]:
    return (
        lambda s: setattr(s.items[name], "stands_s", s.time.now_s),
        lambda s: setattr(s.items[name], "stands_s", None),
    )


def lacks(name: str) -> tuple[Act, Act]:
    return (lambda s: s.deleted.add(name)), (lambda s: s.deleted.discard(name))


def network(name: str) -> tuple[Act, Act]:
    return (lambda s: setattr(s.network, name, np.inf)), (lambda s: setattr(s.network, name, -np.inf))


def gone(server: PlantServer) -> None:
    network("refused_until_s")[0](server)
    server.start_anew()


def slow(server: PlantServer) -> None:
    server.takes_s = (3 * server.manifest.period_s, 4 * server.manifest.period_s)


def quick(server: PlantServer) -> None:
    server.takes_s = ONE_PLANT_S


FAULTS: dict[str, tuple[tuple[Act, Act], str]] = {
    "bad quality": (rated("C_A", ua.StatusCodes.BadSensorFailure), "PV C_A: BadSensorFailure"),
    "uncertain quality": (rated("T", ua.StatusCodes.UncertainSensorNotAccurate), "PV T: UncertainSensorNotAccurate"),
    "a text instead of a number": (shows("C_A", "high"), "PV C_A: str instead of a number"),
    "not a number": (shows("C_A", float("nan")), "PV C_A: nan"),
    "a value far beyond its range": (shows("T", 1e4), "PV T is 10000"),
    "a value that stands still": (stands("C_A"), "the sample of PV C_A is"),
    "a node that is deleted": (lacks("T"), "PV T: BadNodeIdUnknown"),
    "an MV node that is deleted": (lacks("T_j"), "T_j: BadNodeIdUnknown"),
    "an MV that reads back badly": (rated("T_j", ua.StatusCodes.BadSensorFailure), "MV T_j: BadSensorFailure"),
    "a watchdog that stands": (stands("watchdog"), "the plant's watchdog has stood at"),
    "MVs that are refused": (
        ((lambda s: setattr(s, "refuses", True)), (lambda s: setattr(s, "refuses", False))),
        "the server refuses T_j: BadNotWritable",
    ),
    "slow answers": ((slow, quick), "does not answer within"),
    "half-open connection": (network("silent_until_s"), "does not answer within"),
    "server gone": ((gone, network("refused_until_s")[1]), "BadSessionIdInvalid"),
}  # fmt: skip
ANEW = {"slow answers", "half-open connection", "server gone", "an MV node that is deleted"}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_holds_and_is_recovered_from(name: str, running: Running, capsys: pytest.CaptureFixture[str]) -> None:
    (begin, end), words = FAULTS[name]
    begin(running.server)
    scans = running.periods(HELD)
    modes = [s.command.mode for s in scans]
    until_hold = modes.index(Mode.HOLD)
    fault = scans[until_hold].command.fault
    assert words in fault
    # A write that is refused is tried again after good samples, and AUTO would come back without it.
    at = [s.command.mv for s in scans[until_hold:] if s.command.writes]
    assert set(modes[until_hold:]) <= {Mode.HOLD, Mode.AUTO}
    assert not at or np.ptp(np.array(at), axis=0).max() <= SAME_READ_BACK * 500 or name == "MVs that are refused"
    end(running.server)
    anew = RECONNECTS_S / running.period_s if name in ANEW else 0
    after = [s.command.mode for s in running.periods(GOES_ON + anew + 8)]
    until_auto = len(after) - next(i for i, mode in enumerate([*reversed(after), Mode.HOLD]) if mode is not Mode.AUTO)
    with capsys.disabled():
        print(f"\n{name:28} HOLD after {until_hold:2} periods, AUTO {until_auto:3} after its end: {fault}")
    assert until_hold <= SOON
    assert until_auto <= GOES_ON + anew
    running.judge.look()
    assert running.judge.broken == []  # no MV that the loop did not command just then


def test_a_servers_clock_may_be_an_hour_off_and_may_be_set(
    running: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ages are judged by how source times advance: an offset is none, and a clock that is set costs a few scans."""
    for offset_s in (-3600.0, 3600.0, 0.0, 0.4, 0.0):
        running.server.stamp_by_s = offset_s
        held = [s.command.mode is Mode.HOLD for s in running.periods(60)]
        with capsys.disabled():
            print(f"\nserver's clock {offset_s:+.1f} s beside ours: {sum(held)} scans in HOLD")
        assert sum(held) <= CLOCK_SET
        assert not any(held[-30:])
