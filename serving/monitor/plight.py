"""What is wrong in any loop, whatever is normal in this one: nothing of it has to be learnt first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from serving.manifest import Signal

Array: TypeAlias = NDArray[np.float64]

FAR = 0.1  # of a set point's range: an error beyond it is one that the MV should remove
AT_END = 1e-6  # of the range
MEMORY = 40  # scans over which turns and moves are averaged
TURNING, MOVING = 0.8, 0.05  # share of moves that turn round; mean move, of the range


class Plight:
    """MVs that stay at an end of their range beside a large error, and MVs that turn round at nearly every scan.

    Parameters
    ----------
    mv
        The MVs.
    patience
        Scans for which an MV may stay at its end beside an error above FAR: a change of the set point takes as many.
    """

    def __init__(self, mv: Sequence[Signal], patience: int) -> None:
        self.patience = patience
        self._low = np.array([s.low for s in mv])
        self._span = np.array([s.high - s.low for s in mv])
        # An MV of few values turns round as a matter of course.
        self._steps = np.array([s.values is not None for s in mv])
        self.since_s = np.full(len(mv), np.nan)
        self.forget()

    def forget(self) -> None:
        """What follows has nothing to do with what was."""
        n = len(self._span)
        self.stuck, self.end = np.zeros(n, dtype=np.int64), np.zeros(n)  # scans; 1 upper end, -1 lower end
        self.turns, self.move, self._count = np.zeros(n), np.zeros(n), 0
        self._last: Array | None = None
        self._last_move = np.zeros(n)

    def add(self, mv: Array, error: float, time_s: float) -> None:
        """The MVs (n_mv,) of a scan, the largest error as a share of its range, and when that was [s since 1970]."""
        share = (mv - self._low) / self._span
        end = (share >= 1 - AT_END).astype(np.float64) - (share <= AT_END)
        stays = (end != 0) & (end == self.end) & (error > FAR)
        self.stuck = np.where(stays, self.stuck + 1, 0)
        self.since_s = np.where(stays, self.since_s, time_s)
        self.end = end
        if self._last is not None:
            move = (mv - self._last) / self._span
            turned = move * self._last_move < 0
            self._count += 1
            weight = 1 / min(self._count, MEMORY)
            self.turns += (turned - self.turns) * weight
            self.move += (np.abs(move) - self.move) * weight
            self._last_move = move
        self._last = mv.copy()

    def jammed(self, i: int) -> bool:
        """Whether an MV has stayed at its end for too long."""
        return bool(self.stuck[i] > self.patience)

    def flutters(self, i: int) -> bool:
        """Whether an MV turns round at nearly every scan, by moves that matter."""
        known = self._count >= MEMORY and not self._steps[i]
        return bool(known and self.turns[i] > TURNING and self.move[i] > MOVING)
