"""A loop on its time grid: one scan a period, and what may fail beside it without failing the loop."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, TypeVar

from loopwright.serving.clock import MonotonicClock
from loopwright.serving.endpoint import Endpoint, HandsBack
from loopwright.serving.errors import LoopError
from loopwright.serving.guard import Sample, told_by
from loopwright.serving.words import named

if TYPE_CHECKING:
    from loopwright.serving.loop import Command, ControlLoop

T = TypeVar("T")

_log = logging.getLogger("loopwright.serving.loop")


@dataclass(frozen=True, slots=True)
class RunReport:
    """Counts of a run: scans, periods missed because the machine was late, scans with a fault.

    An exception in ``observe``, ``until``, ``stop`` or the warm-up does not affect the MV and is no fault.
    ``errors`` counts these exceptions; ``first_errors`` has the first one of each.
    """

    scans: int
    missed: int
    faults: int
    latest_s: float  # largest lateness of a scan against its place on the grid [s]
    errors: int = 0
    first_errors: tuple[str, ...] = ()


class Failures:
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
                self.first[name] = f"{name} failed: {named(error)}"
                with suppress(Exception):  # the host's log handler may fail too
                    _log.error(self.first[name])
            return None


def run_on_grid(
    loop: ControlLoop,
    endpoint: Endpoint,
    n: int | None,
    *,
    until: Callable[[Command], bool] | None,
    before: Callable[[int], None] | None,
    observe: Callable[[Sample | None, Command], None] | None,
    stop: Callable[[], bool] | None = None,
) -> RunReport:
    """``ControlLoop.run``: a scan at each place of a grid.

    Deadlines are t0 + k period, so lateness does not add up to drift. A period that has passed completely is skipped
    and counted.

    Only KeyboardInterrupt, SystemExit and similar exceptions end the run, because the plant needs an MV at every
    period. The effect of another exception depends on its source.

    - ``endpoint``: a fault. The loop goes to HOLD and tries again.
    - ``before``: a fault, because the set points may be wrong. The held MV is written.
    - ``clock``: a fault, because the law's period is not known. The held MV is written, and the machine's clock
      measures the next period.
    - ``observe``, ``until``, ``stop``, the warm-up: no fault, because the MV is already written or does not depend on
      them. The run continues; an ``until`` or ``stop`` that raises counts as False. The report counts and names these
      exceptions, and the first of each is logged at once.
    """
    period = loop.controller.manifest.period_s
    start = loop.clock.now()
    failures = Failures()
    k = scans = missed = faults = 0
    latest = 0.0
    while n is None or k < n:
        reason, late, gap = "", 0.0, 0
        try:
            late = _wait(loop, start + k * period, failures)
            gap = int(late // period)
        except Exception as error:
            reason = f"the clock failed: {named(error)}"
            spare = MonotonicClock()
            spare.sleep_until(spare.now() + period)
        if stop is not None and failures.call("stop", _true, stop):
            break
        if gap:
            k, missed, late = k + gap, missed + gap, late - gap * period
            if n is not None and k >= n:
                break
            loop.gap(gap)
        latest = max(latest, late)
        if before is not None:
            try:
                before(k)
            except Exception as error:
                reason = reason or f"before failed: {named(error)}"
        sample, command = _scan_once(loop, endpoint, reason)
        scans += 1
        faults += bool(command.fault)
        if observe is not None:
            failures.call("observe", observe, sample, command)
        if until is not None and failures.call("until", _true, until, command):
            break
        k += 1
    return RunReport(scans, missed, faults, latest, failures.count, tuple(failures.first.values()))


def _wait(loop: ControlLoop, deadline: float, failures: Failures) -> float:
    """Warm the controller, sleep until ``deadline`` [s], and return the lateness [s]."""
    if loop.warm_lead_s:
        loop.clock.sleep_until(deadline - loop.warm_lead_s)
        failures.call("warm", loop.controller.warm)
    loop.clock.sleep_until(deadline)
    late = loop.clock.now() - deadline
    if not isfinite(late):
        raise LoopError(f"the lateness is {late} s; the clock must give finite seconds")
    return max(0.0, late)


def _scan_once(loop: ControlLoop, endpoint: Endpoint, reason: str) -> tuple[Sample | None, Command]:
    """Read, scan, write; a ``reason`` or a failing endpoint gives a command that holds the MV."""
    sample, last = None, loop.mv
    try:
        sample = endpoint.read()
    except Exception as error:
        _trace("read")
        command = loop.miss(reason or told_by(error, f"the plant cannot be read: {named(error)}"))
    else:
        command = loop.miss(reason) if reason else loop.scan(sample)
    try:
        if command.hand_back and isinstance(endpoint, HandsBack):
            endpoint.hand_back()
            loop.hand_back()
        elif command.writes:
            endpoint.write(command.mv)
    except Exception as error:
        _trace("write")
        doing = "cannot be handed back" if command.hand_back else "cannot be written"
        command = loop.unwritten(last, told_by(error, f"the plant {doing}: {named(error)}"))
    return sample if isinstance(sample, Sample) else None, command


def _trace(call: str) -> None:
    """The traceback of an endpoint's exception, for who writes the endpoint: the command's reason is one line."""
    with suppress(Exception):  # the host's log handler may fail too
        _log.debug("the endpoint's %s failed", call, exc_info=True)


def _true(asked: Callable[..., bool], *arguments: object) -> bool:
    return bool(asked(*arguments))
