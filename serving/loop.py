"""The loop around a controller: modes, faults, and an absolute time grid."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf, isnan, nan
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from serving.clock import Clock, MonotonicClock
from serving.controller import Controller
from serving.endpoint import Endpoint, HandsBack
from serving.errors import ContractError, LoopError, SampleError
from serving.fallback import Fallback
from serving.fitted import fitted
from serving.grid import RunReport, run_on_grid
from serving.guard import Guard, Sample, default_guards, implausible, refused
from serving.manifest import Manifest, Signal
from serving.standing import Standing
from serving.successor import Successor
from serving.transfer import Transfer
from serving.words import first_line

Array: TypeAlias = NDArray[np.float64]

WARM_LEAD_S = 4e-4  # within the clock's spin, so that the processor does not sleep between warm-up and deadline


class Mode(StrEnum):
    """The source of the MV: MANUAL the operator, AUTO the law, HOLD the last applied MV, SHADOW the plant's own side.

    In SHADOW nothing is written.
    """

    MANUAL = "MANUAL"
    AUTO = "AUTO"
    HOLD = "HOLD"
    SHADOW = "SHADOW"


def _known(mode: Mode) -> Mode:
    """``mode``, also given as its name; LoopError for anything else, as a loop in no mode would write the old MV."""
    try:
        return Mode(mode)
    except ValueError:
        raise LoopError(f"the mode is {mode!r}; it must be one of {', '.join(Mode)}") from None


@dataclass(frozen=True, slots=True)
class Command:
    """The result of one scan. ``reason`` names a fault; it is empty without one.

    A host that runs the loop itself writes ``mv`` where ``writes`` is true: not in SHADOW, and not while ``mv`` is NaN
    because no sample has told yet where the MV stands. Where ``hand_back`` is true, it gives the plant back to the
    plant's own controller, and then sets the mode to SHADOW.
    """

    scan: int
    mode: Mode
    sp: Array  # shape: (n_sp,)
    mv: Array  # shape: (n_mv,), to be written; NaN while it is not known where the MV stands
    law_mv: Array | None  # the law's MV, also in MANUAL; None if the law was not stepped or its step failed
    info: Array | None  # shape: (n_info,)
    reason: str = ""
    successor_mv: Array | None = None  # shape: (n_mv,), of a controller that is tried beside the law; else None
    hand_back: bool = False

    @property
    def writes(self) -> bool:
        """Whether ``mv`` is to be written."""
        return self.mode is not Mode.SHADOW and not isnan(self.mv[0])  # all of it is known, or none


class ControlLoop:
    """One controller on one plant.

    AUTO commands the law's MV. MANUAL commands the operator's MV; the law is still stepped with
    the applied MV, so the transfer to AUTO is bumpless. HOLD keeps the last applied MV. SHADOW writes
    nothing: the law is stepped on what others do with the plant. A fault in AUTO changes the mode to
    HOLD, and the command names the reason; ``recover_after`` good samples change it back. A fault that
    lasts is for ``fallback``. After a gap the law starts cold (state = 0).

    A command that did not reach the plant (``unwritten``) leaves it unknown where the MV stands: others may move it
    meanwhile. The next read-back tells, also that of a sample which is refused for another reason. HOLD, MANUAL and
    the fallback go on from there, and nothing writes an old MV over it. Where the MV then stands outside its range,
    nothing is written until it is back.

    Every written MV lies in its range, in every mode and with any guards; a discrete MV has one
    of its values. A read-back may exceed the range by ``guard.READ_BACK_MARGIN`` times the range:
    it is clipped to the range, for the law and for HOLD. A larger excess is a fault.

    Parameters
    ----------
    controller
        The law.
    endpoint
        Reads and writes the plant; only ``run`` needs it.
    sp
        Set points (n_sp,).
    mv
        The MV that the plant has now (n_mv,): the start value of HOLD and MANUAL. None: it is not known. The loop then
        writes nothing until a good sample has a read-back, and begins from there.
    mode
        Mode at the start.
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
        is where the law wants it; 0: at once. See ``serving.transfer``.
    fallback
        What to do when a fault lasts; None: the MV stays. See ``serving.fallback``.

    Raises
    ------
    LoopError
        A set point or MV outside its range, or of the wrong length.
    """

    def __init__(
        self,
        controller: Controller,
        endpoint: Endpoint | None = None,
        *,
        sp: ArrayLike,
        mv: ArrayLike | None = None,
        mode: Mode = Mode.MANUAL,
        guards: Sequence[Guard] | Callable[[Manifest], Sequence[Guard]] | None = None,
        recover_after: int | None = None,
        clock: Clock | None = None,
        warm_lead_s: float = WARM_LEAD_S,
        max_gap: int = 3,
        transfer_s: float = 0.0,
        fallback: Fallback | None = None,
    ) -> None:
        mode = _known(mode)
        if recover_after is not None and recover_after < 1:
            raise LoopError(f"recover_after is {recover_after}; it must be at least 1, or None")
        if not 0 <= transfer_s < inf:
            raise LoopError(f"transfer_s is {transfer_s}; it must be a finite number of seconds, 0 or more")
        manifest = controller.manifest
        self.controller = controller
        self.manifest = manifest  # of the first controller: its signals are what the loop reads, whoever is in charge
        self.endpoint = endpoint
        made = default_guards if guards is None else guards
        self._made = made if callable(made) else None  # what makes the guards; None: they are the host's own
        self.guards: tuple[Guard, ...] = tuple(made(manifest) if callable(made) else made)
        self.recover_after = recover_after
        self.clock: Clock = clock or MonotonicClock()
        self.warm_lead_s = min(warm_lead_s, manifest.period_s / 4)
        self.max_gap = max_gap
        self.fallback = fallback
        if fallback is not None and fallback.hand_back and not isinstance(endpoint, HandsBack | None):
            raise LoopError(f"{type(endpoint).__name__} cannot hand the plant back: it has no method hand_back")
        if fallback is not None and fallback.mv is not None and fallback.rate is not None:
            within(fallback.mv, manifest.mv, "safe MV")
            if len(fallback.rate) != len(manifest.mv):
                raise LoopError(f"the fallback has {len(fallback.rate)} rates; it needs {len(manifest.mv)}, one an MV")
        self._sp = within(sp, manifest.sp, "set point")
        self._mv = np.full(len(manifest.mv), nan) if mv is None else within(mv, manifest.mv, "MV")
        self._ranges = [(s.low, s.high, s.values) for s in manifest.mv]
        self._mode = mode
        self._fault = ""  # the fault that changed the mode to HOLD; empty without one
        self._blind = ""  # why the last sample was refused; empty after a good one, and before the first
        self._good = 0
        self._held = 0  # scans since that fault began
        self._scan = 0
        self._state = controller.cold_state()
        self._standing, self._given = Standing(manifest.mv, self._mv), self._mv
        self.found: Array | None = None  # shape: (n_mv,), where the MV stands, at the scan that learns it after a loss
        self._transfer = Transfer(manifest.mv, manifest.period_s, transfer_s)
        self._transfer.begin()
        self.successor: Successor | None = None  # tried beside the controller, see ``swap``
        self.replaced: Controller | None = None  # the one that was in charge before the present one
        self._past: deque[Sample] = deque(maxlen=_memory(self.guards))

    # ------------------------------------------------------------------ operator
    @property
    def mode(self) -> Mode:
        """Present mode."""
        return self._mode

    @property
    def sp(self) -> Array:
        """Present set points, shape (n_sp,)."""
        return self._sp.copy()

    @property
    def mv(self) -> Array:
        """Last commanded MV, shape (n_mv,); NaN while it is not known where the MV stands."""
        return self._mv.copy()

    @property
    def fault(self) -> str:
        """The fault that changed the mode to HOLD; empty without one."""
        return self._fault

    def set_mode(self, mode: Mode) -> None:
        """Set the mode, as a Mode or its name; it takes effect at the next scan.

        LoopError for another word, and where a shadow that knows no good sample now is to move the plant: where the MV
        stands is not known.
        """
        mode = _known(mode)
        if self._mode is Mode.SHADOW and mode is not Mode.SHADOW and self._blind:
            raise LoopError(f"the last sample was refused ({self._blind}), so where the MV stands is not known; wait")
        if mode is not self._mode:
            self._transfer.begin()
        self._mode, self._fault, self._good, self._held = mode, "", 0, 0

    def set_sp(self, sp: ArrayLike) -> None:
        """Change the set points (n_sp,); LoopError outside their ranges."""
        self._sp = within(sp, self.controller.manifest.sp, "set point")

    def set_mv(self, mv: ArrayLike) -> None:
        """Set the MV (n_mv,) in MANUAL; LoopError outside its range or in another mode.

        LoopError too after a command that did not reach the plant, until it is known where the MV stands.
        """
        if self._mode is not Mode.MANUAL:
            raise LoopError(f"the MV is set by hand in MANUAL only; the loop is in {self._mode}")
        if self._standing.lost:
            raise LoopError("the last MV did not reach the plant, so where the MV stands is not known; wait")
        self._mv = within(mv, self.controller.manifest.mv, "MV")

    def hand_back(self) -> None:
        """The plant is with its own controller now: this loop writes no more, until the mode is set again."""
        self.set_mode(Mode.SHADOW)

    def swap(self, controller: Controller, trial: int) -> None:
        """Try ``controller`` for ``trial`` good scans in a row beside the one in charge, then give it the plant.

        Until then its MV stands in ``Command.successor_mv``. It may read fewer PVs and measured disturbances than the
        loop does. LoopError where its period, set points or MVs are others, or it has a signal that the loop has not.
        """
        if trial < 1:
            raise LoopError(f"trial is {trial}; a controller is tried for at least one scan")
        new = fitted(controller, self.manifest)
        self.successor = Successor(new, trial, () if self._made is None else tuple(self._made(new.manifest)))

    def keep(self) -> None:
        """End the trial of a successor; the controller in charge stays."""
        self.successor = None

    # ------------------------------------------------------------------ one scan
    def scan(self, sample: Sample) -> Command:
        """The MV of the next period. No I/O and no clock; no content of a sample raises an exception."""
        reason = self._refusal(sample)
        self._blind = ""
        shown, left = self._stands(sample, refused=bool(reason))
        if left:
            words = left if reason in {None, left} else f"{reason}; {left}"
            return self._missed(f"{words}: nothing is written before it is back")
        if reason:
            return self._missed(reason)
        applied = self._mv
        past = tuple(self._past) if self.successor is not None else ()
        try:
            applied = self._read_back(sample) if shown is None else shown
            if isnan(self._mv[0]):
                self._mv = applied.copy()
            step = self.controller.step(sp=self._sp, pv=sample.pv, dv=sample.dv, mv_applied=applied, state=self._state)
            if self._past.maxlen:
                self._past.append(replace(sample, pv=np.array(sample.pv)))  # the host may reuse its array
        except Exception as error:  # the plant needs an MV after any error
            if self._mode in {Mode.AUTO, Mode.SHADOW}:
                self._mv = applied
            return self._missed(first_line(error))
        self._state = step.state
        if self._fault and not self._handing_back():  # once asked, the plant's own controller may have it already
            self._good += 1
            if self.recover_after is not None and self._good >= self.recover_after:
                self.set_mode(Mode.AUTO)
        if self._mode is Mode.AUTO:
            self._mv = np.array(self._transfer.limited(step.mv, applied))  # the host gets step.mv, may write into it
        elif self._mode is Mode.SHADOW:
            self._mv = applied.copy()
        beside = self._beside(sample, applied, past)
        self._lasting()
        return self._command(step.mv, step.info, self._fault, beside)

    def miss(self, reason: str) -> Command:
        """The command for a scan without a usable sample: the MV stays, and the law starts cold at the next."""
        self._standing.commanded(self._given)
        self.found = None
        return self._missed(reason)

    def _missed(self, reason: str) -> Command:
        self._blind = reason = reason or "a fault without a reason"
        self._lose(reason)
        self._lasting()
        return self._command(None, None, reason)

    def unwritten(self, before: Array, reason: str) -> Command:
        """The command in place of the last one, which never reached the plant: the MV ``before`` it (n_mv,) stays.

        Where the scan has found that the MV stands elsewhere, it stays there.
        """
        if self._mode is not Mode.MANUAL:
            self._mv = np.array(before if self.found is None else self.found, dtype=np.float64)
        self._standing.lost = True
        self._lose(reason)
        self._scan -= 1
        return self._command(None, None, reason)

    def gap(self, periods: int) -> None:
        """So many periods passed without a scan; the law starts cold after more than ``max_gap``."""
        if periods > self.max_gap:
            self._state = self.controller.cold_state()
            if self.successor is not None:
                self.successor.miss(f"{periods} periods were missed")

    def _lose(self, reason: str) -> None:
        """No past any more; in AUTO a fault."""
        self._state = self.controller.cold_state()
        self._past.clear()
        self._good = 0
        if self.successor is not None:
            self.successor.miss(reason)
        if self._mode is Mode.AUTO or self._fault:
            self._mode, self._fault = Mode.HOLD, reason

    def _lasting(self) -> None:
        """Count the scans of a fault, and go where the fallback says once it has lasted."""
        if self._fault:
            self._held += 1
            if self._overdue() and self.fallback is not None:
                m = self.controller.manifest
                self._mv = self.fallback.toward(self._mv, m.mv, m.period_s)

    def _overdue(self) -> bool:
        if not self._fault or self.fallback is None:
            return False
        return (self._held - 1) * self.controller.manifest.period_s >= self.fallback.after_s

    def _handing_back(self) -> bool:
        return self._overdue() and self.fallback is not None and self.fallback.hand_back

    def _beside(self, sample: Sample, applied: Array, past: Collection[Sample]) -> Array | None:
        """The successor's MV (n_mv,); once it is ready, it has the plant from the next scan on."""
        if self.successor is None:
            return None
        new = self.successor
        new.step(sample, self._sp, applied, past)
        if new.ready:
            self.replaced, self.successor = self.controller, None
            self.controller, self._state = new.controller, new.state
            if self._made is not None:
                self.guards = tuple(new.guards)
                self._past = deque(self._past, maxlen=_memory(self.guards))
            self._transfer.begin()
        return new.mv

    def _refusal(self, sample: Sample) -> str | None:
        if not isinstance(sample, Sample):
            return f"the sample is of the type {type(sample).__name__}; it must be a Sample"
        if sample.fault:
            return str(sample.fault)
        return refused(self.guards, sample, self._past)

    def _read_back(self, sample: Sample) -> Array:
        """The applied MV (n_mv,) within its range; the last command if there is no read-back.

        Raises ContractError for a wrong shape, and SampleError for an implausible value or where there is neither. HOLD
        commands the read-back, so this check does not depend on the guards.
        """
        if sample.mv_applied is None:
            if isnan(self._mv[0]):
                raise SampleError("there is no read-back, so where the MV stands is not known and nothing is written")
            return self._mv
        applied = np.array(sample.mv_applied, dtype=np.float64, ndmin=1)
        if applied.shape != self._mv.shape:
            raise ContractError(f"applied MV has the shape {applied.shape} instead of {self._mv.shape}")
        values = applied.tolist()
        for value, (low, high, allowed) in zip(values, self._ranges, strict=True):
            if not low <= value <= high or (allowed is not None and value not in allowed):
                reason = implausible(self.controller.manifest.mv, values)
                if reason:
                    raise SampleError(reason)
                lows, highs, _ = zip(*self._ranges, strict=True)
                return np.clip(applied, lows, highs)
        return applied

    def _stands(self, sample: Sample, *, refused: bool) -> tuple[Array | None, str]:
        """The read-back (n_mv,), as ``_read_back`` gives it, and where the MV stands: ``found`` if that was not known.

        A refused sample without a read-back tells nothing; a good one says that nothing is read back at all. Where that
        was not known and the MV stands outside its range, somebody has moved it there: the text says why it is left.
        """
        self._standing.commanded(self._given)
        self.found = None
        try:
            given = sample.mv_applied
            if given is not None and np.asarray(given).dtype.kind not in "fiu":
                return None, ""
            applied = None if given is None else self._read_back(sample)
        except Exception:  # no sample, or no MV that any actuator can have
            return None, self._left(sample) if self._standing.lost else ""
        if applied is not None:
            self.found = self._standing.seen(applied)
        elif not refused:
            self._standing.lost = False
        if self.found is not None:
            self._mv = self.found.copy()
        return applied, ""

    def _left(self, sample: Sample) -> str:
        """Why the MV is left where it stands: the plant has one that the loop may not command."""
        with suppress(Exception):  # no sample, or no MV at all
            applied = np.array(sample.mv_applied, dtype=np.float64, ndmin=1)
            if applied.shape == self._mv.shape and np.isfinite(applied).all():
                reason = implausible(self.controller.manifest.mv, applied.tolist()) or ""
                if reason:
                    self._mv = np.full(len(applied), nan)
                return reason
        return ""

    def _command(self, law_mv: Array | None, info: Array | None, reason: str, beside: Array | None = None) -> Command:
        self._scan += 1
        self._given = self._mv.copy()
        back = self._handing_back()
        return Command(self._scan - 1, self._mode, self._sp.copy(), self._mv.copy(), law_mv, info, reason, beside, back)

    # ------------------------------------------------------------------ running
    def run(
        self,
        n: int | None = None,
        *,
        until: Callable[[Command], bool] | None = None,
        before: Callable[[int], None] | None = None,
        observe: Callable[[Sample | None, Command], None] | None = None,
    ) -> RunReport:
        """Scan once a period for ``n`` periods, or until ``until`` returns True.

        Deadlines are t0 + k period, so lateness does not add up to drift. A period that has passed
        completely is skipped and counted. ``before(k)`` is called before the scan at grid place k
        (for a schedule of set points), ``observe`` after it.

        Only KeyboardInterrupt, SystemExit and similar exceptions end the run, because the plant
        needs an MV at every period. The effect of another exception depends on its source.

        - ``endpoint``: a fault. The loop goes to HOLD and tries again.
        - ``before``: a fault, because the set points may be wrong. The held MV is written.
        - ``clock``: a fault, because the law's period is not known. The held MV is written, and the
          machine's clock measures the next period.
        - ``observe``, ``until``, the warm-up: no fault, because the MV is already written or does
          not depend on them. The run continues; an ``until`` that raises counts as False. The
          report counts and names these exceptions, and the first of each is logged at once.

        Raises
        ------
        LoopError
            There is no endpoint.
        Exception
            The clock failed at its first reading; no MV was commanded yet.
        """
        if self.endpoint is None:
            raise LoopError("run needs an endpoint; without one call scan with your own samples")
        return run_on_grid(self, self.endpoint, n, until=until, before=before, observe=observe)


def _memory(guards: Sequence[Guard]) -> int:
    return max((g.memory for g in guards), default=0)


def within(values: ArrayLike, signals: Sequence[Signal], what: str) -> Array:
    """``values`` as (n,); LoopError outside the signals' ranges."""
    try:
        vector = np.array(values, dtype=np.float64, ndmin=1)
    except (TypeError, ValueError, OverflowError) as error:
        raise LoopError(f"the {what} is no vector of numbers: {error}") from error
    if vector.shape != (len(signals),):
        names = ", ".join(f"{s.name} [{s.unit}]" for s in signals)
        raise LoopError(f"the {what} has the shape {vector.shape}; it needs ({len(signals)},): {names}")
    for s, value in zip(signals, vector.tolist(), strict=True):
        if s.values is not None and value not in s.values:
            raise LoopError(f"the {what} {s.name} = {value:g} is none of {', '.join(f'{v:g}' for v in s.values)}")
        if not s.low <= value <= s.high:
            unit = "" if s.unit == "-" else f" {s.unit}"
            raise LoopError(f"the {what} {s.name} = {value}{unit} is outside [{s.low:g}, {s.high:g}]{unit}")
    return vector
