"""Record of each scan of a loop, and the monitor that is fed with it."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, suppress
from math import ceil, nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.clock import MACHINE_TIME, Time
from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Sample, kind_of, lasting
from loopwright.serving.journal import EventEntry, Journal, JournalReader, ScanEntry
from loopwright.serving.journal.entries import Kind
from loopwright.serving.loop import Command, ControlLoop, Mode
from loopwright.serving.manifest import Manifest
from loopwright.serving.monitor import Monitor
from loopwright.serving.monitor.weekly import WEEK, WeeklyCounts, counts_of, week_of
from loopwright.serving.station.left_out import LeftOut
from loopwright.serving.words import plain

Array: TypeAlias = NDArray[np.float64]


class Recorder:
    """Writes scans and events into a journal, and says each event as a line."""

    def __init__(
        self, journal: Journal, say: Callable[[str], None], speed: float = 1.0, time: Time = MACHINE_TIME
    ) -> None:
        self.journal, self._say, self._speed, self.time = journal, say, speed, time
        self._controller: Controller | None = None
        self._fault, self._trial, self._mode = "", "", ""
        self._bad: dict[str, bool] = {}  # PVs that were bridged, or left out (True)
        self._local: Mapping[str, str] = {}  # MVs that the plant had itself
        self._left_out = LeftOut(self._gone)

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
        self.journal.begin(controller.manifest, controller.sha256, self.time.wall_s(), self._speed)

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
        self.journal.event(EventEntry(self.time.wall_s(), kind, who, what, reason, alarm, raised, about))
        said = f"acknowledged: {what}" if kind == "acknowledged" else what
        self._say(f"{who}: {said}" + (f" ({reason})" if reason else ""))

    def scan(self, loop: ControlLoop, sample: Sample | None, command: Command) -> None:
        """Write a scan down, and the fault or the new controller that came with it."""
        numbers = tuple(map(float, _numbers(self.controller.manifest, sample, command)))
        quality = () if sample is None else sample.quality
        self.journal.scan(ScanEntry(self.time.wall_s(), command.mode.value, numbers, quality, command.fault))
        # A reason whose numbers change, such as an age, is the same fault.
        if command.fault != self._fault and kind_of(command.fault) != kind_of(self._fault):
            before, self._fault = self._fault, command.fault
            what = lasting(command.fault) or f"over: {lasting(before)}"
            self.note("fault", "loop", what, alarm="fault", raised=bool(command.fault))
        self._bridged(command)
        self._left_out.look(loop, sample, command)
        for name in loop.courses.finished:
            self.note("change", "loop", f"the course of {name} is over")
        self._taken(command)
        self._changed(command)
        if loop.controller is not self.controller:
            self.note("swap", "loop", f"{named(loop.controller)} has the plant, after {named(self.controller)}")
            self.begin(loop.controller)
        self._tried(loop)

    def _bridged(self, command: Command) -> None:
        """Say which PVs are bridged, left out, which is an alarm, and read again; a scan without a sample says none."""
        if command.law_mv is None:
            return
        now = {**dict.fromkeys(command.bridged, False), **dict.fromkeys(command.shed, True)}
        for name in [*now, *(n for n in self._bad if n not in now)]:
            before, out = self._bad.get(name), now.get(name)
            alarm = f"reading {name}"
            if out == before:
                continue
            if out is not None:
                why = lasting({**command.bridged, **command.shed}[name])
                words = f"PV {name} is left out" if out else f"{'over: ' if before else ''}PV {name} is bridged"
                self.note("fault", "loop", f"{words}: {why}", alarm=alarm if out or before else "", raised=out)
            else:
                words = f"PV {name} is read again"
                self.note("fault", "loop", f"over: {words}" if before else words, alarm=alarm if before else "")
        self._bad = now

    def _gone(self, what: str, name: str, raised: bool) -> None:
        """A PV that somebody has taken out leaves its range, or is back."""
        self.note("fault", "loop", what, alarm=f"range {name}", raised=raised)

    def _taken(self, command: Command) -> None:
        """Say which MVs the plant has itself, which is an alarm, and which it has given back."""
        before, self._local = self._local, command.local
        for name, why in command.local.items():
            if name not in before or kind_of(before[name]) != kind_of(why):
                self.note("fault", "loop", f"MV {name} is out: {lasting(why)}", alarm=f"actuator {name}", raised=True)
        for name in before:
            if name not in command.local:
                self.note("fault", "loop", f"over: MV {name} is the loop's again", alarm=f"actuator {name}")

    def _changed(self, command: Command) -> None:
        """Say that the mode is another one though nobody asked for it: HOLD by a fault, and the way back."""
        if self._mode and command.mode.value != self._mode:
            words = f"mode {self._mode} -> {command.mode.value}"
            self.note("change", "loop", words, lasting(command.fault), mode=command.mode)
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


ALARMING, ALARM = {"watch", "retrain"}, "monitor "
VERDICT_LOOK_S, KEEP_S = 10.0, 600.0  # between two looks at the verdicts, and two writings of what was learnt
KEEP_WEEK_S = 60.0  # between two writings of a week's counts: so much of them is lost at most when the process dies


class MonitorRunner:
    """A monitor for each controller that comes to the plant; one that was here before goes on where it was."""

    def __init__(self, controller: Controller, recorder: Recorder) -> None:
        self._recorder = recorder
        self._of = controller
        self._trouble = ""  # what was said last of what failed here
        self._levels = self._active()
        self._scans = 0  # the clock may be set; scans go on
        self.monitor = self._begun(controller)
        self.weekly = self._this_week()

    def seen(
        self, controller: Controller, scan: tuple[Sample | None, Command, float], operate: Array | None = None
    ) -> None:
        """A scan, with its time and what operators want; now and then what verdicts have become. It never raises."""
        try:
            self._seen(controller, scan, operate)
        except Exception as error:  # a scan is more than what is thought of it
            self._failed(f"{type(error).__name__}: {error}")

    def _seen(self, controller: Controller, scan: tuple[Sample | None, Command, float], operate: Array | None) -> None:
        if controller is not self._of:
            self.keep()
            self._over(self._levels)
            self._of, self._levels = controller, {}
            self.monitor = self._begun(controller)
        sample, command, time_s = scan
        self.monitor.observe(time_s, sample, command, operate)
        if self.weekly.counts and week_of(time_s) != self.weekly.week:
            self._keep_week()
        self.weekly.add(controller.manifest, sample, command, time_s, operate)
        self._scans += 1
        period_s = controller.manifest.period_s
        if self._scans % ceil(KEEP_WEEK_S / period_s) == 0:
            self._keep_week()
        if self._scans % ceil(VERDICT_LOOK_S / period_s) == 0:
            self._look()
        if self._scans % ceil(KEEP_S / period_s) == 0:
            self.keep()

    def _keep_week(self) -> None:
        self._recorder.journal.keep(f"{WEEK}{self.weekly.week}", self.weekly.text())

    def _this_week(self) -> WeeklyCounts:
        """The counts of the present week that a loop before this one has left."""
        week, kept = week_of(self._recorder.time.wall_s()), None
        with suppress(LoopError, sqlite3.Error), closing(JournalReader(self._recorder.journal.path)) as reader:
            kept = reader.learnt(f"{WEEK}{week}")
        if kept is not None:
            try:
                return WeeklyCounts(week, counts_of(kept))
            except (ValueError, RecursionError) as error:
                self._recorder.note("monitor", "monitor", f"this week is counted anew: {error}")
        return WeeklyCounts()

    def keep(self) -> None:
        """Write down what was counted and learnt; a monitor whose numbers are none learns anew."""
        if self.weekly.counts:
            self._keep_week()
        try:
            text = json.dumps(self.monitor.state(), allow_nan=False)
        except ValueError:
            self.monitor = self._anew(self._of, "it holds numbers that are not finite")
            return
        self._recorder.journal.keep(_name(self._of), text)

    def _begun(self, controller: Controller) -> Monitor:
        kept = None
        with suppress(LoopError, sqlite3.Error), closing(JournalReader(self._recorder.journal.path)) as reader:
            kept = reader.learnt(_name(controller))
        if kept is not None:
            try:
                return Monitor.restored(controller.manifest, json.loads(kept))
            except (ValueError, RecursionError) as error:
                return self._anew(controller, str(error))
        return Monitor(controller.manifest, started_s=self._recorder.time.wall_s())

    def _anew(self, controller: Controller, why: str) -> Monitor:
        self._recorder.note("monitor", "monitor", f"what was learnt cannot be used, so it learns anew: {why}")
        return Monitor(controller.manifest, started_s=self._recorder.time.wall_s())

    def _failed(self, trouble: str) -> None:
        """Say once what failed."""
        if trouble != self._trouble:
            self._trouble = trouble
            with suppress(Exception):  # it may be this very journal
                self._recorder.note("monitor", "monitor", f"the monitor cannot be looked at: {trouble}")

    def _active(self) -> dict[str, str]:
        """The verdicts whose alarms a loop before this one left active; those of another controller end."""
        with suppress(LoopError, sqlite3.Error), closing(JournalReader(self._recorder.journal.path)) as reader:
            active = [e.event for e in reader.active() if e.event.kind == "monitor"]
            levels = {event.alarm.removeprefix(ALARM): [*event.what.split(": "), ""][1] for event in active}
            runs = reader.runs()
            if runs and runs[-1]["sha256"] == self._of.sha256:
                return levels
            self._over(levels)
        return {}

    def _over(self, levels: dict[str, str]) -> None:
        """End the alarms of a controller that has the plant no more."""
        for name, level in levels.items():
            if level in ALARMING:
                what = f"{name}: over, for another controller has the plant"
                self._recorder.note("monitor", "monitor", what, alarm=f"{ALARM}{name}")

    def _look(self) -> None:
        """An alarm for each verdict that has become one, and its end."""
        for verdict in self.monitor.verdicts():
            before = self._levels.get(verdict.name, "")
            self._levels[verdict.name] = verdict.level
            alarming = verdict.level in ALARMING
            if verdict.level != before and (alarming or before in ALARMING):
                self._recorder.note(
                    "monitor",
                    "monitor",
                    f"{verdict.name}: {verdict.level}: {verdict.text}",
                    alarm=f"{ALARM}{verdict.name}",
                    raised=alarming,
                )


def _name(controller: Controller) -> str:
    return f"monitor {controller.sha256}"
