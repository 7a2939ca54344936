"""The machine that a loop runs on: its time, its network, its disk; and the work that goes on beside the scans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from loopwright.serving.clock import MACHINE_TIME, Time
from loopwright.serving.journal import Journal
from loopwright.serving.opcua.endpoint import OpcUaEndpoint
from loopwright.serving.station.control import Control
from loopwright.serving.station.housekeeping import PeriodicTask


@dataclass(frozen=True, slots=True)
class Machine:
    """The parts of a machine that a station is made with: the real ones, or those of a world with a time of its own.

    ``endpoint`` reads and writes the plant over the network, ``journal`` writes to the disk, ``door`` answers requests
    of this machine's users, ``tended`` looks after files now and then. ``locks`` is the folder of the locks of MVs;
    None: the user's own for temporary files.
    """

    time: Time = MACHINE_TIME
    endpoint: Callable[..., OpcUaEndpoint] = OpcUaEndpoint
    journal: Callable[..., Journal] = Journal
    door: Callable[..., Control] = Control
    tended: Callable[..., PeriodicTask] = PeriodicTask
    locks: Path | None = None


THIS_MACHINE = Machine()
