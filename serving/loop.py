"""The loop around a controller: modes, faults, and an absolute time grid."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from math import isfinite
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from serving.clock import Clock, MonotonicClock
from serving.controller import Controller
from serving.endpoint import Endpoint
from serving.errors import ContractError, LoopError, SampleError
from serving.guard import Guard, Sample, default_guards, implausible
from serving.manifest import Signal

Array: TypeAlias = NDArray[np.float64]
T = TypeVar("T")

_log = logging.getLogger(__name__)

WARM_LEAD_S = 4e-4  # within the clock's spin, so that the processor does not sleep between warm-up and deadline


class Mode(StrEnum):
    """The source of the MV: MANUAL the operator, AUTO the law, HOLD the last applied MV."""

    MANUAL = "MANUAL"
    AUTO = "AUTO"
    HOLD = "HOLD"


@dataclass(frozen=True, slots=True)
class Command:
    """The result of one scan. ``reason`` names a fault; it is empty without one."""

    scan: int
    mode: Mode
    sp: Array  # shape: (n_sp,)
    mv: Array  # shape: (n_mv,), to be written
    law_mv: Array | None  # the law's MV, also in MANUAL; None if the law was not stepped or its step failed
    info: Array | None  # shape: (n_info,)
    reason: str = ""


@dataclass(frozen=True, slots=True)
class RunReport:
    """Counts of a run: scans, periods missed because the machine was late, scans with a fault.

    An exception in ``observe``, ``until`` or the warm-up does not affect the MV and is no fault.
    ``errors`` counts these exceptions; ``first_errors`` has the first one of each.
    """

    scans: int
    missed: int
    faults: int
    latest_s: float  # largest lateness of a scan against its place on the grid [s]
    errors: int = 0
    first_errors: tuple[str, ...] = ()


class ControlLoop:
    """One controller on one plant.

    AUTO commands the law's MV. MANUAL commands the operator's MV; the law is still stepped with
    the applied MV, so the transfer to AUTO is bumpless. HOLD keeps the last applied MV. A fault in
    AUTO changes the mode to HOLD, and the command names the reason; ``recover_after`` good samples
    change it back. After a gap the law starts cold (state = 0).

    Every commanded MV lies in its range, in every mode and with any guards; a discrete MV has one
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
        The MV that the plant has now (n_mv,): the start value of HOLD and MANUAL.
    mode
        Mode at the start.
    guards
        Checks that can refuse a sample; ``default_guards`` unless given.
    recover_after
        Good samples after which HOLD returns to AUTO after a fault; None: only the operator returns it.
    clock
        Time for ``run``; the machine's unless given.
    warm_lead_s
        Lead time of the warm-up before each deadline [s]; 0: no warm-up.
    max_gap
        Missed periods in a row after which the law starts cold.

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
        mv: ArrayLike,
        mode: Mode = Mode.MANUAL,
        guards: Sequence[Guard] | None = None,
        recover_after: int | None = None,
        clock: Clock | None = None,
        warm_lead_s: float = WARM_LEAD_S,
        max_gap: int = 3,
    ) -> None:
        if recover_after is not None and recover_after < 1:
            raise LoopError(f"recover_after is {recover_after}; it must be at least 1, or None")
        manifest = controller.manifest
        self.controller = controller
        self.endpoint = endpoint
        self.guards = tuple(default_guards(manifest) if guards is None else guards)
        self.recover_after = recover_after
        self.clock: Clock = clock or MonotonicClock()
        self.warm_lead_s = min(warm_lead_s, manifest.period_s / 4)
        self.max_gap = max_gap
        self._sp = _within(sp, manifest.sp, "set point")
        self._mv = _within(mv, manifest.mv, "MV")
        self._ranges = [(s.low, s.high, s.values) for s in manifest.mv]
        self._mode = mode
        self._fault = ""  # the fault that changed the mode to HOLD; empty without one
        self._good = 0
        self._scan = 0
        self._state = controller.cold_state()
        self._past: deque[Sample] = deque(maxlen=max((g.memory for g in self.guards), default=0))

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
        """Last commanded MV, shape (n_mv,)."""
        return self._mv.copy()

    @property
    def fault(self) -> str:
        """The fault that changed the mode to HOLD; empty without one."""
        return self._fault

    def set_mode(self, mode: Mode) -> None:
        """Set the mode; it takes effect at the next scan."""
        self._mode, self._fault, self._good = mode, "", 0

    def set_sp(self, sp: ArrayLike) -> None:
        """Change the set points (n_sp,); LoopError outside their ranges."""
        self._sp = _within(sp, self.controller.manifest.sp, "set point")

    def set_mv(self, mv: ArrayLike) -> None:
        """Set the MV (n_mv,) in MANUAL; LoopError outside its range or in another mode."""
        if self._mode is not Mode.MANUAL:
            raise LoopError(f"the MV is set by hand in MANUAL only; the loop is in {self._mode}")
        self._mv = _within(mv, self.controller.manifest.mv, "MV")

    # ------------------------------------------------------------------ one scan
    def scan(self, sample: Sample) -> Command:
        """The MV of the next period. No I/O and no clock; no content of a sample raises an exception."""
        reason = self._refusal(sample)
        if reason:
            return self.miss(reason)
        applied = self._mv
        try:
            applied = self._read_back(sample)
            step = self.controller.step(sp=self._sp, pv=sample.pv, dv=sample.dv, mv_applied=applied, state=self._state)
            if self._past.maxlen:
                self._past.append(replace(sample, pv=np.array(sample.pv)))  # the host may reuse its array
        except Exception as error:  # the plant needs an MV after any error
            if self._mode is Mode.AUTO:
                self._mv = applied
            return self.miss(_text(error))
        self._state = step.state
        if self._fault:
            self._good += 1
            if self.recover_after is not None and self._good >= self.recover_after:
                self.set_mode(Mode.AUTO)
        if self._mode is Mode.AUTO:
            self._mv = step.mv.copy()  # the host gets step.mv and may write into it
        return self._command(step.mv, step.info, self._fault)

    def miss(self, reason: str) -> Command:
        """The command for a scan without a usable sample: the MV stays, and the law starts cold at the next."""
        reason = reason or "a fault without a reason"
        self._state = self.controller.cold_state()
        self._past.clear()
        self._good = 0
        if self._mode is Mode.AUTO or self._fault:
            self._mode, self._fault = Mode.HOLD, reason
        return self._command(None, None, reason)

    def _refusal(self, sample: Sample) -> str | None:
        if not isinstance(sample, Sample):
            return f"the sample is of the type {type(sample).__name__}; it must be a Sample"
        for guard in self.guards:
            try:
                reason = guard.check(sample, self._past)
                if reason:
                    return str(reason)
            except Exception as error:  # a guard that fails refuses the sample
                return f"{type(guard).__name__} failed: {_text(error)}"
        return None

    def _read_back(self, sample: Sample) -> Array:
        """The applied MV (n_mv,) within its range; the last command if there is no read-back.

        Raises ContractError for a wrong shape and SampleError for an implausible value. HOLD
        commands the read-back, so this check does not depend on the guards.
        """
        if sample.mv_applied is None:
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

    def _command(self, law_mv: Array | None, info: Array | None, reason: str) -> Command:
        self._scan += 1
        return Command(self._scan - 1, self._mode, self._sp.copy(), self._mv.copy(), law_mv, info, reason)

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
        period = self.controller.manifest.period_s
        start = self.clock.now()
        failures = _Failures()
        k = scans = missed = faults = 0
        latest = 0.0
        while n is None or k < n:
            reason, late, gap = "", 0.0, 0
            try:
                late = self._wait(start + k * period, failures)
                gap = int(late // period)
            except Exception as error:
                reason = f"the clock failed: {_named(error)}"
                spare = MonotonicClock()
                spare.sleep_until(spare.now() + period)
            if gap:
                k, missed, late = k + gap, missed + gap, late - gap * period
                if n is not None and k >= n:
                    break
                if gap > self.max_gap:
                    self._state = self.controller.cold_state()
            latest = max(latest, late)
            if before is not None:
                try:
                    before(k)
                except Exception as error:
                    reason = reason or f"before failed: {_named(error)}"
            sample, command = self._exchange(self.endpoint, reason)
            scans += 1
            faults += bool(command.reason)
            if observe is not None:
                failures.call("observe", observe, sample, command)
            if until is not None and failures.call("until", lambda c: bool(until(c)), command):
                break
            k += 1
        return RunReport(scans, missed, faults, latest, failures.count, tuple(failures.first.values()))

    def _wait(self, deadline: float, failures: _Failures) -> float:
        """Warm the controller, sleep until ``deadline`` [s], and return the lateness [s]."""
        if self.warm_lead_s:
            self.clock.sleep_until(deadline - self.warm_lead_s)
            failures.call("warm", self.controller.warm)
        self.clock.sleep_until(deadline)
        late = self.clock.now() - deadline
        if not isfinite(late):
            raise LoopError(f"the lateness is {late} s; the clock must give finite seconds")
        return max(0.0, late)

    def _exchange(self, endpoint: Endpoint, reason: str) -> tuple[Sample | None, Command]:
        """Read, scan, write; a ``reason`` or a failing endpoint gives a command that holds the MV."""
        sample, last = None, self._mv
        try:
            sample = endpoint.read()
        except Exception as error:
            command = self.miss(reason or f"the endpoint cannot be read: {_named(error)}")
        else:
            command = self.miss(reason) if reason else self.scan(sample)
        try:
            endpoint.write(command.mv)
        except Exception as error:
            if self._mode is Mode.AUTO:
                self._mv = last  # the new MV never reached the plant
            self._scan -= 1
            command = self.miss(f"the endpoint cannot be written: {_named(error)}")
        return sample if isinstance(sample, Sample) else None, command


class _Failures:
    """Exceptions that do not affect the MV: their number, and by source the text of the first one."""

    def __init__(self) -> None:
        self.count = 0
        self.first: dict[str, str] = {}

    def call(self, name: str, act: Callable[..., T], *arguments: object) -> T | None:
        """``act(*arguments)``; an exception is counted and named, and gives None."""
        try:
            return act(*arguments)
        except Exception as error:
            self.count += 1
            if name not in self.first:
                self.first[name] = f"{name} failed: {_named(error)}"
                with suppress(Exception):  # the host's log handler may fail too
                    _log.error(self.first[name])
            return None


def _text(error: Exception) -> str:
    """The first line of the error's text; its type if the text is empty."""
    name = type(error).__name__
    try:
        return (str(error).strip().splitlines() or [name])[0]
    except Exception:
        return name


def _named(error: Exception) -> str:
    """The error's type and text in one line."""
    name, text = type(error).__name__, _text(error)
    return name if text == name else f"{name}: {text}"


def _within(values: ArrayLike, signals: Sequence[Signal], what: str) -> Array:
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
