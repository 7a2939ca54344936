"""Scans of a loop for a host to repeat: a start without information, good samples, and every kind of refused sample."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace
from math import inf, nan
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.bridging import BRIDGE_PERIODS
from loopwright.serving.controller import Controller
from loopwright.serving.guard import READ_BACK_MARGIN, InRange, Sample
from loopwright.serving.loop import Command, ControlLoop, Mode
from loopwright.serving.manifest import Manifest, Signal

Array: TypeAlias = NDArray[np.float64]

KIT_RECOVERY = 3  # good samples in a row after which a loop goes on
MAX_GAP = 3  # missed periods in a row that a law bridges: after more it starts cold
ACTUATOR_STANDS = 0.3  # share of its range at which an actuator stands before the loop's first command: not its middle
MARGIN_SHARE = 0.4  # share of a margin by which a value lies inside or outside it


@dataclass(frozen=True, slots=True)
class KitScan:
    """Events before and at one scan. ``sample`` None: the plant cannot be read.

    ``set_mode`` is what the operator sets before it, ``missed`` the periods that passed without a scan before it.
    ``unwritten``: the command of the scan before did not reach the plant.
    """

    what: str
    sample: Sample | None
    set_mode: Mode | None = None
    missed: int = 0
    unwritten: bool = False


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
    course, stands, done = _Course(controller.manifest), actuators(controller.manifest), []
    scans = _scans(controller.manifest, course.sample(stands))
    scan, before = next(scans), loop.mv
    while True:
        if scan.set_mode is not None:
            loop.set_mode(scan.set_mode)
        if scan.unwritten:
            loop.unwritten(before, "the plant cannot be written")
        if scan.missed:
            loop.gap(scan.missed)
        before = loop.mv
        command = loop.miss("the plant cannot be read") if scan.sample is None else loop.scan(scan.sample)
        done.append(Scanned(scan, command))
        stands = command.mv if command.writes or command.mode is Mode.SHADOW else stands  # a shadow's MV is others'
        try:
            scan = scans.send(course.sample(stands))
        except StopIteration:
            return done


def _scans(m: Manifest, good: Sample) -> Generator[KitScan, Sample, None]:
    """Each scan; ``send`` takes a good sample for the next one."""

    def some(n: int, what: str = "good") -> Generator[KitScan, Sample, None]:
        nonlocal good
        for _ in range(n):
            good = yield KitScan(what, good)

    recovery = KIT_RECOVERY + 1
    good = yield KitScan("the plant cannot be read at first", None)
    good = yield KitScan("a PV at first not finite", _with(good, "pv", 0, nan))
    if m.mv[0].name not in _apart(m):
        good = yield KitScan("an applied MV at first not finite", _with(good, "mv_applied", 0, nan))
    good = yield KitScan("no read-back at first", replace(good, mv_applied=None))
    yield from some(1, "the first good sample")
    good = yield KitScan("the plant cannot be read after the first good sample", None)
    yield from some(KIT_RECOVERY - 1, "before the first command of the law")
    yield from some(5)
    for what, spoilt in _doubtful(m):
        good = yield KitScan(what, spoilt(good))
        yield from some(recovery, f"after: {what}")
    good = yield KitScan("the plant cannot be read", None)
    yield from some(recovery, "after the plant could not be read")
    for missed in (1, MAX_GAP, MAX_GAP + 1):
        good = yield KitScan(f"{missed} periods missed", good, missed=missed)
        yield from some(2)
    good = yield KitScan("by hand", good, set_mode=Mode.MANUAL)
    yield from some(2, "by hand")
    good = yield KitScan("a fault by hand", _with(good, "pv", 0, nan))
    yield from some(2, "by hand")
    good = yield KitScan("back to AUTO", good, set_mode=Mode.AUTO)
    yield from some(3)
    good = yield KitScan("two faults in a row", None)
    good = yield KitScan("two faults in a row", None)
    good = yield KitScan("a good sample between faults", good)
    good = yield KitScan("a fault while it recovers", None)
    yield from some(recovery + 2, "after a fault while it recovers")
    good = yield KitScan("a command did not arrive, and the MV was moved", _moved(m, good), unwritten=True)
    yield from some(recovery, "after an MV that was moved")
    no_pv = _with(_moved(m, good), "pv", 0, nan)
    good = yield KitScan("a command did not arrive, the MV was moved, and a PV is not finite", no_pv, unwritten=True)
    yield from some(recovery, "after an MV that was moved")
    good = yield KitScan(
        "a command did not arrive, and there is no read-back", replace(good, mv_applied=None), unwritten=True
    )
    yield from some(recovery, "after a command that did not arrive")
    good = yield KitScan("by hand again", good, set_mode=Mode.MANUAL)
    good = yield KitScan("by hand a command did not arrive, and the MV was moved", _moved(m, good), unwritten=True)
    yield from some(2, "by hand again")
    good = yield KitScan("back to AUTO", good, set_mode=Mode.AUTO)
    yield from some(2, "the last samples")
    if "fresh" in m.inputs:
        good = yield from _gone(m, good)
    yield from _others(m, good)


STAYS_BAD = 3  # scans for which readings stay bad after they were bridged


def _gone(m: Manifest, good: Sample) -> Generator[KitScan, Sample, Sample]:
    """Readings that are bad for longer than they are bridged: of each PV alone, over a gap, and of all together.

    The next good sample is returned.
    """
    bridged = round(BRIDGE_PERIODS)
    for i, s in enumerate(m.pv):
        for k in range(bridged + STAYS_BAD):
            bad = nan if k % 2 else s.high + (s.high - s.low)
            good = yield KitScan(f"PV {s.name} is bad for {k + 1} scans", _with(good, "pv", i, bad))
        for _ in range(KIT_RECOVERY + 1):
            good = yield KitScan(f"after PV {s.name} was bad", good)
    good = yield KitScan("a PV is bad after missed periods", _with(good, "pv", 0, nan), missed=bridged)
    good = yield KitScan("a PV is bad after missed periods", _with(good, "pv", 0, nan))
    for k in range(bridged + STAYS_BAD):
        none = replace(good, pv=np.full(len(m.pv), nan))
        good = yield KitScan(f"all PVs are bad for {k + 1} scans", none)
    for _ in range(KIT_RECOVERY + 2):
        good = yield KitScan("after all PVs were bad", good)
    return good


def _others(m: Manifest, good: Sample) -> Generator[KitScan, Sample, None]:
    """Others command: in SHADOW, also over the period in which it ends, and after commands that did not arrive."""

    def pv_bad(sample: Sample) -> Sample:
        return _with(sample, "pv", 0, nan)

    def unread(sample: Sample) -> None:
        return None

    def no_read_back(sample: Sample) -> Sample:
        return replace(sample, mv_applied=None)

    def blind(sample: Sample) -> Sample:
        return no_read_back(pv_bad(sample))

    def outside(sample: Sample) -> Sample:
        return replace(sample, mv_applied=np.array([2 * s.high - s.low for s in m.mv], dtype=np.float64))

    # What the first scans show once a shadow has ended; others have moved the MV before the last of them.
    ends: tuple[tuple[str, tuple[Callable[[Sample], Sample | None], ...]], ...] = (
        ("", ()),
        ("a PV is not finite", (pv_bad,)),
        ("the plant cannot be read", (unread, unread)),
        ("a PV is not finite and there is no read-back", (blind,)),
        ("there is no read-back", (no_read_back,)),
        *(() if _apart(m) else (("the applied MV is far outside", (outside, outside)),)),
    )
    good = yield KitScan("others have the plant", good, set_mode=Mode.SHADOW)
    good = yield KitScan("others have the plant, and a PV is not finite", pv_bad(_moved(m, good)))
    for mode, shown in ((Mode.MANUAL, ends[:3]), (Mode.HOLD, ends), (Mode.AUTO, ends)):
        for words, spoilt in shown:
            good = yield KitScan("others have the plant", good, set_mode=Mode.SHADOW)
            good = yield KitScan("others move the MV", _moved(m, good))
            what = f"from SHADOW to {mode}" + (f", and {words}" if words else "")
            set_mode: Mode | None = mode
            for spoil in spoilt:
                moved = _moved(m, good) if spoil is pv_bad else good
                good, set_mode = (yield KitScan(what, spoil(moved), set_mode=set_mode)), None
            good = yield KitScan(f"{what}: others have moved the MV", _moved(m, good), set_mode=set_mode)
            for _ in range(KIT_RECOVERY if mode is Mode.AUTO else 1):
                good = yield KitScan(f"after {what}", good)
    good = yield KitScan("a command did not arrive, and the plant cannot be read", None, unwritten=True)
    good = yield KitScan("the plant cannot be read after a command that did not arrive", None)
    good = yield KitScan("the MV was moved meanwhile", _moved(m, good))
    for _ in range(KIT_RECOVERY + 1):
        good = yield KitScan("after the MV was moved", good)
    good = yield KitScan("others have the plant", good, set_mode=Mode.SHADOW)
    good = yield KitScan("from SHADOW to HOLD, and others have moved the MV", _moved(m, good), set_mode=Mode.HOLD)
    good = yield KitScan("its command did not arrive, and there is no read-back", no_read_back(good), unwritten=True)
    for _ in range(2):
        good = yield KitScan("after a command that did not arrive", good)


def _apart(m: Manifest) -> set[str]:
    """The MVs that a law can do without.

    This runtime goes on without one that is read back badly or elsewhere alone; a host may hold all of them.
    """
    return {e.signal for e in m.operate if e.group == "mv" and e.what == "use"} if "operate" in m.inputs else set()


def _moved(m: Manifest, good: Sample) -> Sample:
    """The sample after somebody has moved each MV far from where it stood."""
    assert good.mv_applied is not None
    to = [
        (s.low + (0.8 if at < s.middle else 0.2) * (s.high - s.low))
        if s.values is None
        else next((v for v in s.values if v != at), at)
        for s, at in zip(m.mv, np.asarray(good.mv_applied).tolist(), strict=True)
    ]
    return replace(good, mv_applied=np.array(to, dtype=np.float64))


def _doubtful(m: Manifest) -> Iterator[tuple[str, _Spoil]]:
    """Samples at and beyond each limit, as functions of a good one."""
    for i, s in enumerate(m.pv):
        for bad in (nan, inf, -inf):
            yield f"PV {s.name} {bad}", _Spoil("pv", i, bad)
        yield from _around("PV", "pv", i, s, InRange(m.pv).margin)
    for i, s in enumerate(m.dv if "dv" in m.inputs else ()):
        yield f"DV {s.name} not finite", _Spoil("dv", i, nan)
    for i, s in enumerate(m.mv):
        if s.name in _apart(m):
            continue
        yield f"applied MV {s.name} not finite", _Spoil("mv_applied", i, nan)
        if s.values is None:
            yield from _around("applied MV", "mv_applied", i, s, READ_BACK_MARGIN)
        elif len(s.values) > 1:
            between = (s.values[0] + s.values[1]) / 2
            yield f"applied MV {s.name} between two values", _Spoil("mv_applied", i, between)
    yield "no read-back", _Spoil("mv_applied", None, nan)
    for age in (0.9, 1.1, -0.5, nan):
        yield f"age {age} periods", _Spoil("age_s", None, age * m.period_s)


def _around(label: str, name: str, i: int, s: Signal, margin: float) -> Iterator[tuple[str, _Spoil]]:
    for share, words in ((1 - MARGIN_SHARE, "within its margin"), (1 + MARGIN_SHARE, "beyond its margin")):
        slack = share * margin * (s.high - s.low)
        yield f"{label} {s.name} below, {words}", _Spoil(name, i, s.low - slack)
        yield f"{label} {s.name} above, {words}", _Spoil(name, i, s.high + slack)


@dataclass(frozen=True, slots=True)
class _Spoil:
    name: str
    index: int | None
    value: float

    def __call__(self, sample: Sample) -> Sample:
        if self.name == "age_s":
            return replace(sample, age_s=self.value)
        if self.index is None:
            return replace(sample, mv_applied=None)
        return _with(sample, self.name, self.index, self.value)


def _with(sample: Sample, name: str, index: int, value: float) -> Sample:
    vector = np.array(getattr(sample, name), dtype=np.float64)
    vector[index] = value
    changed: dict[str, Any] = {name: vector}
    return replace(sample, **changed)
