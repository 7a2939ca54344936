"""A station in which nothing moves, for tests: its plant stands still and reads back what was written. Not a test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from loopwright.serving import Controller, Sample, VirtualClock
from loopwright.serving.clock import EndingClock, MachineTime, Time
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.station.machine import Machine
from loopwright.serving.station.settings import Settings

SERVER = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True, connect_s=0.05)


def settings_of(controller: Controller, **changed: Any) -> Settings:
    m = controller.manifest
    nodes = {g: {s.name: f"ns=2;s={s.name}" for s in m.signals(g)} for g in ("pv", "dv", "mv")}
    return Settings(controller.path, SERVER, Nodes(**nodes), start="MANUAL", **changed)


class HurriedTime(MachineTime):
    """The machine's, but no scan waits for its period."""

    def paced(self, speed: float) -> EndingClock:
        return VirtualClock()


def still_machine(folder: Path, endpoint: Any = None, time: Time | None = None) -> Machine:
    """A machine whose plant is ``endpoint``, one that stands still unless given, and whose locks lie in a folder."""
    return Machine(time=time or HurriedTime(), endpoint=endpoint or StillPlant, locks=folder / "locks")


class StillPlant:
    """In the place of the endpoint: it stands still and reads back what was written."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.trouble, self.connections, self.connected = "", 1, True
        self.mv, self.asked_sp = np.zeros(2), dict[str, float]()

    @property
    def values(self) -> Values:
        return Values(0.0, np.zeros(2), self.mv, np.zeros(1), 0.0, "", (), asked_sp=self.asked_sp)

    def start(self) -> None:
        """Nothing: it is there."""

    def serve(self, law: Any) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""

    def read(self) -> Sample:
        return Sample(np.zeros(2), self.mv, dv=np.zeros(1))

    def write(self, mv: np.ndarray) -> None:
        self.mv = mv.copy()
