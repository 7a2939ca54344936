"""One loop as loop.toml says it: controller, plant, guards, journal; steered from outside between two scans."""

from __future__ import annotations

import queue
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.controller import Controller
from loopwright.serving.errors import LoopError, LoopwrightError
from loopwright.serving.first_steps import tried
from loopwright.serving.guard import Sample
from loopwright.serving.journal import JournalReader
from loopwright.serving.loop import Command, ControlLoop, Mode
from loopwright.serving.manifest import Manifest
from loopwright.serving.opcua.certificates import expiries
from loopwright.serving.opcua.nameplates import Identity, others_since
from loopwright.serving.opcua.sampling import Values
from loopwright.serving.page.process import PageProcess
from loopwright.serving.scan_grid import RunReport
from loopwright.serving.station.build_loop import (
    another_before,
    begun_at,
    control_loop,
    keep_namespaces,
    keep_nodes,
    namespaces_before,
    near,
    nodes_before,
    usable,
)
from loopwright.serving.station.control import Answer, Control
from loopwright.serving.station.housekeeping import LinePrinter
from loopwright.serving.station.last_courses import LastCourses
from loopwright.serving.station.last_run import Steered
from loopwright.serving.station.machine import THIS_MACHINE, Machine
from loopwright.serving.station.mv_lock import Lease, Locks
from loopwright.serving.station.plant_side import PlantSide, shown_values
from loopwright.serving.station.recorder import MonitorRunner, Recorder
from loopwright.serving.station.requests import Change, Request, change
from loopwright.serving.station.settings import Settings
from loopwright.serving.station.views import VIEWS, Snapshot
from loopwright.serving.trust import Controller as TrustedController
from loopwright.serving.trust import ending, judged, signer
from loopwright.serving.words import first_line

if TYPE_CHECKING:
    from loopwright.serving.signing.keys import PublicKey

Array: TypeAlias = NDArray[np.float64]

# between two looks for the first values, and until it is said that there are none
FIRST_VALUES_POLL_S, SILENCE_S = 0.05, 1.0
LONGEST_SCAN_WAIT_S = 5.0  # [s] that a request waits for the end of a scan


class Station:
    """Runs the loop of some settings.

    Between two scans it carries out the changes that were asked for (``ask``) and those of the plant's own operator
    (set points, values of ``operate`` and mode by their nodes). Every scan, change and fault goes into the journal.

    ``tell`` gets a line of each event, in a thread of its own: it may block or raise. ``controller`` is the one of the
    settings' file; None: it is loaded here, once another process has taken its first steps
    (``loopwright.serving.first_steps``). ``machine`` is the one that it runs on.

    Raises LoopError and ArtifactError where the settings do not fit the controller, another loop writes the same
    nodes, or the journal cannot be opened.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        tell: Callable[[str], None] = lambda _: None,
        controller: TrustedController | None = None,
        machine: Machine = THIS_MACHINE,
    ) -> None:
        self.machine, self.time = machine, machine.time
        self.settings, self.printer = settings, LinePrinter(tell)
        self.tell = tell = self.printer.say
        self.trusted = self._public_keys()
        self.certificates = expiries(settings.server)
        self.controller = controller or tried(settings.controller, settings.sha256 or None, self.trusted)
        m = self.manifest
        age = settings.max_age_s(m.period_s)
        control_loop(settings, self.controller)  # settings that do not fit it are said before it is connected
        self.clock = self.time.paced(settings.speed)
        self.endpoint = machine.endpoint(
            m,
            settings.server,
            settings.nodes,
            max_age_s=age,
            speed=settings.speed,
            tell=self._connection,
            spaces=namespaces_before(settings.journal.file, settings.server.endpoint),
            identified=self._identified,
            clock=self.time.steady_s,
        )
        points = settings.nodes.points("mv").values()
        self.lease = Lease(settings.server.endpoint, [p.node for p in points], machine.locks)
        try:
            kept = settings.journal
            self.journal = machine.journal(kept.file, max_mb=kept.max_mb, fsync=kept.fsync, tell=tell, time=self.time)
        except BaseException:
            self.lease.release()
            raise
        self._steered = Steered.before(settings.journal.file)
        self._courses = LastCourses.before(settings.journal.file)
        self.recorder = Recorder(self.journal, tell, settings.speed, self.time)
        self.recorder.end_old_alarms()
        self.locks = Locks(self.lease, self.recorder)
        self.watching = MonitorRunner(self.controller, self.recorder)
        self.changes = queue.SimpleQueue[Change]()
        self.loop: ControlLoop | None = None
        self.snapshot: Snapshot | None = None  # of the last scan; all that other threads read of it
        self._left_at: Array | None = None  # shape: (n_mv,), the last command that was known
        self.scans = self._faults = self._missed_periods = 0
        self._begun_unseen = False  # begun without a value of the plant, and none since
        self.warnings: list[str] = []
        self.ended = False
        self.page: PageProcess | None = None
        self._watchers: list[Callable[[Sample | None, Command], None]] = []
        self.plant_side = PlantSide(settings, m, self.recorder)
        self._seen_before = nodes_before(settings.journal.file)

    @property
    def manifest(self) -> Manifest:
        """Manifest of the first controller: the signals that are read, whichever controller takes over."""
        return self.controller.manifest

    @property
    def active_controller(self) -> Controller:
        """The controller in charge after the last scan."""
        return self.controller if self.snapshot is None else self.snapshot.controller

    def ending(self) -> list[str]:
        """A line for what the loop runs by and that ends soon: its controller's signature, its certificate."""
        lines = ending(self.active_controller)
        return [*lines, *filter(None, (certificate.words() for certificate in self.certificates))]

    def ask(self, change: Change) -> None:
        """Have a change carried out before the next scan; from any thread."""
        self.changes.put(change)

    def watch(self, seen: Callable[[Sample | None, Command], None]) -> None:
        """Call ``seen`` after each scan; what it raises ends nothing."""
        self._watchers.append(seen)

    def end(self) -> None:
        """Stop before the next scan, without waiting for it; from any thread, and from the handler of a signal."""
        self.ended = True
        self.clock.end()
        if self.page is not None:
            self.page.leaving = True  # whoever ends the loop may have ended its page, too

    def run(self, n: int | None = None) -> RunReport:
        """Connect, and scan until ``end`` or for ``n`` scans."""
        s, m = self.settings, self.manifest
        with ExitStack() as stack:
            for held in (self.printer.end, self.lease.release, self.journal.close):
                stack.callback(held)
            control = self.machine.door(s.journal.file, self.answer)
            stack.callback(control.close)
            stack.callback(self.machine.tended(lambda: self._tend(control), self.locks.untended).close)
            self._serve(stack, control)
            stack.callback(self.watching.keep)
            stack.callback(self.endpoint.close)
            self.endpoint.start()
            first = self._first_values()
            if self.ended:
                self.recorder.note("change", "loop", "ended before the first scan: nothing was written")
                return RunReport(0, 0, 0, 0.0)
            self._begun_unseen = first is None
            pv = None if first is None else first.pv[: len(m.sp)]
            mv = None if first is None else begun_at(first.mv, m.mv)
            self.loop = control_loop(s, self.controller, self.endpoint, sp=near(pv, m.sp), mv=mv, clock=self.clock)
            before = another_before(s.journal.file, self.controller)
            self.recorder.begin(self.controller)
            if before:
                self.recorder.note("swap", "loop.toml", before)
            signed = signer(self.controller)
            by = "" if signed is None else f"; {self.controller.path.name} is signed by {signed.words}"
            unproven = judged(m).words if s.start == "AUTO" else ""
            accepted = f"accepted though {unproven}" if unproven else ""
            self.recorder.note("change", "loop.toml", f"started in {s.start}{by}", accepted)
            self._take_back(self.loop)
            report = self.loop.run(n, before=self._before, observe=self._observe, stop=lambda: self.ended)
            self.recorder.note("change", "loop", "ended")
            return report

    def _tend(self, control: Control) -> None:
        """Keep the files that lie in a folder for temporary ones."""
        try:
            self.locks.tend()
        finally:
            control.tend()

    def _serve(self, stack: ExitStack, control: Control) -> None:
        """The page, where one is asked for."""
        wanted = self.settings.served()
        if wanted is not None:
            page = PageProcess(wanted, self.settings.journal.file, control.path, self.tell)
            stack.callback(page.close)
            self.page = page
            self.tell(
                f"page: {page.url}  token for changes: {page.token if wanted.token_file is None else 'in its file'}"
            )

    # ------------------------------------------------------------------ around a scan
    def _first_values(self) -> Values | None:
        """The plant as it is. A loop that is to write waits for it; a shadow may begin without."""
        waited, limit = 0.0, self.settings.server.connect_s + 1
        while not usable(self.endpoint.values) and not self.ended:
            if self.settings.start == "SHADOW" and waited >= limit:
                return None
            self.time.wait(FIRST_VALUES_POLL_S)
            if waited < SILENCE_S <= waited + FIRST_VALUES_POLL_S:
                self.tell("the plant gives no values yet: the loop goes on trying; Ctrl-C ends it")
            waited += FIRST_VALUES_POLL_S
        return self.endpoint.values if usable(self.endpoint.values) else None

    def _before(self, k: int) -> None:
        """Changes that were asked for, here or on the plant's side."""
        assert self.loop is not None
        self._missed_periods = k - self.scans
        self._at_last(self.loop)
        # Before the first scan nobody knows where the MV stands.
        while self.scans and not self.changes.empty():
            change = self.changes.get()
            try:
                change.act(self.loop)
            except LoopwrightError as error:
                change.done(first_line(error))
                self.recorder.note(
                    change.kind, change.who, f"refused: {change.what} ({first_line(error)})", change.reason
                )
                continue
            change.done("")
            self.recorder.note(change.kind, change.who, change.what, change.reason, mode=change.mode)
        values = self.endpoint.values
        if values is not None and self.scans:
            self.plant_side.carry_out(self.loop, values)
        self.locks.keep(self.loop)

    def _take_back(self, loop: ControlLoop) -> None:
        """Set what the last loop had, or say it; courses last, for a set point of an operator ends one."""

        def note(what: str, reason: str) -> None:
            self.recorder.note("change", "loop.toml", what, reason)

        if self.settings.restore:
            self._steered.restore(loop, note)
            self._courses.restore(loop, note, self.time.wall_s(), self.settings.speed)
        else:
            self._steered.compare(loop, note)
            self._courses.compare(loop, note, self.time.wall_s())

    def _at_last(self, loop: ControlLoop) -> None:
        """A shadow that began without the plant begins at its PVs once it sees them, unless a set point was named."""
        values, sp = self.endpoint.values, self.manifest.sp
        if self._begun_unseen and values is not None and usable(values):
            self._begun_unseen = False
            if loop.sp.tolist() == near(None, sp):
                loop.set_sp(near(values.pv[: len(sp)], sp))
                self.recorder.note("change", "loop", f"set point {shown_values(loop.sp, sp)}", "where the plant stands")

    def _observe(self, sample: Sample | None, command: Command) -> None:
        """Write the scan down, and show it."""
        assert self.loop is not None
        self._moved(self.loop)
        self.scans, self._faults = self.scans + 1, self._faults + bool(command.fault)
        seen, stepped = (sample, command, self.time.wall_s()), self.recorder.controller
        if self.loop.controller is not stepped:
            self.endpoint.serve(self.loop.controller.manifest)
        if not np.isnan(command.mv).any():
            self._left_at = command.mv
        steered = Steered.of(self.loop, self._steered)
        if steered != self._steered:
            self._steered = steered
            steered.keep(self.journal)
        courses = LastCourses.of(self.loop, self._courses, seen[2], self.settings.speed)
        if courses != self._courses:
            courses.keep(self.journal)
        self._courses = courses
        try:
            self.recorder.scan(self.loop, sample, command)
            operate = np.asarray(self.loop.operate) if self.loop.controller is stepped else None
            self.watching.seen(stepped, seen, operate)
        finally:  # a scan that cannot be written down is a scan
            counts = self._missed_periods, self._faults
            self.snapshot = Snapshot.of(self.loop, self.watching, seen, stepped, counts, self.snapshot)
        for show in self._watchers:
            show(sample, command)

    def _moved(self, loop: ControlLoop) -> None:
        """Say where an MV stands that somebody else moved while the loop could not write."""
        if loop.found is None or self._left_at is None or np.array_equal(loop.found, self._left_at):
            return
        found, left = (shown_values(mv, self.manifest.mv) for mv in (loop.found, self._left_at))
        self.recorder.note("change", "plant", f"the MV stands at {found}, not at {left}: the loop goes on from there")

    # ------------------------------------------------------------------ requests
    def _public_keys(self) -> list[PublicKey] | None:
        """The keys as they are at the start: whoever changes their files later changes nothing here."""
        if self.settings.trusted is None:
            return None
        from loopwright.serving.signing.verify import public_keys  # here: it needs the package cryptography

        return public_keys(self.settings.trusted)

    def _opened(self, file: str, sha256: str | None) -> Controller:
        """A controller that is to be tried; a relative path lies beside the one in charge.

        Its first steps are another process's: a file that ends a process does not end this one.
        """
        return tried(self.active_controller.path.parent / file, sha256, self.trusted)

    def answer(self, tree: Any) -> Answer:
        """The answer to a request, from any thread: a view, or the change once a scan has carried it out."""
        if isinstance(tree, dict) and isinstance(tree.get("do"), str) and tree["do"] in VIEWS:
            return VIEWS[tree["do"]](self)
        request = Request.read(tree)
        if self.settings.accept_unproven:
            request = replace(request, accept_unproven=True)
        if request.do == "acknowledge":
            return self._acknowledge(request)
        if self.loop is None:
            raise LoopError(f"the loop has not begun yet: {self.endpoint.trouble}")
        said = queue.SimpleQueue[str]()
        wanted = replace(change(request, self.loop, self._opened), done=said.put)
        self.ask(wanted)
        period = self.manifest.period_s / self.settings.speed
        try:
            refused = said.get(timeout=min(2 * period, LONGEST_SCAN_WAIT_S))
        except queue.Empty:
            return {"done": f"{wanted.what}: with the next scan, within {period:g} s"}
        if refused:
            raise LoopError(refused)
        return {"done": wanted.what}

    def _acknowledge(self, request: Request) -> Answer:
        """Write down who has seen an alarm."""
        with closing(JournalReader(self.settings.journal.file)) as reader:
            entry = reader.entry(request.value) if type(request.value) is int else None
        if entry is None or not entry.event.raised:
            raise LoopError(f"there is no alarm {request.value!r}")
        if entry.acknowledged is not None:
            raise LoopError(f"{entry.acknowledged.who} has acknowledged it already")
        self.recorder.note("acknowledged", request.who, entry.event.what, request.reason, about=entry.id)
        return {"done": f"acknowledged: {entry.event.what}"}

    def _identified(self, found: Identity) -> None:
        """The server is known now: what it tells is kept, and its nodes locked however others spell them."""
        for line in others_since(self._seen_before, found.seen):
            self.recorder.note("change", "plant", line)
        self._seen_before = {}  # from now on another type, unit or range is a fault
        if found.seen:
            keep_nodes(self.journal, found.seen)
        if found.spaces:
            keep_namespaces(self.journal, self.settings.server.endpoint, found.spaces)
        self.locks.identified(found, writes=self.loop is not None and self.loop.mode is not Mode.SHADOW)

    def _connection(self, what: str) -> None:
        self.recorder.note("connection", "opcua", what, alarm="connection", raised=not self.endpoint.connected)
