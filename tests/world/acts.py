"""What may happen in one period of a loop: operators, the plant, the connection; and what a loop does then.

The plant is one MV that stands at one of five places and moves by one place a period at most. Its law goes from where
the MV stands towards ``TARGET``. So a loop has few states, and sequences that lead to the same one are one.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from loopwright.serving import ControlLoop, LoopError, Mode, Sample, Signal
from loopwright.serving.controller import Step
from loopwright.serving.manifest import Manifest
from loopwright.serving.modes import Command

LOW, HIGH, MOVE, TARGET = 0.0, 4.0, 1.0, 3.0  # places of the MV; how far it may go in a period; where the law goes
RECOVER_AFTER = 2  # good samples that end a fault
REQUESTS = (None, *Mode, LOW, HIGH)  # nothing, a mode, an MV by hand
# Samples: a good one with and without a read-back; a refused one with and without; a read-back that no actuator has;
# none at all; a good one on which the law raises.
SAMPLES = ("good", "blind", "refused", "refused blind", "outside", "missed", "raises")


class Act(NamedTuple):
    """One period: what operators ask for before its scan, whether others move the MV, its sample, its write."""

    request: Mode | float | None = None
    moved: bool = False  # to the other end of its range
    sample: str = "good"
    lost: bool = False  # what is written does not arrive, and the loop is told so

    def __str__(self) -> str:
        request = "" if self.request is None else f"ask {self.request}"
        return " + ".join(filter(None, [request, "others move" * self.moved, self.sample, "write lost" * self.lost]))


ACTS = tuple(Act(*parts) for parts in product(REQUESTS, (False, True), SAMPLES, (False, True)))


class StepLaw:
    """mv = mv_applied + clip(TARGET - mv_applied, -MOVE, MOVE), in the place of a controller file."""

    path, sha256, raises = Path("law.onnx"), "0" * 64, False

    @cached_property
    def manifest(self) -> Manifest:
        """One set point and PV, one MV with a largest move."""
        level = Signal("level", "m", 0.0, 10.0)
        return Manifest(
            case="walk", law="steps", period_s=1.0, sp=(level,), pv=(level,), dv=(),
            mv=(Signal("valve", "%", LOW, HIGH, max_move=MOVE),), n_state=1, info=(),
            inputs=("sp", "pv", "mv_applied", "state"),
        )  # fmt: skip

    def cold_state(self) -> np.ndarray:
        return np.zeros(1)

    def step(self, *, mv_applied: np.ndarray, **_: Any) -> Step:
        if self.raises:
            raise ValueError("the law raises")
        mv = mv_applied + np.clip(TARGET - mv_applied, -MOVE, MOVE)
        return Step(mv, np.ones(1), np.zeros(0))

    def __reduce__(self) -> str:
        return "LAW"  # one for all loops


LAW = StepLaw()


class Seen(NamedTuple):
    """One period as it went."""

    act: Act
    before: Mode  # as the scan before left it
    accepted: bool  # whether the loop took the request
    plant: float  # where the MV stood at the sample
    command: Command
    mode: Mode  # after the scan, and after what was heard of its write
    fault: str
    now: float  # the loop's command after it, NaN where it has none

    @property
    def written(self) -> float | None:
        """What went out, arrived or not."""
        return float(self.command.mv[0]) if self.command.writes else None


@dataclass(slots=True)
class World:
    """A loop and its plant between two periods."""

    loop: ControlLoop
    plant: float = 2.0

    @classmethod
    def begun(cls, mode: Mode, mv: float | None = None) -> World:
        """A loop at its start, which may know where the MV stands."""
        options: dict[str, Any] = {"recover_after": RECOVER_AFTER, "mode": mode, "mv": mv}
        return cls(ControlLoop(LAW, sp=5.0, **options))  # type: ignore[arg-type]

    def frozen(self) -> bytes:
        """All that counts for what it does next."""
        return pickle.dumps((_settled(self.loop), self.plant))

    @classmethod
    def thawed(cls, data: bytes) -> World:
        """The world again."""
        return cls(*pickle.loads(data))

    def do(self, act: Act) -> Seen:
        """One period."""
        loop, before = self.loop, self.loop.mode
        accepted = self._asked(act.request)
        if act.moved:
            self.plant = LOW if self.plant > (LOW + HIGH) / 2 else HIGH
        stood, last = self.plant, loop.mv
        LAW.raises = act.sample == "raises"
        try:
            sample = self._sample(act.sample)
            command = loop.miss("no answer") if sample is None else loop.scan(sample)
        finally:
            LAW.raises = False
        if command.writes and act.lost:
            loop.unwritten(last, "the write did not arrive")
        elif command.writes:
            self.plant = float(command.mv[0])
        return Seen(act, before, accepted, stood, command, loop.mode, loop.fault, float(loop.mv[0]))

    def _asked(self, request: Mode | float | None) -> bool:
        try:
            if isinstance(request, Mode):
                self.loop.set_mode(request)
            elif request is not None:
                self.loop.set_mv(request)
        except LoopError:
            return False
        return request is not None

    def _sample(self, kind: str) -> Sample | None:
        if kind == "missed":
            return None
        back = None if "blind" in kind else np.array([9.0 if kind == "outside" else self.plant])
        return Sample(pv=np.array([5.0]), mv_applied=back, dv=np.zeros(0), age_s=9.0 if "refused" in kind else 0.0)


def _settled(loop: ControlLoop) -> ControlLoop:
    """The loop without what changes nothing that it does: counts of scans, words, what pages show of the last scan.

    No read-back is a little off its command here, so that no offset is learnt while commands rest; the law reads
    neither ``operate`` nor ``fresh``, so that it learns nothing of what others do and bridges nothing.
    """
    loop._scan = loop.courses._periods = 0
    loop._refused_why = "refused" if loop._refused_why else ""
    mode, mv, active = loop._mode, loop._mv, loop._active
    mode.fault, mode._held = ("fault" if mode.fault else ""), min(mode._held, 1)
    mv.found = mv._stood = None
    mv._plant._standing._rested = loop._out.local._rested = 0
    loop._out.local._command = np.zeros(1)
    active.stepped = active._given = active._inputs = None
    active._bridging._gone[:] = 0.0
    return loop
