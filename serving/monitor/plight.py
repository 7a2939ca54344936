"""Faults of any loop, whatever is normal in this one: nothing of them has to be learnt first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Signal

Array: TypeAlias = NDArray[np.float64]

FAR = 0.1  # of a set point's range: an error beyond it is one that the MV should remove
AT_END = 1e-6  # of the range
MEMORY = 100  # scans over which turns and moves are averaged: of 40 noisy ones four of five turn round now and then
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
        self._steps = [s.values is not None for s in mv]
        self.since_s = [float("nan")] * len(mv)
        self.forget()

    def forget(self) -> None:
        """The samples that follow have nothing to do with those before."""
        n = len(self._span)
        self.stuck, self.end = [0] * n, [0.0] * n  # scans; 1 upper end, -1 lower end
        self.turns, self.move, self._count = [0.0] * n, [0.0] * n, 0
        self._last: list[float] | None = None
        self._last_move = [0.0] * n

    def add(self, mv: Array, error: float, time_s: float) -> None:
        """The MVs (n_mv,) of a scan, the largest error as a share of its range, and when that was [s since 1970]."""
        first, far = self._last is None, error > FAR
        self._count += not first
        weight = 1 / min(max(self._count, 1), MEMORY)
        shares = ((mv - self._low) / self._span).tolist()
        for i, share in enumerate(shares):  # a loop over one or two is faster than a dozen calls of numpy
            end = 1.0 if share >= 1 - AT_END else -1.0 if share <= AT_END else 0.0
            if far and end and end == self.end[i]:
                self.stuck[i] += 1
            else:
                self.stuck[i], self.since_s[i] = 0, time_s
            self.end[i] = end
            if self._last is not None:
                move = share - self._last[i]
                self.turns[i] += (float(move * self._last_move[i] < 0) - self.turns[i]) * weight
                self.move[i] += (abs(move) - self.move[i]) * weight
                self._last_move[i] = move
        self._last = shares

    def jammed(self, i: int) -> bool:
        """Whether an MV has stayed at its end for too long."""
        return self.stuck[i] > self.patience

    def flutters(self, i: int) -> bool:
        """Whether an MV turns round at nearly every scan, by moves that matter."""
        known = self._count >= MEMORY and not self._steps[i]
        return known and self.turns[i] > TURNING and self.move[i] > MOVING
