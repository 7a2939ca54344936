"""A loop on a real OPC UA server goes on without one sensor, and its plant's own operator moves limits by nodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from asyncua import ua
from plant_servers import RunningLoop
from processes import within
from written_nodes import SPACE, WrittenNodes, loop_settings, written_nodes

from loopwright.pipeline.__main__ import main
from loopwright.serving import Controller, Mode
from loopwright.serving.opcua.inspection import inspected
from loopwright.serving.station.settings import Bridge, Settings

pytest_plugins = ["small_laws", "operated_files"]


@pytest.fixture
def nodes() -> Iterator[WrittenNodes]:
    with written_nodes() as made:
        yield made


def settings_of(nodes: WrittenNodes, controller: Controller, folder: Path, **changed: Any) -> Settings:
    operate = {"valve.high": f"{SPACE}high", "valve.use": f"{SPACE}use"}
    return loop_settings(nodes, controller, folder, {"operate": operate}, **changed)


def test_one_sensor_stops_no_loop_and_nodes_move_limits(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path
) -> None:
    running = RunningLoop(settings_of(nodes, operated, tmp_path, fresh=Bridge(2.0)))
    running.becomes(Mode.AUTO, scans=3)
    nodes.write("T", 300.0, ua.StatusCodes.BadSensorFailure)
    assert within(20, lambda: bool(running.commands[-1].bridged or running.commands[-1].shed))
    assert within(20, lambda: list(running.commands[-1].shed) == ["T"])
    assert running.commands[-1].mode is Mode.AUTO
    nodes.write("T", 290.0)  # ten below its set point: the valve goes up to its end
    assert within(20, lambda: not running.commands[-1].shed)
    assert within(20, lambda: running.commands[-1].mv[0] == 100.0)
    nodes.write("high", 70.0)
    assert within(20, lambda: running.commands[-1].mv[0] == 70.0)
    assert running.does("operate", {"valve.high": 60.0}).startswith("operate valve.high 70 -> 60")
    assert within(20, lambda: running.commands[-1].mv[0] == 60.0)
    nodes.write("use", False)  # the plant's own switch: the MV is in local
    assert within(20, lambda: "change plant: operate valve.use 0" in running.events())
    before = len(running.commands)
    assert within(20, lambda: len(running.commands) > before + 2)
    assert running.commands[-1].mv[0] == 60.0
    nodes.write("high", 120.0)
    assert within(20, lambda: any("refused: operate valve.high 120" in line for line in running.events()))
    running.end()


def test_the_check_shows_the_nodes_of_operate(nodes: WrittenNodes, operated: Controller, tmp_path: Path) -> None:
    nodes.write("high", 120.0)
    made = settings_of(nodes, operated, tmp_path)
    rows = {r.signal: r for r in inspected(operated.manifest, made.server, made.nodes, 0.05).rows}
    high, use = rows["operate valve.high"], rows["operate valve.use"]
    assert (high.wrong, high.value, use.wrong, use.note, use.value) == ("", "120", "", "", "1")
    assert "0 to 100 %" in high.note


def test_a_switch_is_written_as_true_or_false(
    nodes: WrittenNodes, operated: Controller, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the command; a value that is no switch takes numbers alone, as a set point does."""
    settings = settings_of(nodes, operated, tmp_path)
    running = RunningLoop(settings)
    running.becomes(Mode.AUTO, scans=3)
    with mock.patch.object(Settings, "read", return_value=settings):
        for words, stands in (("T.use=false", 0.0), ("T.use=TRUE", 1.0), ("T.use=0", 0.0)):
            assert main(["loop", "operate", words]) == 0
            assert within(20, lambda stands=stands: dict(_operate(running))["T.use"] == stands)
        capsys.readouterr()
        for wrong in (("operate", "valve.high=true"), ("operate", "T.use=maybe"), ("sp", "T=true")):
            assert main(["loop", *wrong]) == 2
            assert capsys.readouterr().err.count("\n") == 1
    assert dict(_operate(running))["valve.high"] == 100.0
    running.end()


def _operate(running: RunningLoop) -> Iterator[tuple[str, float]]:
    loop = running.station.loop
    assert loop is not None
    return zip((e.name for e in loop.controller.manifest.operate), loop.operate.tolist(), strict=True)
