"""Scans in which others have the MV: an operator moves it by hand, or others command in SHADOW."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace
from functools import partial
from math import nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.conformance.kit_samples import KitScan, apart, changed, moved
from loopwright.serving.guard import Sample
from loopwright.serving.manifest import Manifest
from loopwright.serving.modes import Mode

Array: TypeAlias = NDArray[np.float64]
Scans: TypeAlias = Generator[KitScan, Sample, Sample]
"""Scans of the kit: ``send`` takes the next good sample, and the last one is returned."""

NOT_FINITE = "a command did not arrive, and the applied MVs are not finite"


def no_read_back(sample: Sample) -> Sample:
    """The sample of a plant that does not read its MV back."""
    return replace(sample, mv_applied=None)


def outside(m: Manifest, sample: Sample) -> Sample:
    """The sample whose MVs are read back far outside their ranges."""
    return replace(sample, mv_applied=np.array([2 * s.high - s.low for s in m.mv], dtype=np.float64))


def too_old(m: Manifest, sample: Sample) -> Sample:
    """A sample that every law refuses, without anything that is wrong with its numbers."""
    return replace(sample, age_s=1.5 * m.period_s)


def unread(sample: Sample) -> None:
    """No sample: the plant cannot be read."""


def at(m: Manifest, share: float) -> Array:
    """MVs (n_mv,) at a share of their ranges; of a discrete one a value."""
    ends = [
        s.low + share * (s.high - s.low) if s.values is None else s.values[round(share * (len(s.values) - 1))]
        for s in m.mv
    ]
    return np.array(ends, dtype=np.float64)


def a_little_off(m: Manifest, mv: Array) -> Array:
    """MVs (n_mv,) off ``mv`` by half of what they may move in a period, so that a way by hand takes one scan."""
    off = [
        value
        if s.values is not None
        else value + (0.5 if value < s.middle else -0.5) * min(s.max_move or 0.1 * (s.high - s.low), s.high - s.middle)
        for s, value in zip(m.mv, mv.tolist(), strict=True)
    ]
    return np.array(off, dtype=np.float64)


def never_read_back(m: Manifest, good: Sample, recovery: int) -> Scans:
    """A plant that has not been read back yet, from nowhere known on; at the end it is not known again."""
    old, none = partial(too_old, m), no_read_back
    good = yield KitScan("by hand, before the plant was ever read back", None, Mode.MANUAL, set_mv=at(m, 0.4))
    good = yield KitScan("by hand, and there is no read-back", none(good))
    good = yield KitScan("by hand elsewhere, and there is no read-back", none(good), set_mv=at(m, 0.6))
    lost = "a command by hand did not arrive, and there has never been a read-back"
    good = yield KitScan(lost, none(good), unwritten=True)
    good = yield KitScan(f"{lost}: a sample is too old", old(none(good)), unwritten=True)
    good = yield KitScan(f"{lost}: no sample", None, unwritten=True)
    good = yield KitScan("from MANUAL to AUTO without a read-back", none(good), set_mode=Mode.AUTO)
    good = yield KitScan("AUTO without a read-back", none(good))
    lost = "a command did not arrive, and there has never been a read-back"
    good = yield KitScan(f"{lost}: no sample", None, unwritten=True)
    good = yield KitScan(f"{lost}: a sample is too old", old(none(good)), unwritten=True)
    for _ in range(recovery + 1):
        good = yield KitScan(f"after {lost}", none(good))
    good = yield from _forgotten(good)
    unknown = "by hand from nowhere known, on a plant that reads back"
    good = yield KitScan(f"{unknown}: no sample", None, Mode.MANUAL, set_mv=at(m, 0.9))
    good = yield KitScan(f"{unknown}: a sample is too old", old(none(good)))
    good = yield KitScan(f"{unknown}: a good sample without a read-back", none(good))
    good = yield from _forgotten(good)
    if apart(m):
        return good
    for bad, words in ((partial(outside, m), "outside"), (_not_finite, "not finite")):
        good = yield KitScan(
            f"by hand from nowhere known, read back {words}", bad(good), Mode.MANUAL, set_mv=at(m, 0.4)
        )
        good = yield KitScan(f"by hand, and no read-back after one {words}", none(good))
    return good


def _forgotten(good: Sample) -> Scans:
    """A command did not arrive, and the read-back after it is bad: then nobody knows where the MV stands."""
    good = yield KitScan(NOT_FINITE, _not_finite(good), unwritten=True)
    return (yield KitScan("no read-back after a bad one: not known where the MV stands", no_read_back(good)))


def _not_finite(sample: Sample) -> Sample:
    assert sample.mv_applied is not None
    return replace(sample, mv_applied=np.full(len(sample.mv_applied), nan))


def others_command(m: Manifest, good: Sample, recovery: int) -> Generator[KitScan, Sample, Sample]:
    """Others command: in SHADOW, also over the period in which it ends, and after commands that did not arrive."""

    def pv_bad(sample: Sample) -> Sample:
        return changed(sample, "pv", 0, nan)

    def blind(sample: Sample) -> Sample:
        return no_read_back(pv_bad(sample))

    # What the first scans show once a shadow has ended; others have moved the MV before the last of them.
    ends: tuple[tuple[str, tuple[Callable[[Sample], Sample | None], ...]], ...] = (
        ("", ()),
        ("a PV is not finite", (pv_bad,)),
        ("the plant cannot be read", (unread, unread)),
        ("a PV is not finite and there is no read-back", (blind,)),
        ("there is no read-back", (no_read_back,)),
        *(() if apart(m) else (("the applied MV is far outside", (partial(outside, m), partial(outside, m))),)),
    )
    good = yield KitScan("others have the plant", good, set_mode=Mode.SHADOW)
    good = yield KitScan("others have the plant, and a PV is not finite", pv_bad(moved(m, good)))
    for mode, shown in ((Mode.MANUAL, ends[:3]), (Mode.HOLD, ends), (Mode.AUTO, ends)):
        for words, spoilt in shown:
            good = yield KitScan("others have the plant", good, set_mode=Mode.SHADOW)
            good = yield KitScan("others move the MV", moved(m, good))
            what = f"from SHADOW to {mode}" + (f", and {words}" if words else "")
            set_mode: Mode | None = mode
            for spoil in spoilt:
                now = moved(m, good) if spoil is pv_bad else good
                good, set_mode = (yield KitScan(what, spoil(now), set_mode=set_mode)), None
            good = yield KitScan(f"{what}: others have moved the MV", moved(m, good), set_mode=set_mode)
            for _ in range(recovery if mode is Mode.AUTO else 1):
                good = yield KitScan(f"after {what}", good)
    good = yield KitScan("a command did not arrive, and the plant cannot be read", None, unwritten=True)
    good = yield KitScan("the plant cannot be read after a command that did not arrive", None)
    good = yield KitScan("the MV was moved meanwhile", moved(m, good))
    for _ in range(recovery + 1):
        good = yield KitScan("after the MV was moved", good)
    good = yield KitScan("others have the plant", good, set_mode=Mode.SHADOW)
    good = yield KitScan("from SHADOW to HOLD, and others have moved the MV", moved(m, good), set_mode=Mode.HOLD)
    good = yield KitScan("its command did not arrive, and there is no read-back", no_read_back(good), unwritten=True)
    for _ in range(2):
        good = yield KitScan("after a command that did not arrive", good)
    return good


def by_hand(m: Manifest, good: Sample, recovery: int) -> Scans:
    """An operator sends the MV: over samples of each kind, after others, and around commands that did not arrive."""
    none, old = no_read_back, partial(too_old, m)

    def on(
        n: int, what: str, spoil: Callable[[Sample], Sample | None] = lambda s: s
    ) -> Generator[KitScan, Sample, None]:
        nonlocal good
        for _ in range(n):
            good = yield KitScan(what, spoil(good))

    # The way itself.
    good = yield KitScan("sent by hand in AUTO", good, set_mode=Mode.AUTO, set_mv=at(m, 0.9))
    yield from on(1, "good")
    good = yield KitScan("sent by hand", good, set_mode=Mode.MANUAL, set_mv=at(m, 0.7))
    yield from on(2, "on its way by hand")
    yield from on(1, "on its way by hand, and a sample is too old", old)
    yield from on(1, "on its way by hand, and the plant cannot be read", unread)
    good = yield KitScan("sent beyond the range by hand", good, set_mv=at(m, 1.5) if _continuous(m) else at(m, 0.7))
    good = yield KitScan("HOLD on a way by hand", good, set_mode=Mode.HOLD)
    good = yield KitScan("sent by hand in HOLD", good, set_mv=at(m, 0.2))
    yield from on(1, "HOLD")
    good = yield KitScan("sent back by hand", good, set_mode=Mode.MANUAL, set_mv=at(m, 0.3))
    yield from on(1, "on its way back by hand")
    good = yield KitScan("AUTO on a way by hand", good, set_mode=Mode.AUTO)
    yield from on(2, "good")
    # After others.
    for words, first in (
        ("others have moved the MV", partial(moved, m)),
        ("the plant cannot be read", unread),
        ("there is no read-back", none),
        *(() if apart(m) else (("it is read back outside", partial(outside, m)),)),
    ):
        what = f"sent by hand as SHADOW ends, and {words}"
        good = yield KitScan("others have the plant", good, set_mode=Mode.SHADOW)
        good = yield KitScan("others move the MV", moved(m, good))
        good = yield KitScan(what, first(good), set_mode=Mode.MANUAL, set_mv=at(m, 0.45))
        good = yield KitScan(f"{what}: no read-back", none(good))
        yield from on(2, f"after it was {what}")
    # Commands that did not arrive.
    good = yield KitScan("sent by hand", good, set_mv=at(m, 0.8))
    good = yield KitScan("on a way by hand a command did not arrive: no read-back", none(good), unwritten=True)
    yield from on(2, "on its way by hand")
    good = yield KitScan("on a way by hand a command did not arrive: moved", moved(m, good), unwritten=True)
    good = yield KitScan("by hand a command did not arrive, and the plant cannot be read", None, unwritten=True)
    good = yield KitScan("sent by hand while it is not known where the MV stands", None, set_mv=at(m, 0.1))
    yield from on(2, "found after a command by hand that did not arrive")
    for mode in (Mode.HOLD, Mode.AUTO):
        assert good.mv_applied is not None
        little = a_little_off(m, good.mv_applied)
        good = yield KitScan("sent a little by hand", good, set_mode=Mode.MANUAL, set_mv=little)
        good = yield KitScan("its command did not arrive, and the plant cannot be read", None, unwritten=True)
        good = yield KitScan(f"from MANUAL to {mode} after a command that did not arrive", none(good), set_mode=mode)
        yield from on(2, f"from MANUAL to {mode}")
    # The operator changes what is set before the loop hears of a command that did not arrive.
    yield from on(2, "good")
    what = "to MANUAL after a command of the law that did not arrive"
    good = yield KitScan(f"{what}: no read-back", none(good), set_mode=Mode.MANUAL, unwritten=True)
    yield from on(1, what)
    good = yield KitScan("back to AUTO", good, set_mode=Mode.AUTO)
    yield from on(2, "good")
    sent = KitScan(f"sent by hand, {what}", none(good), Mode.MANUAL, unwritten=True, set_mv=at(m, 0.55))
    good = yield sent
    yield from on(2, what)
    assert good.mv_applied is not None
    good = yield KitScan("sent a little by hand", good, set_mv=a_little_off(m, good.mv_applied))
    what = "to AUTO after a command by hand that did not arrive"
    good = yield KitScan(f"{what}: no read-back", none(good), set_mode=Mode.AUTO, unwritten=True)
    yield from on(recovery, what)
    # A bad read-back: the old MV is nothing to go back to.
    for mode in (Mode.MANUAL, Mode.AUTO):
        good = yield KitScan(f"in {mode}", good, set_mode=mode)
        good = yield from _forgotten(good)
        yield from on(recovery + 1, "read back again")
    return good


def _continuous(m: Manifest) -> bool:
    return all(s.values is None for s in m.mv)
