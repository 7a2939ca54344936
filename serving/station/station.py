"""One loop as loop.toml says it: controller, plant, guards, journal; steered from outside between two scans."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.clock import MonotonicClock
from serving.controller import Controller
from serving.errors import LoopError
from serving.grid import RunReport
from serving.guard import Sample
from serving.journal import Event, Journal, Scan
from serving.loop import WARM_LEAD_S, Command, ControlLoop, Mode
from serving.manifest import Manifest, Signal
from serving.opcua.endpoint import OpcUaEndpoint, Values
from serving.station.lease import Lease
from serving.station.settings import Settings
from serving.words import first_line

Array: TypeAlias = NDArray[np.float64]

POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class Change:
    """What somebody wants changed: ``act`` does it, ``what`` says it, ``done`` is told how it went (empty: well)."""

    act: Callable[[ControlLoop], None]
    what: str
    who: str
    reason: str = ""
    done: Callable[[str], None] = lambda _: None


class Station:
    """Runs the loop of some settings.

    Between two scans it carries out the changes that were asked for (``ask``) and those of the plant's own operator
    (set points and mode by their nodes). Every scan, change and fault goes into the journal.

    Raises LoopError and ArtifactError where the settings do not fit the controller, another loop writes the same
    nodes, or the journal cannot be opened.
    """

    def __init__(self, settings: Settings, *, tell: Callable[[str], None] = lambda _: None) -> None:
        self.settings, self._say = settings, tell
        self.controller = Controller(settings.controller, settings.sha256 or None)
        m = self.manifest
        age = settings.max_age_s(m.period_s)
        self.guards, self.fallback = settings.guards.of(m, age), settings.hold.fallback(m.mv)
        self.clock = MonotonicClock(settings.speed)
        self.endpoint = OpcUaEndpoint(
            m, settings.server, settings.nodes, max_age_s=age, speed=settings.speed, tell=self._connection
        )
        points = settings.nodes.points("mv").values()
        self.lease = Lease(settings.server.endpoint, [p.node for p in points])
        try:
            self.journal = Journal(
                settings.journal.file, max_mb=settings.journal.max_mb, fsync=settings.journal.fsync, tell=self._trouble
            )
        except BaseException:
            self.lease.release()
            raise
        self.changes = queue.SimpleQueue[Change]()
        self.loop: ControlLoop | None = None
        self.last: tuple[Sample | None, Command] | None = None
        self.ended = False
        self._watchers: list[Callable[[Sample | None, Command], None]] = []
        self._asked_sp: dict[str, float] = {}
        self._asked_mode: str | None = None  # None: not read yet; what stands there at the start is no wish
        self._fault = ""

    @property
    def manifest(self) -> Manifest:
        """Of the controller that the loop began with; a successor has the same signals."""
        return self.controller.manifest

    def ask(self, change: Change) -> None:
        """Have a change carried out before the next scan; from any thread."""
        self.changes.put(change)

    def watch(self, seen: Callable[[Sample | None, Command], None]) -> None:
        """Call ``seen`` after each scan; what it raises ends nothing."""
        self._watchers.append(seen)

    def end(self) -> None:
        """Stop after the present scan."""
        self.ended = True

    def run(self, n: int | None = None) -> RunReport:
        """Connect, and scan until ``end`` or for ``n`` scans."""
        s, m = self.settings, self.manifest
        try:
            self.endpoint.start()
            first = self._first_values()
            pv = None if first is None else first.pv[: len(m.sp)]
            self.loop = ControlLoop(
                self.controller,
                self.endpoint,
                sp=_near(pv, m.sp),
                mv=_near(None if first is None else first.mv, m.mv),
                mode=Mode(s.start),
                guards=self.guards,
                recover_after=s.hold.recover_after or None,
                clock=self.clock,
                warm_lead_s=WARM_LEAD_S * s.speed,
                transfer_s=20 * m.period_s if s.transfer_s is None else s.transfer_s,
                fallback=self.fallback,
            )
            self.journal.begin(m, self.controller.sha256, time.time())
            self._note("change", "loop.toml", f"started in {s.start}")
            report = self.loop.run(n, before=self._before, observe=self._observe, until=lambda _: self.ended)
            self._note("change", "loop", "ended")
            return report
        finally:
            self.endpoint.close()
            self.journal.close()
            self.lease.release()

    # ------------------------------------------------------------------ around a scan
    def _first_values(self) -> Values | None:
        """The plant as it is. A loop that is to write waits for it; a shadow may begin without."""
        waited, limit = 0.0, self.settings.server.connect_s + 1
        while self.endpoint.values is None and not self.ended:
            if self.settings.start == "SHADOW" and waited >= limit:
                return None
            time.sleep(POLL_S)
            waited += POLL_S
        return self.endpoint.values

    def _before(self, k: int) -> None:
        """Changes that were asked for, here or on the plant's side."""
        assert self.loop is not None
        while not self.changes.empty():
            change = self.changes.get()
            try:
                change.act(self.loop)
            except LoopError as error:
                change.done(first_line(error))
                self._note("change", change.who, f"refused: {change.what} ({first_line(error)})", change.reason)
                continue
            change.done("")
            self._note("change", change.who, change.what, change.reason)
        values = self.endpoint.values
        if values is not None:
            self._plant_side(self.loop, values)

    def _plant_side(self, loop: ControlLoop, values: Values) -> None:
        """Set points and mode, where the plant's own operator changed them."""
        if values.asked_sp and values.asked_sp != self._asked_sp:
            self._asked_sp = dict(values.asked_sp)
            wanted = loop.sp
            for i, s in enumerate(self.manifest.sp):
                wanted[i] = values.asked_sp.get(s.name, wanted[i])
            self._from_plant(lambda: loop.set_sp(wanted), f"set point {_shown(wanted, self.manifest.sp)}")
        if values.asked_mode and values.asked_mode != self._asked_mode:
            wish, self._asked_mode = self._asked_mode is not None, values.asked_mode
            if wish:
                self._from_plant(lambda: loop.set_mode(Mode(values.asked_mode)), f"mode {values.asked_mode}")

    def _from_plant(self, act: Callable[[], None], what: str) -> None:
        try:
            act()
        except LoopError as error:
            self._note("change", "plant", f"refused: {what} ({first_line(error)})")
            return
        self._note("change", "plant", what)

    def _observe(self, sample: Sample | None, command: Command) -> None:
        """Write the scan down, and show it."""
        m, values = self.manifest, self.endpoint.values
        nan_mv, nan_pv = np.full(len(m.mv), np.nan), np.full(len(m.pv), np.nan)
        nothing = sample is None
        numbers = [
            *command.sp,
            *(nan_pv if sample is None else sample.pv),
            *(command.mv if command.writes else nan_mv),
            *(nan_mv if sample is None or sample.mv_applied is None else sample.mv_applied),
            *(nan_mv if command.law_mv is None else command.law_mv),
            *(nan_mv if command.successor_mv is None else command.successor_mv),
            *(np.full(len(m.dv), np.nan) if sample is None else sample.dv),
            *(np.full(len(m.info), np.nan) if command.info is None else command.info),
        ]
        quality = () if nothing or values is None else values.quality
        self.journal.scan(Scan(time.time(), command.mode.value, tuple(map(float, numbers)), quality, command.reason))
        if command.reason != self._fault:
            self._fault = command.reason
            self._note("fault", "loop", command.reason or "over")
        self.last = sample, command
        for seen in self._watchers:
            seen(sample, command)

    # ------------------------------------------------------------------ words
    def _note(self, kind: str, who: str, what: str, reason: str = "") -> None:
        self.journal.event(Event(time.time(), kind, who, what, reason))
        self._say(f"{who}: {what}" + (f" ({reason})" if reason else ""))

    def _connection(self, what: str) -> None:
        self._note("connection", "opcua", what)

    def _trouble(self, what: str) -> None:
        self._say(what)


def _near(values: Array | None, signals: tuple[Signal, ...]) -> list[float]:
    """A start within the ranges: what the plant has, or the middle where it is not known."""
    if values is None or not np.isfinite(values).all():
        return [s.middle for s in signals]
    return [_allowed(v, s) for v, s in zip(values.tolist(), signals, strict=True)]


def _allowed(value: float, signal: Signal) -> float:
    """The nearest value that the signal may have."""
    if signal.values is not None:
        return min(signal.values, key=lambda a: abs(a - value))
    return min(max(value, signal.low), signal.high)


def _shown(values: Array, signals: tuple[Signal, ...]) -> str:
    return ", ".join(f"{s.name} {v:g} {s.unit}" for s, v in zip(signals, values.tolist(), strict=True))
