"""Record of each scan of a loop: the numbers, and what began or ended with it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from math import nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Sample, kind_of, lasting
from loopwright.serving.journal import Event, Journal, JournalReader, Scan
from loopwright.serving.journal.entries import Kind
from loopwright.serving.loop import Command, ControlLoop, Mode
from loopwright.serving.manifest import Manifest
from loopwright.serving.words import plain

Array: TypeAlias = NDArray[np.float64]


class Recorder:
    """Writes scans and events into a journal, and says each event as a line."""

    def __init__(self, journal: Journal, say: Callable[[str], None], speed: float = 1.0) -> None:
        self.journal, self._say, self._speed = journal, say, speed
        self._controller: Controller | None = None
        self._fault, self._trial, self._mode = "", "", ""

    @property
    def controller(self) -> Controller:
        """The one whose scans are written down: at a swap the scan that ended the trial is still the old one's."""
        assert self._controller is not None
        return self._controller

    def end_old_alarms(self) -> None:
        """End the alarms of a loop that was killed: what is wrong now is seen anew."""
        with suppress(LoopError), closing(JournalReader(self.journal.path)) as reader:
            for event in [e.event for e in reader.active() if e.event.kind in {"fault", "connection"}]:
                self.note(event.kind, "loop", "over: the loop begins anew", alarm=event.alarm)

    def begin(self, controller: Controller) -> None:
        """The scans that follow are of this controller."""
        self._controller = controller
        self.journal.begin(controller.manifest, controller.sha256, time.time(), self._speed)

    def note(
        self,
        kind: Kind,
        who: str,
        what: str,
        reason: str = "",
        *,
        alarm: str = "",
        raised: bool = False,
        about: int = 0,
        mode: Mode | None = None,
    ) -> None:
        """Write an event down, and say it; ``mode`` is what somebody changed the mode to.

        A server's or a file's text is spelt out where it would act on a reader.
        """
        what, reason = plain(what), plain(reason)
        if mode is not None:
            self._mode = mode.value
        self.journal.event(Event(time.time(), kind, who, what, reason, alarm, raised, about))
        said = f"acknowledged: {what}" if kind == "acknowledged" else what
        self._say(f"{who}: {said}" + (f" ({reason})" if reason else ""))

    def scan(self, loop: ControlLoop, sample: Sample | None, command: Command) -> None:
        """Write a scan down, and the fault or the new controller that came with it."""
        numbers = tuple(map(float, _numbers(self.controller.manifest, sample, command)))
        quality = () if sample is None else sample.quality
        self.journal.scan(Scan(time.time(), command.mode.value, numbers, quality, command.reason))
        # A reason whose numbers change, such as an age, is the same fault.
        if command.reason != self._fault and kind_of(command.reason) != kind_of(self._fault):
            before, self._fault = self._fault, command.reason
            what = lasting(command.reason) or f"over: {lasting(before)}"
            self.note("fault", "loop", what, alarm="fault", raised=bool(command.reason))
        self._changed(command)
        if loop.controller is not self.controller:
            self.note("swap", "loop", f"{named(loop.controller)} has the plant, after {named(self.controller)}")
            self.begin(loop.controller)
        self._tried(loop)

    def _changed(self, command: Command) -> None:
        """Say that the mode is another one though nobody asked for it: HOLD by a fault, and the way back."""
        if self._mode and command.mode.value != self._mode:
            words = f"mode {self._mode} -> {command.mode.value}"
            self.note("change", "loop", words, lasting(command.reason), mode=command.mode)
        self._mode = command.mode.value

    def _tried(self, loop: ControlLoop) -> None:
        """Say once why a trial began anew."""
        reason = "" if loop.successor is None else loop.successor.reason
        if reason and kind_of(reason) != kind_of(self._trial) and loop.successor is not None:
            self.note("swap", "loop", f"the trial of {named(loop.successor.controller)} begins anew", reason)
        self._trial = reason


def named(controller: Controller) -> str:
    """A controller in a sentence."""
    return f"{controller.manifest.law} ({controller.path.name}, {controller.sha256[:12]})"


def _numbers(m: Manifest, sample: Sample | None, command: Command) -> Iterator[float]:
    """The columns of ``loopwright.serving.journal.columns``."""
    n_mv = len(m.mv)
    yield from _listed(command.sp, len(m.sp))
    yield from _listed(None if sample is None else sample.pv, len(m.pv))
    yield from _listed(command.mv if command.writes else None, n_mv)
    yield from _listed(None if sample is None else sample.mv_applied, n_mv)
    yield from _listed(command.law_mv, n_mv)
    yield from _listed(command.successor_mv, n_mv)
    yield from _listed(None if sample is None else sample.dv, len(m.dv))
    yield from _listed(command.info, len(m.info))


def _listed(values: Array | None, n: int) -> Iterable[float]:
    """``values``, or ``n`` times NaN. A list is gone through several times as fast as an array."""
    if values is None:
        return [nan] * n
    # A refused sample may hold anything.
    numbers: Iterable[float] = values.tolist() if isinstance(values, np.ndarray) else values
    return numbers
