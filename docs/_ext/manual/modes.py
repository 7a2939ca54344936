"""The machine of modes as the code has it: a loop is put into each mode, and each thing happens to it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.serving import ControlLoop, LoopError, Mode, Sample, Signal
from loopwright.serving.controller import Step
from loopwright.serving.manifest import Manifest
from loopwright.serving.modes import Fallback
from manual.markdown import table

RECOVER_AFTER = 3  # good samples that end a fault
LASTS = 5  # scans of a fault after which the plant is handed back
FAULT = "HOLD by a fault"
STATES = (*map(str, Mode), FAULT)


class _Law:
    """Asks for the middle of the range."""

    path, sha256 = Path("law.onnx"), "0" * 64

    @cached_property
    def manifest(self) -> Manifest:
        level, valve = Signal("level", "m", 0.0, 10.0), Signal("valve", "%", 0.0, 100.0)
        inputs = ("sp", "pv", "mv_applied", "state")
        return Manifest("modes", "middle", 1.0, (level,), (level,), (), (valve,), 1, (), inputs)

    def cold_state(self) -> np.ndarray:
        return np.zeros(1)

    def step(self, **_: Any) -> Step:
        return Step(np.array([50.0]), np.zeros(1), np.zeros(0))


class _Tried:
    """A loop in one of STATES."""

    def __init__(self, state: str) -> None:
        back = Fallback(float(LASTS), hand_back=True)
        law: Any = _Law()
        self.loop = ControlLoop(law, _Plant(), sp=5.0, mv=40.0, recover_after=RECOVER_AFTER, fallback=back)
        self.good()
        self.loop.set_mode(Mode.AUTO if state == FAULT else Mode(state))
        self.good()
        if state == FAULT:
            self.loop.miss("no answer")

    def good(self, times: int = 1) -> None:
        for _ in range(times):
            self._scanned(self.loop.scan(Sample(np.array([5.0]), self.loop.mv, dv=np.zeros(0))))

    def missed(self, times: int = 1) -> None:
        for _ in range(times):
            self._scanned(self.loop.miss("no answer"))

    def _scanned(self, command: Any) -> None:
        if command.hand_back:
            self.loop.hand_back()

    def lost(self) -> None:
        last = self.loop.mv
        self.good()
        self.loop.unwritten(last, "the write did not arrive")

    def asked(self, mode: Mode) -> None:
        self.loop.set_mode(mode)
        self.good()

    @property
    def state(self) -> str:
        return FAULT if self.loop.fault else str(self.loop.mode)


class _Plant:
    """Has a controller of its own, which can be asked to take it."""

    def read(self) -> Sample:
        raise LoopError("not read")

    def write(self, mv: Any) -> None: ...

    def hand_back(self) -> None: ...


HAPPENS: dict[str, Callable[[_Tried], object]] = {
    "no sample, or one that a guard refuses": lambda t: t.missed(),
    "an MV that did not arrive": lambda t: t.lost(),
    "`recover_after` good samples": lambda t: t.good(RECOVER_AFTER),
    "a fault of more than `max_s`, `then` is hand back": lambda t: t.missed(LASTS + 2),
    **{f"asked for {mode}": lambda t, mode=mode: t.asked(mode) for mode in Mode},  # type: ignore[misc]
}


BY_ITSELF = {
    "no sample, or one that a guard refuses": "fault",
    "an MV that did not arrive": "fault",
    "`recover_after` good samples": "good samples",
    "a fault of more than `max_s`, `then` is hand back": "handed back",
}
"""Events that nobody asks for -> words at their arrows."""
SIDE_BY_SIDE = ("MANUAL", "HOLD", "AUTO", FAULT, "SHADOW")  # in the picture


def after(state: str, what: str) -> str:
    """The state to which something leads from another one."""
    tried = _Tried(state)
    assert tried.state == state
    try:
        HAPPENS[what](tried)
    except LoopError:
        return "refused"
    return tried.state


def modes() -> str:
    """The picture of what changes a mode without a request, and a row for each thing that happens."""
    rows = [(what, *(_shown(state, after(state, what)) for state in STATES)) for what in HAPPENS]
    by_itself: dict[tuple[str, str], str] = {}
    for what, said in BY_ITSELF.items():
        for state in STATES:
            if (new := after(state, what)) != state:
                by_itself.setdefault((state, new), said)
    # AUTO leaves for the plant's own side by way of a fault.
    by_itself.pop(("AUTO", "SHADOW"), None)
    keys = {state: "FAULT" if state == FAULT else state for state in SIDE_BY_SIDE}
    assert sorted(keys) == sorted(STATES)
    places = {key: i for i, key in enumerate(keys)}
    arrows = [
        f"{keys[old]} > {keys[new]}{_lane(places[new] - places[old])} : {said}"
        for (old, new), said in by_itself.items()
    ]
    grid = " | ".join(f"{key} = [{state}]" if key != state else f"[{state}]" for state, key in keys.items())
    picture = ["```{diagram} What changes the mode of a loop without a request", grid, "--", *arrows, "```"]
    return "\n\n".join(["\n".join(picture), table(["", *(f"in {state}" for state in STATES)], rows)])


def _lane(columns: int) -> str:
    """Where an arrow runs that goes so many columns to the right."""
    return {1: "", -1: " below"}.get(columns, " above")


def _shown(before: str, now: str) -> str:
    return "stays" if now == before else now
