"""The loop around a controller: modes, faults, and an absolute time grid."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from math import nan
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.serving.clock import Clock, MonotonicClock
from loopwright.serving.controller import Controller
from loopwright.serving.endpoint import Endpoint
from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Guard, Sample, default_guards
from loopwright.serving.in_charge.active_controller import ActiveController, Guards, LawInputs
from loopwright.serving.in_charge.successor import Successor
from loopwright.serving.modes import Command, Fallback, LoopMode, Mode, Transfer, mode_of
from loopwright.serving.mvs.commanded import CommandedMV
from loopwright.serving.mvs.out_of_use import OutOfUse
from loopwright.serving.preview.course import Courses, Points
from loopwright.serving.ranges import within
from loopwright.serving.scan_grid import RunReport, run_on_grid
from loopwright.serving.words import first_line

__all__ = ["WARM_LEAD_S", "Command", "ControlLoop", "Mode", "within"]

Array: TypeAlias = NDArray[np.float64]

WARM_LEAD_S = 4e-4  # within the clock's spin, so that the processor does not sleep between warm-up and deadline


class ControlLoop:
    """One controller on one plant.

    AUTO commands the law's MV. MANUAL commands the operator's MV; the law is still stepped with the applied MV, so the
    transfer to AUTO is bumpless. HOLD keeps the last applied MV. SHADOW writes nothing: the law is stepped on what
    others do with the plant. A fault in AUTO changes the mode to HOLD, and the command names the reason;
    ``recover_after`` good samples change it back. A fault that lasts is for ``fallback``. After a gap the law starts
    cold (state = 0). A law that reads ``fresh`` goes on without a PV whose reading alone is bad; the command names it.
    One with ``use`` of an MV goes on without that MV, where an operator has it in hand or the plant has it itself, see
    ``loopwright.serving.mvs``. Limits of all that is written are those of ``loopwright.serving.mvs.commanded``.

    Parameters
    ----------
    controller, endpoint
        The law, and what reads and writes the plant; only ``run`` needs that.
    sp, mode
        Set points (n_sp,) and mode at the start.
    mv
        The MV that the plant has now (n_mv,). None: it is not known; nothing is written until a good sample tells.
    guards
        Checks that can refuse a sample, or what makes them for a controller's manifest: they are then made anew for
        each controller that takes over. ``default_guards`` unless given.
    recover_after
        Good samples after which HOLD returns to AUTO after a fault; None: only the operator returns it.
    clock
        Time for ``run``; the machine's unless given.
    warm_lead_s
        Lead time of the warm-up before each deadline [s]; 0: no warm-up.
    max_gap
        Missed periods in a row after which the law starts cold.
    transfer_s
        After a change to AUTO or of the controller, an MV crosses its range at most once in this time [s], until it
        is where the law wants it; 0: at once. See ``loopwright.serving.modes``.
    fallback
        What to do when a fault lasts; None: the MV stays. See ``loopwright.serving.modes``.
    operate
        Values of the law's ``operate`` by name at the start; its defaults for the rest.
    bridge_s, critical
        Time for which the bad reading of a PV is bridged [s], ten periods unless given, and the names of PVs without
        which the loop holds after it. See ``loopwright.serving.bridging``.
    local_s
        Time for which an MV may be elsewhere than it was commanded [s], see ``loopwright.serving.mvs.local_mvs``.
    learns
        Whether a law with ``operate`` goes on from what is commanded where others command, by a second step in such a
        scan; else from its own last MV, as hosts in other languages do.

    Raises
    ------
    LoopError
        A set point or MV outside its range, or of the wrong length; a name or a value that is none of ``operate``.
    """

    def __init__(
        self,
        controller: Controller,
        endpoint: Endpoint | None = None,
        *,
        sp: ArrayLike,
        mv: ArrayLike | None = None,
        mode: Mode = Mode.MANUAL,
        guards: Guards | None = None,
        recover_after: int | None = None,
        clock: Clock | None = None,
        warm_lead_s: float = WARM_LEAD_S,
        max_gap: int = 3,
        transfer_s: float = 0.0,
        fallback: Fallback | None = None,
        operate: Mapping[str, float] | None = None,
        bridge_s: float | None = None,
        critical: Sequence[str] = (),
        local_s: float | None = None,
        learns: bool = True,
    ) -> None:
        manifest = controller.manifest
        self._mode = LoopMode(mode, manifest.period_s, recover_after, fallback)
        self._transfer = Transfer(manifest.mv, manifest.period_s, transfer_s)
        guards = default_guards if guards is None else guards
        self._active = ActiveController(controller, guards, bridge_s=bridge_s, critical=critical)
        self._out = OutOfUse(manifest.mv, manifest.period_s, local_s)
        if operate:
            self.set_operate(operate)
        self.manifest = manifest  # of the first controller: its signals are what the loop reads, whoever is in charge
        self.endpoint = endpoint
        self.clock: Clock = clock or MonotonicClock()
        self.warm_lead_s = min(warm_lead_s, manifest.period_s / 4)
        self.max_gap, self.learns = max_gap, learns
        if fallback is not None:
            fallback.check(manifest.mv, endpoint)
        self._sp = within(sp, manifest.sp, "set point")
        stands = np.full(len(manifest.mv), nan) if mv is None else within(mv, manifest.mv, "MV")
        self._mv = CommandedMV(manifest.mv, stands, self._out)
        self._refused_why = ""  # why the last sample was refused; empty after a good one, and before the first
        self._scan = 0  # that comes next
        self._transfer.begin()

    # ------------------------------------------------------------------ who is in charge
    @property
    def controller(self) -> Controller:
        """The controller in charge."""
        return self._active.controller

    @property
    def successor(self) -> Successor | None:
        """The controller that is tried beside it, see ``swap``."""
        return self._active.successor

    @property
    def replaced(self) -> Controller | None:
        """The controller that was in charge before it."""
        return self._active.replaced

    @property
    def guards(self) -> tuple[Guard, ...]:
        """The guards of the controller in charge."""
        return self._active.guards

    @property
    def stepped(self) -> LawInputs | None:
        """Inputs of the law's last step; None before the first one of the controller in charge."""
        return self._active.stepped

    def swap(self, controller: Controller, trial: int) -> None:
        """Try ``controller`` for ``trial`` good scans in a row beside the one in charge, then give it the plant.

        Until then its MV stands in ``Command.successor_mv``. It may read fewer PVs and measured disturbances than the
        loop does. LoopError where its period, set points or MVs are others, or it has a signal that the loop has not.
        """
        self._active.swap(controller, trial, self.manifest)

    def keep(self) -> None:
        """End the trial of a successor; the controller in charge stays."""
        self._active.successor = None

    # ------------------------------------------------------------------ operator
    @property
    def mode(self) -> Mode:
        """Present mode."""
        return self._mode.now

    @property
    def sp(self) -> Array:
        """Present set points, shape (n_sp,)."""
        return self._sp.copy()

    @property
    def mv(self) -> Array:
        """Last commanded MV, shape (n_mv,); NaN while it is not known where the MV stands."""
        return self._mv.now.copy()

    @property
    def found(self) -> Array | None:
        """Where the MV stands (n_mv,), at the scan that learns it after a command that did not reach the plant."""
        return self._mv.found

    @property
    def mv_wanted(self) -> Array:
        """Where the MV goes by hand, shape (n_mv,); the last commanded one where it is there."""
        return self._mv.goal

    @property
    def local(self) -> dict[str, str]:
        """The MVs that the plant has itself, each with the reason."""
        return dict(self._out.local.why)

    @property
    def fault(self) -> str:
        """The fault that changed the mode to HOLD; empty without one."""
        return self._mode.fault

    def set_mode(self, mode: Mode) -> None:
        """Set the mode, as a Mode or its name; it takes effect at the next scan.

        LoopError for another word, and where a shadow that has no good sample now is to move the plant.
        """
        mode = mode_of(mode)
        if self.mode is Mode.SHADOW and mode is not Mode.SHADOW and (why := self._refused_why):
            raise LoopError(f"the last sample was refused ({why}): where the MV stands is not known; wait")
        if mode is not self.mode:
            self._transfer.begin()
            self._mv.begun(mode, self.mode, self._active.in_hand)
        self._mode.set(mode)

    def set_sp(self, sp: ArrayLike) -> tuple[str, ...]:
        """Change the set points (n_sp,), whose courses end; the names of those. LoopError outside their ranges."""
        before, self._sp = self._sp, within(sp, self.controller.manifest.sp, "set point")
        moved = zip(self.manifest.sp, before.tolist(), self._sp.tolist(), strict=True)
        return self.courses.end([s.name for s, old, new in moved if old != new])

    @property
    def courses(self) -> Courses:
        """The courses of set points and measured disturbances; ``set_course`` gives some, and its ``end`` ends them."""
        return self._active.courses

    def set_course(self, points: Mapping[str, Points], straight: Collection[str] = (), who: str = "") -> None:
        """Give known set points and forecasts of measured disturbances, by name, as points (time [s], value).

        Times count from the next scan on, see ``Courses``; ``who`` is who gave it. LoopError for a law that does not
        read ``ahead``, and for points that cannot be; then nothing is changed.
        """
        self.require_course(points, straight)
        self.courses.give(points, straight, who)

    def require_course(self, points: Mapping[str, Points], straight: Collection[str] = ()) -> None:
        """LoopError where ``set_course`` would refuse."""
        self._active.require_ahead()
        self.courses.checked(points, straight)

    @property
    def operate(self) -> Array:
        """Present values of ``operate``, shape (n_operate,), as the manifest of the controller in charge lists them."""
        return self._active.operate.copy()

    def set_operate(self, values: Mapping[str, float]) -> None:
        """Change some of ``operate`` by name, from the next scan on.

        No transfer begins: the law moves the MVs by no more than it may. LoopError for a law that does not read
        ``operate``, an unknown name, and a value that is not allowed; then nothing is changed.
        """
        self._active.set_operate(values)
        self._out.operated(values)

    @property
    def wishes(self) -> dict[str, float]:
        """The values of ``operate`` that somebody has set since the loop began, by name."""
        return dict(self._active.wishes)

    def operate_with(self, values: Mapping[str, float]) -> Array:
        """``operate`` (n_operate,) as ``set_operate`` would leave it; LoopError where that would refuse."""
        return self._active.operate_with(values)

    def set_mv(self, mv: ArrayLike, take: Collection[str] = ()) -> None:
        """Set the MV (n_mv,) by hand; one with a ``max_move`` goes there scan by scan, see ``mv_wanted``.

        The MVs named in ``take`` are taken out of the law's use with it. LoopError outside its range, for a change that
        ``require_in_hand`` refuses, and until it is known where the MV stands after a command that did not reach the
        plant; then nothing is changed.
        """
        signals = self.controller.manifest.mv
        wanted = within(mv, signals, "MV")
        self.require_in_hand({*self._out.others(self._mv.now, wanted), *take}, take)
        self._mv.require_arrived()
        taken = np.array([s.name in take for s in signals]) & ~self._active.in_hand
        if taken.any():
            self.set_operate({f"{s.name}.use": 0.0 for s, of in zip(signals, taken.tolist(), strict=True) if of})
        self._mv.send(wanted, signals, taken, self.mode)

    def require_in_hand(self, names: Collection[str], take: Collection[str] = ()) -> None:
        """LoopError unless operators have these MVs in hand: all in MANUAL, those of ``use`` 0 in AUTO and HOLD.

        Those named in ``take`` may also be the law's, where it can do without them.
        """
        self._out.require(names, self.mode, self._active.mv_entries, self._active.operate, take)

    def hand_back(self) -> None:
        """The plant is with its own controller now: this loop writes no more, until the mode is set again."""
        self.set_mode(Mode.SHADOW)

    # ------------------------------------------------------------------ one scan
    def scan(self, sample: Sample) -> Command:
        """The MV of the next period. No I/O and no clock; no content of a sample raises an exception."""
        self._sp = self.courses.followed(self._sp, self.controller.manifest.sp)
        sample = self._out.look(sample, self._active.mv_entries, lost=self._mv.untold)
        readings = self._active.look(sample, self._out.local.why)
        reason, self._refused_why = readings.reason, ""
        shown = self._mv.look(sample, reason, self.mode, self._active.in_hand)
        if shown.silent:
            return self._without_sample(shown.silent, silent=True)
        if reason:
            return self._without_sample(reason)
        applied = self._mv.begins(shown.applied)
        try:
            applied = self._mv.read_back(sample, shown.applied)
            self._mv.move_by_hand(self.controller.manifest.mv)
            held = None if self.mode is Mode.SHADOW else self._mv.now
            step = self._active.step(readings, self._sp, applied, self._out.those, held)
        except Exception as error:  # the plant needs an MV after any error
            if self.mode in {Mode.AUTO, Mode.SHADOW}:
                self._mv.now = self._out.without(self._mv.now, applied)
            return self._without_sample(first_line(error), by_hand=False)
        # Once it was asked, the plant's own controller may have the plant already.
        if self.fault and not self._mode.handing_back and self._mode.recovers():
            self._transfer.begin()  # nobody has said that an MV which is elsewhere follows its commands again
            self._mode.set(Mode.AUTO)
        if self.mode is Mode.AUTO:
            self._mv.now = self._out.without(self._mv.now, self._transfer.limited(step.mv, applied))
        elif self.mode is Mode.SHADOW:
            self._mv.now = applied.copy()
        if self.learns:
            self._active.learn(self._mv.now)
        before = self.controller
        beside = self._active.beside(readings.sample, self._sp, applied, self._out.local.away, held, self._out.those)
        if self.controller is not before:
            self._transfer.begin()
        self._mv.fall_back(self._mode, self.controller.manifest.mv)
        command = self._command(step.mv, step.info, self.fault, beside)
        good = not (readings.bridged or readings.shed)
        return command if good else replace(command, bridged=readings.bridged, shed=readings.shed)

    def miss(self, reason: str) -> Command:
        """The command for a scan without a usable sample: the MV stays, and the law starts cold at the next."""
        self._sp = self.courses.followed(self._sp, self.controller.manifest.sp)
        self._active.missed(1)
        silent = self._mv.unread(self.mode, self._active.in_hand)
        return self._without_sample(f"{reason}; {silent}" if silent else reason, silent=bool(silent))

    def _without_sample(self, reason: str, *, silent: bool = False, by_hand: bool = True) -> Command:
        self._refused_why = reason = reason or "a fault without a reason"
        self._lose(reason)
        if by_hand and not silent:
            self._mv.move_by_hand(self.controller.manifest.mv)
        self._mv.fall_back(self._mode, self.controller.manifest.mv, moves=not silent)
        command = self._command(None, None, reason)
        return replace(command, mv=np.full(len(self._mv.now), nan)) if silent else command

    def unwritten(self, before: Array, reason: str) -> Command:
        """The command in place of the last one, which never reached the plant: the MV ``before`` it (n_mv,) stays.

        Where the scan has found that the MV stands elsewhere, it stays there.
        """
        self._mv.unwritten(before, self.controller.manifest.mv)
        self._lose(reason)
        self._scan -= 1
        self.courses.passed(-1)  # this scan is counted already
        return self._command(None, None, reason)

    def gap(self, periods: int) -> None:
        """So many periods passed without a scan; the law starts cold after more than ``max_gap``."""
        self._active.missed(periods)
        self.courses.passed(periods)
        if periods > self.max_gap:
            self._active.begin_cold(f"{periods} periods were missed")
            self._transfer.begin()  # a law that starts cold may want another MV at once

    def _lose(self, reason: str) -> None:
        """No past any more; in AUTO a fault."""
        self._active.forget(reason)
        self._mode.lose(reason)

    def _command(self, law_mv: Array | None, info: Array | None, reason: str, beside: Array | None = None) -> Command:
        self._scan += 1
        self.courses.over()
        self.courses.passed(1)
        back, sp, mv = self._mode.handing_back, self._sp.copy(), self.mv
        command = Command(self._scan - 1, self.mode, sp, mv, law_mv, info, reason, beside, back, local=self.local)
        self._mv.given(self.mode, written=command.writes)
        return command

    # ------------------------------------------------------------------ running
    def run(
        self,
        n: int | None = None,
        *,
        until: Callable[[Command], bool] | None = None,
        before: Callable[[int], None] | None = None,
        observe: Callable[[Sample | None, Command], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> RunReport:
        """Scan once a period for ``n`` periods, or until ``until`` returns True after a scan, or ``stop`` before one.

        ``before(k)`` is called before the scan at grid place k (for a schedule of set points), ``observe`` after it.
        ``loopwright.serving.scan_grid.run_on_grid`` says what happens where one of them, or the endpoint, raises.
        LoopError without an endpoint; what the clock raises at its first reading, before any MV was commanded.
        """
        if self.endpoint is None:
            raise LoopError("run needs an endpoint; without one call scan with your own samples")
        return run_on_grid(self, self.endpoint, n, until=until, before=before, observe=observe, stop=stop)
