"""How often an MV that stands is written."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loopwright.serving import Controller, LoopError
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.opcua.sampling import NodeSampling
from loopwright.serving.opcua.settings import Nodes, Server

pytest_plugins = ["small_laws"]


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def endpoint(controller: Controller, rewrite_s: float, clock: Clock) -> OpcUaEndpoint:
    m = controller.manifest
    nodes: dict[str, Any] = {g: {s.name: "ns=2;s=x" for s in m.signals(g)} for g in ("pv", "mv", "dv")}
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, rewrite_s=rewrite_s)
    made = OpcUaEndpoint(m, server, Nodes(**nodes), max_age_s=1.0, clock=clock)
    made._link = object()  # type: ignore[assignment]
    made.sender.shown_on = made.sender.told_on = 1  # it is known where the MV stands
    return made


def written(made: OpcUaEndpoint, clock: Clock, mvs: list[float | None]) -> list[bool]:
    """Scan by scan 0.5 s apart, whether an MV went out; None: a scan that writes nothing."""
    out = []
    for mv in mvs:
        made.sender.scans += 1
        clock.now += 0.5
        if mv is not None:
            made.write(np.array([mv]))
        out.append(bool(made.sender.outbox))
        made.sender.outbox.clear()
    return out


def test_every_scan_unless_told_otherwise(controller: Controller) -> None:
    clock = Clock()
    assert written(endpoint(controller, 0.0, clock), clock, [1.0] * 4) == [True] * 4


def test_one_that_stands_is_written_now_and_then_and_one_that_moves_at_once(controller: Controller) -> None:
    clock = Clock()
    made = endpoint(controller, 2.0, clock)
    assert written(made, clock, [1.0] * 6) == [True, False, False, False, True, False]
    assert written(made, clock, [2.0, 2.0, 3.0]) == [True, False, True]


def test_whoever_had_the_plant_meanwhile_it_is_written_again(controller: Controller) -> None:
    clock = Clock()
    made = endpoint(controller, 100.0, clock)
    assert written(made, clock, [1.0, 1.0, None, 1.0]) == [True, False, False, True]
    made.sender.unwritten = "the server refuses"
    with pytest.raises(Exception, match="the server refuses"):
        written(made, clock, [1.0])
    assert not made.sender.outbox  # the loop holds the MV before it, so it must not go out
    assert written(made, clock, [1.0]) == [True]


def test_a_time_that_is_none_is_refused() -> None:
    with pytest.raises(LoopError, match="rewrite_s is -1"):
        Server("opc.tcp://h:1", security="None", insecure=True, rewrite_s=-1)


def test_a_watchdog_that_is_gone_has_stopped(controller: Controller) -> None:
    of = endpoint(controller, 2.0, Clock())
    made = NodeSampling(of.manifest, of.server, replace(of.nodes, watchdog="ns=2;s=W", watchdog_scans=3))
    assert [bool(made.dead(value)) for value in (1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 4.0, 5.0)] == [False] * 5 + [
        True,
        True,
        False,
    ]
    assert [bool(made.dead(math.nan)) for _ in range(4)] == [False, False, True, True]
