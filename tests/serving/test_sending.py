"""What becomes of an MV that was passed on to the connection's thread, by the loop that passed it on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from asyncua import ua

from loopwright.serving import Controller, ControlLoop, EndpointError, LoopError, Mode, VirtualClock
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.opcua.settings import HandBack, Nodes, Server

pytest_plugins = ["small_laws"]


class Plant:
    """An endpoint whose thread does what a test says, when it says so."""

    def __init__(self, controller: Controller) -> None:
        m = controller.manifest
        nodes: dict[str, Any] = {g: {s.name: "ns=2;s=x" for s in m.signals(g)} for g in ("pv", "mv", "dv")}
        nodes["hand_back"] = HandBack("ns=2;s=o", 0)
        server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
        self.endpoint = OpcUaEndpoint(m, server, Nodes(**nodes), max_age_s=1.0, clock=lambda: 100.0)
        self.endpoint._link = self  # type: ignore[assignment]
        self.endpoint.trouble, self.endpoint.connections = "", 1
        self.mv, self.refuses = 50.0, False
        self.arrived: list[float] = []
        self.meanwhile: Callable[[], object] = lambda: None  # while a write is on its way
        self.reads()

    def reads(self) -> None:
        """An answer to a request of now."""
        self.reads_late()
        self.endpoint.sender.shown_on = 1

    def reads_late(self) -> None:
        """An answer to a request of before the last write."""
        values = Values(100.0, np.array([0.9, 300.0]), np.array([self.mv]), np.zeros(1), 0.0, "", (0, 0, 0, 0))
        self.endpoint.values = values

    def sends(self) -> None:
        """What waits goes out."""
        plan: Any = SimpleNamespace(variants=list, hand_back=lambda: "owner", lease=None)
        asyncio.run(self.endpoint.sender.send(self, plan, self.endpoint.nameplates))  # type: ignore[arg-type]

    async def write(self, rows: list[Any], _: float) -> list[int]:
        meanwhile, self.meanwhile = self.meanwhile, lambda: None
        meanwhile()
        if self.refuses:
            return [ua.StatusCodes.BadNotWritable]
        if rows != ["owner"]:
            self.mv = float(rows[0])
            self.arrived.append(self.mv)
        return [ua.StatusCodes.Good]


@pytest.fixture
def plant(controller: Controller) -> Plant:
    return Plant(controller)


@pytest.fixture
def loop(controller: Controller, plant: Plant) -> ControlLoop:
    clock = VirtualClock()
    return ControlLoop(
        controller, plant.endpoint, sp=1.0, mv=50.0, mode=Mode.MANUAL, guards=(), clock=clock, warm_lead_s=0
    )


def scan(loop: ControlLoop, plant: Plant) -> str:
    """One scan whose MV goes out at once; its reason."""
    reasons: list[str] = []
    loop.run(1, observe=lambda _, command: reasons.append(command.fault))
    plant.sends()
    return reasons[0]


def test_a_sample_tells_which_signal_is_old(plant: Plant) -> None:
    """None where all are, for then it is the connection or the server; the age is that of the oldest."""
    for ages, late in (
        ({"PV level": 0.0, "PV T": 0.9}, ""),
        ({"PV level": 0.0, "PV T": 15.0}, "PV T"),
        ({"PV level": 2.0, "PV T": 15.0}, ""),
        ({"PV level": 2.0, "PV T": 15.0, "DV inflow": 0.0}, "PV level, PV T"),
        ({"PV level": 2.0}, "PV level"),
        ({}, ""),
    ):
        assert plant.endpoint.values is not None
        plant.endpoint.values = replace(plant.endpoint.values, ages=ages, age_s=max(ages.values(), default=0.0))
        sample = plant.endpoint.read()
        assert (sample.late, sample.age_s) == (late, max(ages.values(), default=0.0))


def test_an_mv_that_a_slow_answer_holds_up_is_not_lost(loop: ControlLoop, plant: Plant) -> None:
    """The operator's MV stays his, though the read-backs of these scans are older than it."""
    assert scan(loop, plant) == ""
    loop.set_mv([60.0])
    loop.run(1)  # the thread waits for an answer
    loop.run(1)
    plant.reads_late()
    plant.sends()
    assert plant.arrived == [50.0, 60.0]
    for _ in range(3):
        assert scan(loop, plant) == ""
        plant.reads()
    assert plant.arrived == [50.0] + [60.0] * 4
    assert loop.mv.tolist() == [60.0]


def test_the_newest_of_those_that_wait_goes_out(loop: ControlLoop, plant: Plant) -> None:
    loop.run(1)
    loop.set_mv([60.0])
    loop.run(1)
    plant.sends()
    assert plant.arrived == [60.0]


def test_a_read_back_of_before_a_write_that_failed_does_not_tell_where_the_mv_stands(
    loop: ControlLoop, plant: Plant
) -> None:
    scan(loop, plant)
    plant.reads()
    plant.refuses = True
    scan(loop, plant)
    assert "the server refuses valve" in scan(loop, plant)  # the answer is late: the reading is an old one
    plant.mv, plant.refuses = 71.0, False
    assert "has not been read yet" in scan(loop, plant)
    with pytest.raises(LoopError, match="where the MV stands is not known"):
        loop.set_mv([60.0])
    plant.reads()
    assert scan(loop, plant) == ""
    assert plant.arrived == [50.0, 71.0]


def test_an_mv_passed_on_while_the_one_before_was_refused_does_not_go_out(loop: ControlLoop, plant: Plant) -> None:
    """It goes on from where that one was to lead: an actuator would move by both at once."""

    def next_scan() -> None:
        loop.set_mv([70.0])
        loop.run(1)

    assert scan(loop, plant) == ""
    plant.reads()
    loop.set_mv([60.0])
    plant.refuses, plant.meanwhile = True, next_scan
    assert scan(loop, plant) == ""
    plant.refuses = False
    plant.sends()
    assert plant.arrived == [50.0]
    assert "the server refuses valve" in scan(loop, plant)
    plant.reads()
    assert scan(loop, plant) == ""
    assert plant.arrived == [50.0, 50.0]


def test_what_the_loop_is_told_did_not_arrive_does_not_go_out_afterwards(plant: Plant) -> None:
    plant.endpoint.read()
    plant.endpoint.write(np.array([60.0]))
    plant.endpoint.sender.unwritten = "the server refuses valve"
    with pytest.raises(EndpointError, match="the server refuses valve"):
        plant.endpoint.write(np.array([61.0]))
    plant.sends()
    assert plant.arrived == []


def test_a_refusal_of_before_a_shadow_does_not_meet_the_first_write_after_it(loop: ControlLoop, plant: Plant) -> None:
    scan(loop, plant)
    plant.refuses = True
    scan(loop, plant)
    loop.set_mode(Mode.SHADOW)
    plant.refuses = False
    for _ in range(3):
        plant.reads()
        assert scan(loop, plant) == ""
    loop.set_mode(Mode.MANUAL)
    assert scan(loop, plant) == ""
    assert plant.arrived == [50.0, 50.0]


def test_a_hand_back_that_was_confirmed_before_the_loop_wrote_again_is_asked_for_anew(plant: Plant) -> None:
    made = plant.endpoint

    def asked() -> None:
        made.read()
        with pytest.raises(EndpointError, match="asked for, not confirmed yet"):
            made.hand_back()
        plant.sends()

    asked()
    for _ in range(2):  # somebody takes the plant back
        made.read()
        made.write(np.array([60.0]))
        plant.sends()
    asked()
    made.read()
    made.hand_back()
