"""Faults of any loop, and actuators that no longer follow: nothing of them has to be learnt first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.guard import READ_BACK_MARGIN
from loopwright.serving.manifest import Signal
from loopwright.serving.mv_readback import EQUAL_COMMANDS, SAME_READ_BACK

# -------------------------------------------------------------------------------------------------- faults of any loop
Array: TypeAlias = NDArray[np.float64]

FAR_ERROR = 0.1  # of a set point's range: an error beyond it is one that the MV should remove
ACTUATOR_AT_END = 1e-6  # of the range
MEMORY = 100  # scans over which turns and moves are averaged: of 40 noisy ones four of five turn round now and then
TURNING_SHARE, TURNING_MOVE = 0.8, 0.05  # share of moves that turn round; mean move, of the range


class ActuatorFaults:
    """MVs that stay at an end of their range beside a large error, and MVs that turn round at nearly every scan.

    Parameters
    ----------
    mv
        The MVs.
    patience
        Scans for which an MV may stay at its end beside an error above FAR_ERROR: a change of the set point takes as
        many.
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

    def add(self, mv: Array, error: float, time_s: float, moved: Sequence[bool] | None = None) -> None:
        """The MVs (n_mv,) of a scan, the largest error as a share of its range, and when that was [s since 1970].

        ``moved`` (n_mv,) are those that the law may move; None: all. One that it may not is no fault where it stands.
        """
        first, far = self._last is None, error > FAR_ERROR
        self._count += not first
        weight = 1 / min(max(self._count, 1), MEMORY)
        shares = ((mv - self._low) / self._span).tolist()
        for i, share in enumerate(shares):  # a loop over one or two is faster than a dozen calls of numpy
            end = 1.0 if share >= 1 - ACTUATOR_AT_END else -1.0 if share <= ACTUATOR_AT_END else 0.0
            if moved is not None and not moved[i]:
                self._rests(i, time_s)
                continue
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

    def _rests(self, i: int, time_s: float) -> None:
        """The law does not move this MV: what it does is no fault of the loop's."""
        self.stuck[i], self.end[i], self.since_s[i], self._last_move[i] = 0, 0.0, time_s, 0.0

    def jammed(self, i: int) -> bool:
        """Whether an MV has stayed at its end for too long."""
        return self.stuck[i] > self.patience

    def flutters(self, i: int) -> bool:
        """Whether an MV turns round at nearly every scan, by moves that matter."""
        known = self._count >= MEMORY and not self._steps[i]
        return known and self.turns[i] > TURNING_SHARE and self.move[i] > TURNING_MOVE


# --------------------------------------------------------------------- whether each MV's read-back follows its command

STILL_READ_BACK = 0.005  # of the range: a read-back that moves by less may be noise, or its resolution
BEYOND_DEADBAND = 0.05  # of the range: so far no deadband of a sound actuator reaches


class Following:
    """Read-backs r(k) beside the commands c(k-1) that they answer, both as shares of the MV's range.

    A read-back stands while it stays within STILL_READ_BACK of where it was, at r0 with the command c0. It does not
    follow where

        |c - c0| > BEYOND_DEADBAND    at ``patience`` scans in a row, or
        c - r - offset > SAME_READ_BACK, always with one sign, beside an error above FAR_ERROR    at twice as many.

    The second is for laws that add to the applied MV: their command stays near a read-back that is stuck. The offset is
    that of a command which rests and was followed, up to READ_BACK_MARGIN. An MV at the end of its range asks for
    nothing more. A slow actuator, one with a lag, a deadband or a coarse read-back moves within that time.

    Parameters
    ----------
    mv
        The MVs.
    patience
        Scans, a settling time of the loop: no actuator of it is slower.
    """

    def __init__(self, mv: Sequence[Signal], patience: int) -> None:
        self.patience = patience
        self._low = np.array([s.low for s in mv])
        self._span = np.array([s.high - s.low for s in mv])
        self._n = len(mv)
        self.since_s = [float("nan")] * self._n
        self._offset = [0.0] * self._n
        self.forget()

    def forget(self) -> None:
        """Forget the past: the next scans have nothing to do with it."""
        n = self._n
        self._stood: list[float] | None = None  # r0
        self._from, self._last, self._rested = [0.0] * n, [0.0] * n, [0] * n
        self._came = [False] * n  # whether it has moved
        self.away, self.pushed, self._side = [0] * n, [0] * n, [0.0] * n  # scans, scans, sign

    def add(
        self, applied: Array, command: Array, error: float | None, time_s: float, moved: Sequence[bool] | None = None
    ) -> None:
        """A scan: read-backs (n_mv,), the commands before it (n_mv,), the largest error as a share of its range.

        ``error`` is None where no law is to remove it. ``time_s`` is when that was [s since 1970]. ``moved`` (n_mv,)
        are the MVs that somebody commands; None: all. An actuator that is left to others follows no command.
        """
        read = ((applied - self._low) / self._span).tolist()
        asked = ((command - self._low) / self._span).tolist()
        if self._stood is None:
            self._stood, self._from, self._last = list(read), list(asked), list(asked)
            self.since_s = [time_s] * self._n
            return
        for i, (r, c) in enumerate(zip(read, asked, strict=True)):
            self._rested[i] = self._rested[i] + 1 if c == self._last[i] else 0
            self._last[i] = c
            if moved is not None and not moved[i]:
                self._stood[i], self._from[i], self.since_s[i] = r, c, time_s
                self._came[i], self.away[i], self.pushed[i], self._side[i] = False, 0, 0, 0.0
                continue
            if abs(r - self._stood[i]) > STILL_READ_BACK:
                self._stood[i], self._from[i], self.since_s[i] = r, c, time_s
                self._came[i], self.away[i], self.pushed[i] = True, 0, 0
                continue
            self.away[i] = self.away[i] + 1 if abs(c - self._from[i]) > BEYOND_DEADBAND else 0
            self._push(i, r, c, error)

    def _push(self, i: int, r: float, c: float, error: float | None) -> None:
        """Count the scans at which a law asks for more in one direction and gets nothing."""
        far = error is not None and error > FAR_ERROR
        # the read-back has moved since the command did
        came = self._came[i] and abs(c - self._from[i]) <= SAME_READ_BACK
        rests = self._rested[i] >= EQUAL_COMMANDS and abs(c - r) <= READ_BACK_MARGIN
        if rests and (came or not (far or self.away[i])):
            self._offset[i] = c - r
        wanted = c - r - self._offset[i]
        side = (
            float(np.sign(wanted))
            if far and abs(wanted) > SAME_READ_BACK and ACTUATOR_AT_END < c < 1 - ACTUATOR_AT_END
            else 0.0
        )
        self.pushed[i] = self.pushed[i] + 1 if side and side == self._side[i] else 0
        self._side[i] = side

    def stuck(self, i: int) -> bool:
        """Whether an MV's read-back does not follow its command."""
        return self.away[i] > self.patience or self.pushed[i] > 2 * self.patience

    def at(self, i: int) -> tuple[float, float]:
        """(where the read-back of an MV stands, what was commanded last), in its unit."""
        stood = 0.0 if self._stood is None else self._stood[i]
        low, span = float(self._low[i]), float(self._span[i])
        return low + span * stood, low + span * self._last[i]
