"""The MV that the plant has, as a sample tells: read back, or the last one that was commanded."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from math import isnan
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import ContractError, SampleError
from loopwright.serving.guard import READ_BACK_MARGIN, Sample, implausible, reworded
from loopwright.serving.manifest import Signal
from loopwright.serving.ranges import numbers

# --------------------------------------------------------------------- MVs after commands that did not reach the plant
Array: TypeAlias = NDArray[np.float64]

SAME_READ_BACK = 1e-3  # of an MV's range: a read-back no farther than that from where it was expected has not moved
OFFSET_ROUNDING = 1e-9  # of an MV's range: less is no offset, and the read-back itself is where the MV stands
EQUAL_COMMANDS = 5  # equal commands in a row, but for rounding: a read-back that lags has followed


class StandingMv:
    """The MVs that the plant has, as far as the loop knows.

    While commands arrive, they are the last command. Once one did not arrive, others may have moved an MV, and the next
    read-back decides. A sound read-back may differ from its command all the time, by an actuator's offset: without it,
    each outage would carry the MV away by that much. The offset is learnt while the command rests.
    """

    def __init__(self, signals: Sequence[Signal], mv: Array) -> None:
        span = np.array([s.high - s.low for s in signals])
        self._low, self._high = np.array([s.low for s in signals]), np.array([s.high for s in signals])
        self._same = SAME_READ_BACK * span
        self._least = OFFSET_ROUNDING * span
        self._most = np.array([0.0 if s.values is not None else READ_BACK_MARGIN for s in signals]) * span
        self.mv = mv.copy()  # shape: (n_mv,)
        self._rested = 0
        # What is seen just before a loss may be somebody's move already: an offset counts once a command has followed.
        self._offset = self._seen = np.zeros(len(signals))
        self.theirs = np.zeros(len(signals), dtype=bool)  # shape: (n_mv,), moved by others now: no offset shows
        self.lost = False  # whether the last command did not arrive, and no read-back has come since

    def commanded(self, mv: Array, *, written: bool) -> None:
        """A command (n_mv,) went out, and nothing was heard of its loss. ``written`` by this loop, that is.

        In a shadow the MV is what others make of it: what moves then is no offset from a command.
        """
        if self.lost:
            return
        if written:
            rests = bool((np.abs(mv - self.mv) <= self._least).all())  # a law at rest moves by rounding
            self._rested = self._rested + 1 if rests else 0
            self._offset = self._seen
        else:
            self._rested, self._seen = 0, self._offset
        self.mv = mv.copy()

    def at(self, applied: Array) -> Array:
        """Where MVs (n_mv,) stand that somebody else moves: the command that would keep them there."""
        found = np.clip(applied - self._offset, self._low, self._high)
        return np.where(np.abs(found - self.mv) <= self._same, self.mv, found)

    def seen(self, applied: Array) -> Array | None:
        """A read-back (n_mv,). Where the MVs stand after a loss, else None: HOLD then keeps what it has."""
        if not self.lost:
            if self._rested >= EQUAL_COMMANDS:
                off = applied - self.mv
                offset = np.where((self._least < np.abs(off)) & (np.abs(off) <= self._most), off, 0.0)
                self._seen = np.where(self.theirs, self._offset, offset)
            return None
        self.mv, self.lost = self.at(applied), False
        self._rested, self._seen = 0, self._offset
        return self.mv


# ------------------------------------------------------------------------------------------------------ the applied MV

UNREAD = "the last MV did not reach the plant: nothing is written before a good read-back tells where the MV stands"
UNTOLD = "others had the MV until now: nothing is written before a good read-back tells where the MV stands"


class ShownMV(NamedTuple):
    """The MV as one sample shows it."""

    applied: Array | None = None  # shape: (n_mv,), the read-back within its range; None where there is no sound one
    found: Array | None = None  # shape: (n_mv,), where the MV stands, at the scan that learns it after a loss
    silent: str = ""  # why nothing may be written; empty: it may
    outside: bool = False  # the MV stands where the loop may not command it
    bad: bool = False  # there is a read-back that no actuator can have
    forgotten: bool = False  # nothing tells any more where the MV stands, and the old one is nothing to go back to


class AppliedMV:
    """Reads the applied MV out of samples, and finds it again after commands that did not reach the plant.

    Such a command leaves it unknown where the MV stands: others may move it meanwhile. The next read-back tells, also
    that of a sample which is refused for another reason, and nothing writes an old MV over it. Nothing is written while
    the read-back is bad, nor, where the MV stands outside its range, until it is back. A good sample without a
    read-back says that nothing is read back, and the old MV is written again; not so after a bad read-back, since which
    the plant is known to have one. A plant that has never had one gets the old MV at once. The same holds where a
    shadow has just ended (``take``): others may have moved the MV since its last sample.
    """

    def __init__(self, signals: Sequence[Signal], mv: Array) -> None:
        self._signals = tuple(signals)
        self._ranges = [(s.low, s.high, s.values) for s in signals]
        self._standing = StandingMv(signals, mv)
        self._given, self._written = mv, False  # shape: (n_mv,), the last command, and whether it went to the plant
        self._is_read = False  # whether any sample has ever had a read-back, sound or not
        self._doubted = False  # since nobody knows where the MV stands, a read-back was bad
        self._taken = False  # whether others had the MV until now, and no sample has told since where it stands

    @property
    def lost(self) -> bool:
        """Whether the last command did not arrive, and no read-back has come since."""
        return self._standing.lost

    @property
    def is_read(self) -> bool:
        """Whether the plant has ever been read back, soundly or not: a later sample may tell where the MV stands."""
        return self._is_read

    @property
    def taken(self) -> bool:
        """Whether others had the MV until now, and no sample has told since where it stands."""
        return self._taken

    def take(self, taken: bool) -> None:
        """``taken``: others had the MV until now."""
        self._taken = taken

    def lose(self) -> None:
        """The last command did not arrive."""
        self._standing.lost = True

    def command(self, mv: Array, *, written: bool) -> None:
        """The command of now (n_mv,); whether it arrives is known at the next scan. A shadow writes nothing."""
        self._given, self._written = mv.copy(), written

    def arrived(self) -> None:
        """A scan begins, and nothing was heard of a loss."""
        self._standing.commanded(self._given, written=self._written)

    def look(self, sample: Sample, last: Array, *, refused: bool, theirs: NDArray[np.bool_] | None = None) -> ShownMV:
        """The MV by the sample; ``last`` is the last command (n_mv,), ``refused`` whether the sample is of no use.

        ``theirs`` (n_mv,) are MVs that the plant has itself.

        A refused sample without a read-back tells nothing; a good one says that nothing is read back at all. Where it
        was not known where the MV stands, and it stands outside its range, somebody has moved it there. Nothing is
        written then, and none while the read-back is bad: what would be written is old.
        """
        if theirs is not None:
            self._standing.theirs = theirs
        try:
            applied = None if sample.mv_applied is None else self.read_back(sample, last)
        except Exception:  # no sample, or no MV that any actuator can have
            return self.unread(sample)
        if applied is not None:
            self._doubted = self._doubted and refused and not (self.lost or self._taken)
            self._is_read, self._taken = True, False
            return ShownMV(applied, self._standing.seen(applied))
        if refused:
            return self.unread(sample)
        forgotten, self._doubted = self._doubted, False
        self._standing.lost = self._taken = False
        return ShownMV(forgotten=forgotten)

    def read_back(self, sample: Sample, last: Array) -> Array:
        """The applied MV (n_mv,) within its range; the last command if there is no read-back.

        Raises ContractError for a wrong shape or type, and SampleError for an implausible value or where there is
        neither. HOLD commands the read-back, so this check does not depend on the guards.
        """
        if sample.mv_applied is None:
            if isnan(last[0]):
                raise SampleError("there is no read-back, so where the MV stands is not known and nothing is written")
            return last
        try:
            applied = np.array(numbers(sample.mv_applied), dtype=np.float64, ndmin=1)
        except TypeError as error:
            raise ContractError(f"applied MV {error}; it needs numbers") from None  # "1" and True are none
        if applied.shape != last.shape:
            raise ContractError(f"applied MV has the shape {applied.shape} instead of {last.shape}")
        values = applied.tolist()
        for value, (low, high, allowed) in zip(values, self._ranges, strict=True):
            if not low <= value <= high or (allowed is not None and value not in allowed):
                reason = implausible(self._signals, values)
                if reason:
                    raise SampleError(reason)
                lows, highs, _ = zip(*self._ranges, strict=True)
                return np.clip(applied, lows, highs)
        return applied

    def at(self, applied: Array) -> Array:
        """The command (n_mv,) that keeps each MV where it stands by its read-back, an actuator's offset apart."""
        return self._standing.at(applied)

    def unread(self, sample: Sample | None = None) -> ShownMV:
        """No sound read-back, or no sample: nothing is written after a loss or a take-over."""
        bad = getattr(sample, "mv_applied", None) is not None
        self._is_read = self._is_read or bad
        if not self._is_read:  # nothing would ever tell more
            self._standing.lost = self._taken = False
        if not (self.lost or self._taken):
            return ShownMV(bad=bad)
        self._doubted = self._doubted or bad
        outside = self._outside(sample)
        if outside:
            words = reworded(outside, f"{outside}: nothing is written before it is back")
            return ShownMV(silent=words, outside=True, bad=True)
        return ShownMV(silent=UNREAD if self.lost else UNTOLD, bad=bad)

    def _outside(self, sample: Sample | None) -> str:
        """Why no loop can have commanded the MV that the plant has; empty where the sample does not tell."""
        with suppress(Exception):  # no sample, or no MV at all
            applied = np.array(getattr(sample, "mv_applied", None), dtype=np.float64, ndmin=1)
            if applied.shape == self._given.shape and np.isfinite(applied).all():
                return implausible(self._signals, applied.tolist()) or ""
        return ""
