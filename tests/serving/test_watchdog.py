"""The plant's watchdog: dead while it stands, and told once where it is slow."""

from __future__ import annotations

import math
from itertools import groupby
from typing import Any

import pytest

from loopwright.serving import Controller
from loopwright.serving.guard import kind_of
from loopwright.serving.opcua.sampling import NodeSampling
from loopwright.serving.opcua.settings import Nodes, Server

pytest_plugins = ["small_laws"]


@pytest.fixture
def sampling(controller: Controller) -> NodeSampling:
    m = controller.manifest
    nodes: dict[str, Any] = {g: {s.name: "ns=2;s=x" for s in m.signals(g)} for g in ("pv", "mv", "dv")}
    server = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)
    return NodeSampling(m, server, Nodes(**nodes, watchdog="ns=2;s=w", watchdog_scans=3))


def test_one_that_stands_is_dead_and_believed_again_at_its_second_move(sampling: NodeSampling) -> None:
    assert [sampling.dead(float(k)) for k in range(5)] == [""] * 5
    stands = "the plant's watchdog has stood at 4 for {} scans"
    assert [sampling.dead(4.0) for _ in range(4)] == ["", "", stands.format(3), stands.format(4)]
    assert [sampling.dead(float(k)) for k in range(5, 8)] == [stands.format(4), "", ""]


@pytest.mark.parametrize("scans", [1, 2, 3])
def test_one_that_moves_within_so_many_scans_lives(sampling: NodeSampling, scans: int) -> None:
    assert {sampling.dead(float(k // scans)) for k in range(60)} == {""}
    for _ in range(5):
        sampling.dead(math.nan)  # the node is gone
    found = [bool(sampling.dead(float(k // scans))) for k in range(100, 140)]
    assert found[0]
    assert not any(found[2 * scans :])


@pytest.mark.parametrize("scans", [4, 5, 20])
def test_one_that_is_slow_is_told_once(sampling: NodeSampling, scans: int) -> None:
    """A loop at speed 5 on a plant at speed 1 had a fault of each value."""
    kinds = [kind for kind, _ in groupby(kind_of(sampling.dead(float(k // scans))) for k in range(430))]
    assert len(kinds) == 3
    assert kinds[:2] == [("",), ("the plant's watchdog has stood at # for # scans",)]
    assert "moves, but not within # scans: the plant runs at another speed" in kinds[2][0]


def test_a_plant_that_comes_to_its_speed_is_believed(sampling: NodeSampling) -> None:
    for k in range(100):
        sampling.dead(float(k // 5))
    assert [bool(sampling.dead(float(k))) for k in range(100, 104)] == [True, False, False, False]
