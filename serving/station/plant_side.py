"""The plant's own operator steers a loop by nodes: set points, values of ``operate``, the mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.loop import ControlLoop, Mode
from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.station.recorder import Recorder
from loopwright.serving.station.requests import NodeRequests, require_proven
from loopwright.serving.station.settings import Settings
from loopwright.serving.words import first_line

Array: TypeAlias = NDArray[np.float64]


class PlantSide:
    """Carries out between two scans what the nodes ask for, and writes each request down, also one that is refused."""

    def __init__(self, settings: Settings, manifest: Manifest, recorder: Recorder) -> None:
        self.settings, self.manifest, self.recorder = settings, manifest, recorder
        self.requests = NodeRequests()

    def carry_out(self, loop: ControlLoop, values: Values) -> None:
        """Set points, values of ``operate`` and mode, where the plant's own operator changed them."""
        starts, nodes = self.requests.starts, self.settings.nodes
        asked = self.requests.of(values)
        if self.requests.starts != starts and (nodes.sp or nodes.operate or nodes.mode is not None):
            what = "the plant's server has, or may have, started anew: the set points and the mode that stand there"
            self.recorder.note("connection", "opcua", f"{what} are no wish of its operator until they change")
        for why in self.requests.refused(values):
            self.recorder.note("change", "plant", f"refused: {why}")
        if asked.sp:
            self.set_points(loop, asked.sp)
        if asked.operate:
            self.set_operate(loop, asked.operate)
        if asked.mode:
            self.carried_out(partial(self.set_mode, loop, Mode(asked.mode)), f"mode {asked.mode}", Mode(asked.mode))

    def set_points(self, loop: ControlLoop, changed: Mapping[str, float]) -> None:
        """Each for itself: one outside its range takes no other one with it."""
        for i, s in enumerate(self.manifest.sp):
            if s.name in changed:
                wanted = loop.sp
                wanted[i] = changed[s.name]
                what = f"set point {shown_values(wanted[i : i + 1], (s,))}"
                self.carried_out(partial(loop.set_sp, wanted), what)

    def set_operate(self, loop: ControlLoop, changed: Mapping[str, float]) -> None:
        """All at once, as both ends of a range may move; where they are refused, each for itself."""
        units = {e.name: e.unit for e in loop.controller.manifest.operate}
        try:
            loop.operate_with(changed)
            together = [changed]
        except LoopError:
            together = [{name: value} for name, value in changed.items()]
        for values in together:
            words = ", ".join(f"{name} {value:g} {units.get(name, '')}".rstrip() for name, value in values.items())
            self.carried_out(partial(loop.set_operate, values), f"operate {words}")

    def set_mode(self, loop: ControlLoop, mode: Mode) -> str:
        """Set it; what is not proven of a controller that was accepted all the same."""
        unproven = require_proven(loop, self.settings.accept_unproven) if mode is Mode.AUTO else ""
        loop.set_mode(mode)
        return f"accepted though {unproven}" if unproven else ""

    def carried_out(self, act: Callable[[], str | None], what: str, mode: Mode | None = None) -> None:
        """Do it and write it down; a request that is refused is written down with the reason."""
        try:
            reason = act() or ""
        except LoopError as error:
            self.recorder.note("change", "plant", f"refused: {what} ({first_line(error)})")
            return
        self.recorder.note("change", "plant", what, reason, mode=mode)


def shown_values(values: Array, signals: tuple[Signal, ...]) -> str:
    """Values (n,) with the names and units of their signals."""
    return ", ".join(f"{s.name} {v:g} {s.unit}" for s, v in zip(signals, values.tolist(), strict=True))
