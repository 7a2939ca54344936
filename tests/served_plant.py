"""A served plant that tests spoil, cut off and end, and a loop on it; fixtures for whoever imports them."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua
from plant_servers import CASE, SPACE, Plant, RunningLoop, Wire, loop_toml

from loopwright.serving.opcua.settings import ModeNode
from loopwright.serving.station.settings import Hold, Settings

SPEED = 2.5  # 0.5 s periods in 0.2 s
PERIOD_S = 0.5 / SPEED
RECOVER = 3
MODE = ModeNode(f"{SPACE}Control.Mode", {"MANUAL": 0, "AUTO": 1, "SHADOW": 2})


def begun(folder: Path, port: int, **changed: Any) -> RunningLoop:
    """A loop whose settings are ``changed``."""
    watched = f'heartbeat = "{SPACE}Control.Heartbeat"\nwatchdog = "{SPACE}Control.Watchdog"'
    settings = Settings.read(loop_toml(folder, f"opc.tcp://127.0.0.1:{port}", speed=SPEED, nodes=watched))
    nodes = replace(settings.nodes, **changed.pop("nodes", {}))
    server = replace(settings.server, connect_s=2.0, **changed.pop("server", {}))
    hold = changed.pop("hold", Hold(recover_after=RECOVER))
    return RunningLoop(replace(settings, nodes=nodes, server=server, hold=hold, **changed))


def told(running: RunningLoop, words: str) -> list[str]:
    return [line for line in running.told if words in line]


@pytest.fixture(scope="module", name="plant")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), CASE, SPEED)
    made.start()
    yield made
    made.end()


@pytest.fixture(name="wire")
def wired(plant: Plant) -> Iterator[Wire]:
    made = Wire(plant.port)
    yield made
    RunningLoop.end_all()
    made.close()


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


def cut(plant: Plant, wire: Wire) -> None:
    wire.cut = True


def mend(plant: Plant, wire: Wire) -> None:
    wire.cut = False
