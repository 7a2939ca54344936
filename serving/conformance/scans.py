"""Scans of a loop for a host to repeat: a start without information, good samples, and every kind of refused sample."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.bridging import BRIDGE_PERIODS
from loopwright.serving.conformance.in_other_hands import (
    at,
    by_hand,
    never_read_back,
    no_read_back,
    others_command,
    too_old,
)
from loopwright.serving.conformance.kit_samples import KitScan, apart, changed, doubtful, moved
from loopwright.serving.controller import Controller, Step
from loopwright.serving.errors import LoopError, OutputError
from loopwright.serving.guard import Sample
from loopwright.serving.loop import Command, ControlLoop, Mode
from loopwright.serving.manifest import Manifest, Signal

Array: TypeAlias = NDArray[np.float64]

KIT_RECOVERY = 3  # good samples in a row after which a loop goes on
MAX_GAP = 3  # missed periods in a row that a law bridges: after more it starts cold
MOST_WAITS = 200  # samples of a shadow, in all, that a law may refuse: half as many as a kit has scans
ACTUATOR_STANDS = 0.3  # share of its range at which an actuator stands before the loop's first command: not its middle


@dataclass(frozen=True, slots=True)
class ScanStart:
    """How the loop of the scans starts: in AUTO, at set points (n_sp,). Nobody tells where the MV stands."""

    sp: Array
    recover_after: int = KIT_RECOVERY
    max_gap: int = MAX_GAP


@dataclass(frozen=True, slots=True)
class Scanned:
    """A scan with the command that this runtime gives."""

    scan: KitScan
    command: Command


@dataclass(frozen=True, slots=True)
class _Course:
    """Good samples: PVs and disturbances that wander around the middle of their ranges."""

    manifest: Manifest
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def sample(self, mv: Array) -> Sample:
        m = self.manifest
        return Sample(pv=self._near(m.pv), mv_applied=mv.copy(), dv=self._near(m.dv))

    def _near(self, signals: tuple[Signal, ...]) -> Array:
        at = [s.middle if s.values else s.middle + 0.2 * self.rng.uniform(-1, 1) * (s.high - s.low) for s in signals]
        return np.array(at, dtype=np.float64)


def start(manifest: Manifest) -> ScanStart:
    """The loop of the scans at its start: the set points in the middle of their ranges."""
    return ScanStart(np.array([s.middle for s in manifest.sp], dtype=np.float64))


def actuators(manifest: Manifest) -> Array:
    """Where the MVs (n_mv,) stand before the loop's first command."""
    at = [s.low + ACTUATOR_STANDS * (s.high - s.low) if s.values is None else s.values[-1] for s in manifest.mv]
    return np.array(at, dtype=np.float64)


def scanned(controller: Controller) -> list[Scanned]:
    """All scans of the kit, with this runtime's commands."""
    begin = start(controller.manifest)
    loop = ControlLoop(
        controller,
        sp=begin.sp,
        mode=Mode.AUTO,
        recover_after=begin.recover_after,
        max_gap=begin.max_gap,
        learns=False,  # what every host does: one step a scan
    )
    course, stands, done = _Course(controller.manifest), actuators(controller.manifest), list[Scanned]()
    scans = _scans(controller.manifest, course.sample(stands), _before_and_after(controller, begin.sp))
    scan, before, waited = next(scans), loop.mv, 0
    while True:
        now = scan
        if scan.set_mode is not None:
            try:
                loop.set_mode(scan.set_mode)
            except LoopError:  # the law has refused the last sample of the shadow that is to end
                waited += 1
                if waited > MOST_WAITS:
                    raise
                now = KitScan("others have the plant until the law takes a sample", course.sample(stands))
        if now.set_mv is not None:
            with suppress(LoopError):  # it may have to be refused
                loop.set_mv(now.set_mv)
        if now.unwritten:
            loop.unwritten(before, "the plant cannot be written")
        if now.missed:
            loop.gap(now.missed)
        before = loop.mv
        command = loop.miss("the plant cannot be read") if now.sample is None else loop.scan(now.sample)
        done.append(Scanned(now, command))
        stands = command.mv if command.writes or command.mode is Mode.SHADOW else stands  # a shadow's MV is others'
        if now is not scan:
            continue
        try:
            scan = scans.send(course.sample(stands))
        except StopIteration:
            return done


def _scans(m: Manifest, good: Sample, told: tuple[Sample, Sample]) -> Generator[KitScan, Sample, None]:
    """Each scan; ``send`` takes a good sample for the next one. ``told``: a rest and a move that tell a cold start."""

    def some(n: int, what: str = "good") -> Generator[KitScan, Sample, None]:
        nonlocal good
        for _ in range(n):
            good = yield KitScan(what, good)

    recovery = KIT_RECOVERY + 1
    good = yield KitScan("the plant cannot be read at first", None)
    good = yield KitScan("a PV at first not finite", changed(no_read_back(good), "pv", 0, nan))
    good = yield KitScan("no read-back at first", no_read_back(good))
    good = yield from never_read_back(m, good, KIT_RECOVERY)
    good = yield KitScan("an MV by hand in AUTO, from nowhere known", None, set_mode=Mode.AUTO, set_mv=at(m, 0.4))
    good = yield KitScan("no read-back, and nobody has said where the MV stands", no_read_back(good))
    good = yield KitScan("a sample is too old, and not known where the MV stands", too_old(m, good))
    if m.mv[0].name not in apart(m):
        good = yield KitScan("an applied MV at first not finite", changed(good, "mv_applied", 0, nan))
    good = yield KitScan("the first good sample", moved(m, good))
    good = yield KitScan("the plant cannot be read after the first good sample", None)
    yield from some(KIT_RECOVERY - 1, "before the first command of the law")
    yield from some(5)
    for what, spoilt in doubtful(m):
        good = yield KitScan(what, spoilt(good))
        yield from some(recovery, f"after: {what}")
    good = yield KitScan("the plant cannot be read", None)
    yield from some(recovery, "after the plant could not be read")
    for missed in (1, MAX_GAP, MAX_GAP + 1):
        good = yield KitScan(f"{missed} periods missed", good, missed=missed)
        yield from some(2)
    good = yield KitScan("by hand", good, set_mode=Mode.MANUAL)
    yield from some(2, "by hand")
    good = yield KitScan("a fault by hand", changed(good, "pv", 0, nan))
    yield from some(2, "by hand")
    good = yield KitScan("back to AUTO", good, set_mode=Mode.AUTO)
    yield from some(3)
    good = yield KitScan("two faults in a row", None)
    good = yield KitScan("two faults in a row", None)
    good = yield KitScan("a good sample between faults", good)
    good = yield KitScan("a fault while it recovers", None)
    yield from some(recovery + 2, "after a fault while it recovers")
    good = yield KitScan("a command did not arrive, and the MV was moved", moved(m, good), unwritten=True)
    yield from some(recovery, "after an MV that was moved")
    no_pv = changed(moved(m, good), "pv", 0, nan)
    good = yield KitScan("a command did not arrive, the MV was moved, and a PV is not finite", no_pv, unwritten=True)
    yield from some(recovery, "after an MV that was moved")
    good = yield KitScan("a command did not arrive, and there is no read-back", no_read_back(good), unwritten=True)
    yield from some(recovery, "after a command that did not arrive")
    good = yield KitScan("by hand again", good, set_mode=Mode.MANUAL)
    good = yield KitScan("by hand a command did not arrive, and the MV was moved", moved(m, good), unwritten=True)
    yield from some(2, "by hand again")
    good = yield KitScan("back to AUTO", good, set_mode=Mode.AUTO)
    yield from some(2, "the last samples")
    if "fresh" in m.inputs:
        good = yield from _gone(m, good)
    good = yield from others_command(m, good, KIT_RECOVERY)
    yield from by_hand(m, good, KIT_RECOVERY)
    yield from _cold_start(*told)


# ---------------------------------------------------------------------------------------------- a cold start that shows
RESTS = 6  # good samples over which the PVs rest before a cold start: more of a past than one sample
DRAWS = 256  # of a rest and a jump; a law whose MV lies at its ends shows its past in 2 % of them


def _before_and_after(controller: Controller, sp: Array) -> tuple[Sample, Sample]:
    """A sample that rests, and one after it whose MV tells most whether the law began cold there.

    Samples at random leave a law at an end of its MV's range, where a start that is not cold gives the same MV. The
    MVs of a step from the rest's state and of one from the cold state differ by a share of their ranges: the rest and
    jump of the PVs with the largest share is taken out of ``DRAWS``. Without a state there is nothing to tell.
    """
    m, rng = controller.manifest, np.random.default_rng(2)
    span = np.array([s.high - s.low for s in m.mv])
    middle = np.array([s.middle for s in m.pv], dtype=np.float64)
    width = np.array([0.0 if s.values else s.high - s.low for s in m.pv])
    rest = Sample(pv=middle, mv_applied=actuators(m), dv=np.array([s.middle for s in m.dv], dtype=np.float64))
    told, most = (rest, rest), 0.0
    for k in range(DRAWS if m.n_state else 0):
        wide = (0.05, 0.2, 0.5, 1.0)[k % 4] * width
        pv = middle + wide * rng.uniform(-0.5, 0.5, len(width))
        jumped = np.clip(pv + 0.2 * wide * rng.uniform(-1, 1, len(width)), middle - 0.5 * width, middle + 0.5 * width)
        trial = replace(rest, pv=pv), replace(rest, pv=jumped)
        with suppress(OutputError):
            state, mv = controller.cold_state(), actuators(m)
            for _ in range(RESTS):
                mv, state, _ = _stepped(controller, sp, trial[0], mv, state)
            begun = _stepped(controller, sp, trial[1], mv, controller.cold_state())
            differ = float(np.max(np.abs(_stepped(controller, sp, trial[1], mv, state).mv - begun.mv) / span))
            if differ > most:
                told, most = trial, differ
    return told


def _stepped(controller: Controller, sp: Array, sample: Sample, mv: Array, state: Array) -> Step:
    return controller.step(sp=sp, pv=sample.pv, mv_applied=mv, state=state, dv=sample.dv)


def _cold_start(rest: Sample, after: Sample) -> Generator[KitScan, Sample, None]:
    """A law that begins cold, rests, and begins cold again after missed periods."""
    good = yield KitScan("at rest after missed periods", rest, set_mode=Mode.AUTO, missed=MAX_GAP + 1)
    for _ in range(RESTS - 1):
        good = yield KitScan("at rest", replace(rest, mv_applied=good.mv_applied))
    for missed in (MAX_GAP + 1, 0, 0):
        what = "moved after missed periods" if missed else "it stays moved"
        good = yield KitScan(what, replace(after, mv_applied=good.mv_applied), missed=missed)


STAYS_BAD = 3  # scans for which readings stay bad after they were bridged


def _gone(m: Manifest, good: Sample) -> Generator[KitScan, Sample, Sample]:
    """Readings that are bad for longer than they are bridged: of each PV alone, over a gap, and of all together.

    The next good sample is returned.
    """
    bridged = round(BRIDGE_PERIODS)
    for i, s in enumerate(m.pv):
        for k in range(bridged + STAYS_BAD):
            bad = nan if k % 2 else s.high + (s.high - s.low)
            good = yield KitScan(f"PV {s.name} is bad for {k + 1} scans", changed(good, "pv", i, bad))
        for _ in range(KIT_RECOVERY + 1):
            good = yield KitScan(f"after PV {s.name} was bad", good)
    good = yield KitScan("a PV is bad after missed periods", changed(good, "pv", 0, nan), missed=bridged)
    good = yield KitScan("a PV is bad after missed periods", changed(good, "pv", 0, nan))
    for k in range(bridged + STAYS_BAD):
        none = replace(good, pv=np.full(len(m.pv), nan))
        good = yield KitScan(f"all PVs are bad for {k + 1} scans", none)
    for _ in range(KIT_RECOVERY + 2):
        good = yield KitScan("after all PVs were bad", good)
    return good
