"""An OPC UA server whose nodes hold what a test writes, and the settings of a loop on it. Not a test."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.sync import Server as SyncServer
from plant_servers import RunningLoop, free_port

from loopwright.serving import Controller
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.station.settings import Guards, JournalSettings, Settings

SPACE = "nsu=urn:test:plant;s="
SIGNALS = {"T": 300.0, "p": 5.0, "x": 0.5, "valve": 40.0, "heat": 0.5}  # of the laws of ``operated_files``
OTHERS = {"high": 100.0, "use": True, "back": 40.0, "word": "CAS", "number": 1}
KINDS = {bool: ua.VariantType.Boolean, str: ua.VariantType.String, int: ua.VariantType.Int64}


class WrittenNodes:
    """One node for each value of ``start``, else of ``SIGNALS`` and ``OTHERS``."""

    def __init__(self, start: Mapping[str, Any] | None = None) -> None:
        self.endpoint = f"opc.tcp://127.0.0.1:{free_port()}"
        self.server = SyncServer()
        self.server.set_endpoint(self.endpoint)
        space = self.server.register_namespace("urn:test:plant")
        self.nodes = {}
        for name, value in (start or {**SIGNALS, **OTHERS}).items():
            self.nodes[name] = self.server.nodes.objects.add_variable(ua.NodeId(name, space), name, value)
            self.nodes[name].set_writable()
        self.server.start()

    def write(self, name: str, value: Any, status: int = ua.StatusCodes.Good, at_s: float | None = None) -> None:
        """A value with its status, and with a source time where one is given: seconds behind a fixed one."""
        kind = KINDS.get(type(value), ua.VariantType.Double)
        stamp = None if at_s is None else datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=at_s)
        self.nodes[name].write_value(ua.DataValue(ua.Variant(value, kind), ua.StatusCode(status), stamp))

    def has(self, name: str) -> Any:
        return self.nodes[name].read_value()


@contextmanager
def written_nodes(start: Mapping[str, Any] | None = None) -> Iterator[WrittenNodes]:
    """A server until the test is over, and the loops on it with it."""
    made = WrittenNodes(start)
    yield made
    RunningLoop.end_all()
    made.server.stop()


def loop_settings(
    nodes: WrittenNodes, controller: Controller, folder: Path, of_nodes: dict[str, Any], **changed: Any
) -> Settings:
    """A loop in AUTO, five periods a second.

    ``of_nodes`` are fields of ``Nodes`` beside, or in place of, the plain ones.
    """
    groups = {g: {s.name: SPACE + s.name for s in controller.manifest.signals(g)} for g in ("pv", "mv")}
    return Settings(
        controller.path,
        Server(nodes.endpoint, security="None", insecure=True, source_time="ignore"),
        Nodes(**{**groups, "lease": "none", **of_nodes}),
        start="AUTO",
        accept_unproven=True,
        speed=5.0,  # periods of .2 s
        guards=Guards(max_age_s=50.0),
        journal=JournalSettings(folder / "loop.journal"),
        **changed,
    )
