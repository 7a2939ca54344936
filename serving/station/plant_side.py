"""The plant's own operator steers a loop by nodes: set points, values of ``operate``, the mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.loop import ControlLoop, Mode
from loopwright.serving.manifest import Manifest, OperateEntry, Signal
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.station.change_words import operate_words
from loopwright.serving.station.recorder import Recorder
from loopwright.serving.station.requests import NodeRequests, ended_words, is_contact, require_proven
from loopwright.serving.station.settings import Settings
from loopwright.serving.words import first_line

Array: TypeAlias = NDArray[np.float64]


class PlantSide:
    """Carries out between two scans what the nodes ask for, and writes each request down, also one that is refused."""

    def __init__(self, settings: Settings, manifest: Manifest, recorder: Recorder) -> None:
        self.settings, self.manifest, self.recorder = settings, manifest, recorder
        self.requests = NodeRequests()
        self._refused: dict[str, tuple[float, float | None]] = {}  # by name: what a node asks for, what the loop has
        self._steered: Controller | None = None  # the law that refused them

    def carry_out(self, loop: ControlLoop, values: Values) -> None:
        """Set points, values of ``operate`` and mode, where the plant's own operator changed them."""
        starts = self.requests.starts
        asked = self.requests.of(values)
        if self.requests.starts != starts:
            self._refused = {name: kept for name, kept in self._refused.items() if is_contact(name)}
            self._anew()
        for why in self.requests.refused(values):
            self.recorder.note("change", "plant", f"refused: {why}")
        if asked.sp:
            self.set_points(loop, asked.sp)
        if asked.operate or (self._refused and loop.controller is not self._steered):
            self.set_operate(loop, asked.operate)
        if asked.mode:
            self.carried_out(partial(self.set_mode, loop, Mode(asked.mode)), f"mode {asked.mode}", Mode(asked.mode))

    def _anew(self) -> None:
        nodes = self.settings.nodes
        if not (nodes.sp or nodes.operate or nodes.mode is not None):
            return
        those = "the set points, the values of operate and the mode" if nodes.operate else "the set points and the mode"
        what = f"the plant's server has, or may have, started anew: {those} that stand there"
        but = "; a `use` counts as it stands" if any(map(is_contact, nodes.operate)) else ""
        self.recorder.note("connection", "opcua", f"{what} are no wish of its operator until they change{but}")

    def set_points(self, loop: ControlLoop, changed: Mapping[str, float]) -> None:
        """Each for itself: one outside its range takes no other one with it."""
        for i, s in enumerate(self.manifest.sp):
            if s.name in changed:
                wanted = loop.sp
                wanted[i] = changed[s.name]
                what = f"set point {shown_values(wanted[i : i + 1], (s,))}"
                self.carried_out(partial(_set_sp, loop, wanted), what)

    def set_operate(self, loop: ControlLoop, changed: Mapping[str, float]) -> None:
        """All at once, as both ends of a range may move; where they are refused, signal by signal.

        A value that is refused stays asked for while its node holds it: it is tried again with the next change, and
        with another law, unless somebody has set another one in the loop meanwhile.
        """
        entries = {e.name: e for e in loop.controller.manifest.operate}
        same, now = loop.controller is self._steered, _standing(loop)
        again = {n: value for n, (value, before) in self._refused.items() if not same or now.get(n) == before}
        asked = {**again, **changed}
        self._steered, self._refused = loop.controller, {}
        for values in [asked] if not _refusal(loop, asked) else _by_signal(entries, asked):
            if _refusal(loop, values):
                self._refused |= {name: (value, now.get(name)) for name, value in values.items()}
                if not set(values) & set(changed):
                    continue  # it was said
            what = operate_words(loop.controller.manifest.operate, _standing(loop), values, self.manifest.period_s)
            self.carried_out(partial(loop.set_operate, values), what)

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


def _set_sp(loop: ControlLoop, wanted: Array) -> str:
    """Set them; what is to be said beside it: courses that end by it."""
    return ended_words(loop.set_sp(wanted)).removeprefix("; ")


def _standing(loop: ControlLoop) -> dict[str, float]:
    """The values of ``operate`` by name."""
    return dict(zip([e.name for e in loop.controller.manifest.operate], loop.operate.tolist(), strict=True))


def _refusal(loop: ControlLoop, values: Mapping[str, float]) -> str:
    try:
        loop.operate_with(values)
    except LoopError as error:
        return first_line(error)
    return ""


def _by_signal(entries: Mapping[str, OperateEntry], asked: Mapping[str, float]) -> list[dict[str, float]]:
    """Values that go together: both ends of a range, unless one is outside its engineered range by itself."""
    groups = dict[str, dict[str, float]]()
    for name, value in asked.items():
        e = entries.get(name)
        paired = e is not None and e.what in {"low", "high"} and e.low <= value <= e.high
        groups.setdefault(f"range of {e.signal}" if paired and e else name, {})[name] = value
    return list(groups.values())


def shown_values(values: Array, signals: tuple[Signal, ...]) -> str:
    """Values (n,) with the names and units of their signals."""
    return ", ".join(f"{s.name} {v:g} {s.unit}" for s, v in zip(signals, values.tolist(), strict=True))
