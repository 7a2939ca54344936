"""MVs that the plant has itself: in local by its own word, read back badly, or elsewhere than they were commanded."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from math import inf, isfinite
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.fields import shown
from loopwright.serving.guard import READ_BACK_MARGIN, Fault, Sample, implausible
from loopwright.serving.manifest import Signal
from loopwright.serving.mv_readback import EQUAL_COMMANDS, SAME_READ_BACK

Array: TypeAlias = NDArray[np.float64]

ELSEWHERE_PERIODS = 20.0  # periods: a valve that lags or waits has begun to move long before
FORGIVEN = 0.02  # of a scan elsewhere, for each scan there: a law that goes on from the read-back is seldom far off it


class LocalMvs:
    """Judges at each sample which MVs the plant has, and remembers the last good read-back of each.

    An MV is the plant's while ``Sample.local`` says so, while nothing sound is read back of it, and once it has been
    elsewhere for ``after_s``: more than ``READ_BACK_MARGIN`` off its command without going there. The first two end by
    themselves. The last one cannot be seen to end, as the command follows the read-back meanwhile: ``trust`` ends it.

    After a command that did not reach the plant only a read-back tells where an MV stands. A bad one then counts as
    for any other law: nothing is written.

    Parameters
    ----------
    signals
        The MVs.
    period_s
        From sample to sample [s].
    after_s
        Time for which an MV may be elsewhere without going there [s]; 0: for ever, None: ``ELSEWHERE_PERIODS`` periods.

    Raises
    ------
    LoopError
        ``after_s`` is no such time.
    """

    def __init__(self, signals: Sequence[Signal], period_s: float, after_s: float | None = None) -> None:
        if after_s is not None and not 0 <= after_s < inf:
            raise LoopError(f"local_s is {after_s}; it must be a finite number of seconds, 0 (never) or more")
        self._signals = tuple(signals)
        span = np.array([s.high - s.low for s in signals])
        self._same = SAME_READ_BACK * span
        # By how much a sound read-back may be off its command, shape: (n_mv,).
        self.near = np.array([0.0 if s.values is not None else READ_BACK_MARGIN for s in signals]) * span
        most = ELSEWHERE_PERIODS if after_s is None else after_s / period_s
        self._most = most or inf  # scans
        n = len(signals)
        self.why: dict[str, str] = {}  # by name, of those that the plant has
        self.blind = np.zeros(n, dtype=bool)  # those without a sound read-back at the last sample
        self._apart: dict[str, str] = {}  # of those that were elsewhere for too long
        self._known = np.full(n, np.nan)  # the last sound read-back of each
        self._before = np.full(n, np.nan)  # the read-back at the last scan, as far as that one had a sound one
        self._command = np.full(n, np.nan)  # the last one that was written
        self._rested = 0
        self._count = np.zeros(n)  # scans elsewhere

    @property
    def away(self) -> NDArray[np.bool_]:
        """Whether the plant has each MV (n_mv,)."""
        return np.array([s.name in self.why for s in self._signals], dtype=bool)

    def commanded(self, mv: Array, *, written: bool) -> None:
        """The command (n_mv,) that a scan ends with. In a shadow nothing is written, so nothing can be elsewhere."""
        if not written:
            self._command = np.full(len(mv), np.nan)
            return
        self._rested = self._rested + 1 if np.array_equal(mv, self._command) else 0
        self._command = mv.copy()

    def trust(self, names: Collection[str] | None = None) -> None:
        """An operator says that these MVs, or all, follow their commands again."""
        for name in list(self._apart) if names is None else names:
            self._apart.pop(name, None)
        self._count.fill(0.0)

    def look(self, sample: Sample, able: NDArray[np.bool_], *, lost: bool) -> Sample:
        """The sample as the law may have it: with the last good read-back of each MV that has no sound one now.

        ``able`` (n_mv,) says which MVs the law can do without, the others stay as they are. ``lost``: the last command
        did not reach the plant.
        """
        if not able.any():
            self.why = {}
            self._apart.clear()
            return sample
        if not isinstance(sample, Sample):
            return sample
        n, local, applied = len(self._signals), sample.local, sample.mv_applied
        if local and not (isinstance(local, tuple) and len(local) == n and all(isinstance(why, str) for why in local)):
            return replace(
                sample, fault=f"local is {shown(local)}; it needs a text for each of {n} MVs, or none at all"
            )
        self.why = {}
        read = isinstance(applied, np.ndarray) and applied.dtype.kind in "fiu" and applied.shape == (n,)
        found = np.array(applied, dtype=np.float64) if read else np.full(n, np.nan)
        bad = [self._unsound(s, value) if read else "" for s, value in zip(self._signals, found.tolist(), strict=True)]
        self.blind = np.array([bool(why) for why in bad])
        if read and not lost:
            self._elsewhere(found, np.array([not why for why in bad]) & able)
        elif lost:
            self._before = np.full(n, np.nan)
        for i, s in enumerate(self._signals):
            why = (local[i] if local else "") or bad[i] or self._apart.get(s.name, "")
            if able[i] and why and not (bad[i] and lost):
                self.why[s.name] = why
            if not bad[i] and read:
                self._known[i] = min(max(found[i], s.low), s.high)
            elif able[i] and read and not lost:
                found[i] = self._known[i] if isfinite(self._known[i]) else self._command[i]
        return replace(sample, mv_applied=found) if any(bad) and read else sample

    @staticmethod
    def _unsound(signal: Signal, value: float) -> str:
        """Why a read-back tells nothing; empty: it does."""
        if not isfinite(value):
            return Fault(f"applied MV {signal.name} is {value}", "number", f"MV {signal.name}")
        return implausible((signal,), (value,)) or ""

    def _elsewhere(self, found: Array, judged: NDArray[np.bool_]) -> None:
        """Count the scans for which each MV was elsewhere without going there."""
        off, asked, got = found - self._command, self._command - self._before, found - self._before
        far = judged & (np.abs(off) > self.near)
        goes = (np.abs(asked) > self.near) & (got * np.sign(asked) > self._same)
        there = judged & ~far & (self._rested >= EQUAL_COMMANDS)
        self._count = np.where(far, self._count + 1.0, np.maximum(self._count - FORGIVEN, 0.0))
        self._count[goes | there | ~judged] = 0.0
        for i in np.flatnonzero(self._count >= self._most).tolist():
            s = self._signals[i]
            words = f"MV {s.name} reads back {found[i]:.6g} {s.unit} where {self._command[i]:.6g} {s.unit} is commanded"
            self._apart.setdefault(s.name, Fault(words, "elsewhere", f"MV {s.name}"))
        self._before = np.where(judged, found, np.nan)


def none_left(signals: Sequence[Signal], away: Mapping[str, str], used: NDArray[np.bool_]) -> str:
    """Why a law can move nothing: the plant has all MVs (n_mv,) that are ``used``; empty where one is left."""
    if not away or any(used[i] and s.name not in away for i, s in enumerate(signals)):
        return ""
    reasons = "; ".join(away.values())
    return Fault(f"{reasons}; no manipulated variable is left", "local", ", ".join(f"MV {name}" for name in away))
