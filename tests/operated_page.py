"""The page of an operated law that runs on its own model, without a server. Not a test.

Two controlled variables, two MVs, one measured disturbance, ``SPEED`` periods a second.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from identified_models import random_model
from plant_servers import RunningLoop

from loopwright.serving import Sample
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.opcua.settings import Nodes, Server
from loopwright.serving.page.process import Page as PageSettings
from loopwright.serving.station.machine import Machine
from loopwright.serving.station.settings import Bridge, JournalSettings, Settings

SPEED = 5.0
TOKEN = "a token that is long enough"
SERVER = Server("opc.tcp://127.0.0.1:1", security="None", insecure=True)


class ModelPlant:
    """In the place of an OPC UA endpoint: the model of ``operated_file``, which moves on as an MV is written."""

    made: ModelPlant

    def __init__(self, manifest: Manifest, *_: Any, **__: Any) -> None:
        ModelPlant.made = self
        self.model = random_model(3, n_y=2, n_mv=2, n_dv=1)
        self.x, self.mv = torch.zeros(self.model.n_x, dtype=torch.float64), np.zeros(len(manifest.mv))
        self.trouble, self.connections, self.connected = "", 1, True
        self.bad: tuple[str, ...] = ()

    @property
    def values(self) -> Values:
        with torch.no_grad():
            pv = self.model.measured(self.x).numpy()
        return Values(0.0, pv, self.mv, np.zeros(1), 0.0, "", (), bad_pv=self.bad)

    def start(self) -> None:
        """Nothing: it is there."""

    def serve(self, law: Manifest) -> None:
        """Nothing: it has no server."""

    def close(self) -> None:
        """Nothing."""

    def read(self) -> Sample:
        now = self.values
        return Sample(now.pv, self.mv, now.dv, bad_pv=self.bad)

    def write(self, mv: np.ndarray) -> None:
        self.mv = mv.copy()
        with torch.no_grad():
            self.x = self.model(torch.cat([self.x, torch.from_numpy(self.mv), torch.zeros(1, dtype=torch.float64)]))


def served(controller: Path, folder: Path, **changed: Any) -> RunningLoop:
    """A loop in AUTO with its page; what is not ``changed`` is as loop.toml has it."""
    (folder / "token").write_text(TOKEN)
    nodes: Any = {"pv": {}, "mv": {}}
    settings = Settings(
        controller,
        SERVER,
        Nodes(**nodes, lease="none"),
        start="AUTO",
        accept_unproven=True,
        speed=SPEED,
        journal=JournalSettings(folder / "loop.journal"),
        page=PageSettings("127.0.0.1:0", token_file=folder / "token"),
        **{"fresh": Bridge(4.0), **changed},
    )
    return RunningLoop(settings, Machine(endpoint=ModelPlant))
