"""Where the MVs stand after commands that did not reach the plant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.guard import READ_BACK_MARGIN
from loopwright.serving.manifest import Signal

Array: TypeAlias = NDArray[np.float64]

SAME = 1e-3  # of an MV's range: a read-back no farther than that from where it was expected has not moved
ROUNDING = 1e-9  # of an MV's range: less is no offset, and the read-back itself is where the MV stands
SETTLED = 5  # equal commands in a row: a read-back that lags has followed


class Standing:
    """The MVs that the plant has, as far as the loop knows.

    While commands arrive, they are the last command. Once one did not arrive, others may have moved an MV, and the next
    read-back decides. A sound read-back may differ from its command all the time, by an actuator's offset: without it,
    each outage would carry the MV away by that much. The offset is learnt while the command rests.
    """

    def __init__(self, signals: Sequence[Signal], mv: Array) -> None:
        span = np.array([s.high - s.low for s in signals])
        self._low, self._high = np.array([s.low for s in signals]), np.array([s.high for s in signals])
        self._same = SAME * span
        self._least = ROUNDING * span
        self._most = np.array([0.0 if s.values is not None else READ_BACK_MARGIN for s in signals]) * span
        self.mv = mv.copy()  # shape: (n_mv,)
        self._rested = 0
        # What is seen just before a loss may be somebody's move already: an offset counts once a command has followed.
        self._offset = self._seen = np.zeros(len(signals))
        self.lost = False  # whether the last command did not arrive, and no read-back has come since

    def commanded(self, mv: Array, *, written: bool) -> None:
        """A command (n_mv,) went out, and nothing was heard of its loss. ``written`` by this loop, that is.

        In a shadow the MV is what others make of it: what moves then is no offset from a command.
        """
        if self.lost:
            return
        if written:
            self._rested = self._rested + 1 if mv.tolist() == self.mv.tolist() else 0
            self._offset = self._seen
        else:
            self._rested, self._seen = 0, self._offset
        self.mv = mv.copy()

    def seen(self, applied: Array) -> Array | None:
        """A read-back (n_mv,). Where the MVs stand after a loss, else None: HOLD then keeps what it has."""
        if not self.lost:
            if self._rested >= SETTLED:
                off = applied - self.mv
                self._seen = np.where((self._least < np.abs(off)) & (np.abs(off) <= self._most), off, 0.0)
            return None
        found = np.clip(applied - self._offset, self._low, self._high)
        self.mv, self.lost = np.where(np.abs(found - self.mv) <= self._same, self.mv, found), False
        self._rested, self._seen = 0, self._offset
        return self.mv
