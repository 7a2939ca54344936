"""A loop on a real OPC UA server goes on without one sensor, and its plant's own operator moves limits by nodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua
from asyncua.sync import Server as SyncServer
from plant_servers import RunningLoop, free_port
from processes import within

from loopwright.serving import Controller, Mode
from loopwright.serving.opcua.inspection import inspected
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.station.settings import Bridge, Guards, JournalSettings, Settings

pytest_plugins = ["small_laws", "operated_files"]
START = {"T": 300.0, "p": 5.0, "x": 0.5, "valve": 40.0, "heat": 0.5, "high": 100.0, "use": True}
SPACE = "nsu=urn:test:plant;s="


class PlantServer:
    """Nodes that hold what the test writes."""

    def __init__(self) -> None:
        self.endpoint = f"opc.tcp://127.0.0.1:{free_port()}"
        self.server = SyncServer()
        self.server.set_endpoint(self.endpoint)
        space = self.server.register_namespace("urn:test:plant")
        self.nodes = {}
        for name, value in START.items():
            node = self.server.nodes.objects.add_variable(ua.NodeId(name, space), name, value)
            node.set_writable()
            self.nodes[name] = node
        self.server.start()

    def write(self, name: str, value: Any, status: int = ua.StatusCodes.Good) -> None:
        kind = ua.VariantType.Boolean if isinstance(value, bool) else ua.VariantType.Double
        self.nodes[name].write_value(ua.DataValue(ua.Variant(value, kind), ua.StatusCode(status)))


@pytest.fixture
def server() -> Iterator[PlantServer]:
    made = PlantServer()
    yield made
    RunningLoop.end_all()
    made.server.stop()


def settings_of(server: PlantServer, controller: Controller, folder: Path, **changed: Any) -> Settings:
    groups: Any = {g: {s.name: SPACE + s.name for s in controller.manifest.signals(g)} for g in ("pv", "mv")}
    operate = {"valve.high": f"{SPACE}high", "valve.use": f"{SPACE}use"}
    return Settings(
        controller.path,
        Server(server.endpoint, security="None", insecure=True, source_time="ignore"),
        Nodes(**groups, operate=operate, lease="none"),
        start="AUTO",
        accept_unproven=True,
        speed=5.0,  # periods of .2 s
        guards=Guards(max_age_s=50.0),
        journal=JournalSettings(folder / "loop.journal"),
        **changed,
    )


def test_one_sensor_stops_no_loop_and_nodes_move_limits(
    server: PlantServer, operated: Controller, tmp_path: Path
) -> None:
    running = RunningLoop(settings_of(server, operated, tmp_path, fresh=Bridge(2.0)))
    running.becomes(Mode.AUTO, scans=3)
    server.write("T", 300.0, ua.StatusCodes.BadSensorFailure)
    assert within(20, lambda: bool(running.commands[-1].bridged or running.commands[-1].shed))
    assert within(20, lambda: list(running.commands[-1].shed) == ["T"])
    assert running.commands[-1].mode is Mode.AUTO
    server.write("T", 290.0)  # ten below its set point: the valve goes up to its end
    assert within(20, lambda: not running.commands[-1].shed)
    assert within(20, lambda: running.commands[-1].mv[0] == 100.0)
    server.write("high", 70.0)
    assert within(20, lambda: running.commands[-1].mv[0] == 70.0)
    assert running.does("operate", {"valve.high": 60.0}).startswith("operate valve.high 70 -> 60")
    assert within(20, lambda: running.commands[-1].mv[0] == 60.0)
    server.write("use", False)  # the plant's own switch: the MV is in local
    assert within(20, lambda: "change plant: operate valve.use 0" in running.events())
    before = len(running.commands)
    assert within(20, lambda: len(running.commands) > before + 2)
    assert running.commands[-1].mv[0] == 60.0
    server.write("high", 120.0)
    assert within(20, lambda: any("refused: operate valve.high 120" in line for line in running.events()))
    running.end()


def test_the_check_shows_the_nodes_of_operate(server: PlantServer, operated: Controller, tmp_path: Path) -> None:
    server.write("high", 120.0)
    made = settings_of(server, operated, tmp_path)
    rows = {r.signal: r for r in inspected(operated.manifest, made.server, made.nodes, 0.05).rows}
    high, use = rows["operate valve.high"], rows["operate valve.use"]
    assert (high.wrong, high.value, use.wrong, use.note, use.value) == ("", "120", "", "", "1")
    assert "0 to 100 %" in high.note
