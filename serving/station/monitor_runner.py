"""The monitor of whichever controller has the plant: fed with each scan, its alarms written down, its memory kept."""

from __future__ import annotations

import json
import sqlite3
import time
from contextlib import closing, suppress
from math import ceil

from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Sample
from loopwright.serving.journal import JournalReader
from loopwright.serving.loop import Command
from loopwright.serving.monitor import Monitor
from loopwright.serving.station.recorder import Recorder

ALARMING, ALARM = {"watch", "retrain"}, "monitor "
LOOK_S, KEEP_S = 10.0, 600.0  # between two looks at the verdicts, and two writings of what was learnt


class Watching:
    """A monitor for each controller that comes to the plant; one that was here before goes on where it was."""

    def __init__(self, controller: Controller, recorder: Recorder) -> None:
        self._recorder = recorder
        self._of = controller
        self._trouble = ""  # what was said last of what failed here
        self._levels = self._active()
        self._scans = 0  # the clock may be set; scans go on
        self.monitor = self._begun(controller)

    def seen(self, controller: Controller, scan: tuple[Sample | None, Command, float]) -> None:
        """A scan, with its time; now and then what the verdicts have become. It never raises."""
        try:
            self._seen(controller, scan)
        except Exception as error:  # a scan is more than what is thought of it
            self._failed(f"{type(error).__name__}: {error}")

    def _seen(self, controller: Controller, scan: tuple[Sample | None, Command, float]) -> None:
        if controller is not self._of:
            self.keep()
            self._over(self._levels)
            self._of, self._levels = controller, {}
            self.monitor = self._begun(controller)
        sample, command, time_s = scan
        self.monitor.observe(time_s, sample, command)
        self._scans += 1
        period_s = controller.manifest.period_s
        if self._scans % ceil(LOOK_S / period_s) == 0:
            self._look()
        if self._scans % ceil(KEEP_S / period_s) == 0:
            self.keep()

    def keep(self) -> None:
        """Write down what was learnt; a monitor whose numbers are none learns anew."""
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
        return Monitor(controller.manifest, started_s=time.time())

    def _anew(self, controller: Controller, why: str) -> Monitor:
        self._recorder.note("monitor", "monitor", f"what was learnt cannot be used, so it learns anew: {why}")
        return Monitor(controller.manifest, started_s=time.time())

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
