"""The way of an MV from where it is to where somebody wants it: a law that takes over, or an operator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Signal

Array: TypeAlias = NDArray[np.float64]


class Transfer:
    """Limits the first moves of a law that takes over: over ``transfer_s`` [s] an MV crosses its range at most once.

        mv(k) = mv_applied(k) + clip(law(k) - mv_applied(k), -d, d),    d = (high - low) period_s / transfer_s

    It ends once each MV is where the law wants it, at the latest after ``transfer_s``. A discrete MV has no way
    between its values and is not limited. A law that adds to the applied MV needs none of this; one that computes its
    MV afresh would bump the plant by whatever its model is wrong.
    """

    def __init__(self, mv: Sequence[Signal], period_s: float, transfer_s: float) -> None:
        self._scans = int(np.ceil(transfer_s / period_s))
        share = 1.0 if self._scans == 0 else period_s / transfer_s
        self._most = np.array([np.inf if s.values is not None else share * (s.high - s.low) for s in mv])
        self._left = 0

    def begin(self) -> None:
        """Limit from the next MV on."""
        self._left = self._scans

    def limited(self, law: Array, applied: Array) -> Array:
        """The MV to command, (n_mv,): between ``applied`` and ``law``, so it lies in the range as both do."""
        if not self._left:
            return law
        move = law - applied
        near = np.abs(move) <= self._most
        self._left = 0 if near.all() else self._left - 1
        ahead = applied + np.clip(move, -self._most, self._most)
        # A sum is rounded, and may leave the range by its last digit.
        return np.where(near, law, np.clip(ahead, np.minimum(law, applied), np.maximum(law, applied)))


class ByHand:
    """Where an operator sent the MV, and the way there: each by at most its ``max_move`` a period, as with any law.

    It counts from the last command, which also a plant without a read-back has. Where nobody knows where the MV
    stands, it is where the operator says.
    """

    def __init__(self) -> None:
        self.wanted: Array | None = None  # shape: (n_mv,); None: it is there, or nobody moves it by hand

    def sent(self, mv: Array, wanted: Array, signals: Sequence[Signal]) -> Array:
        """Begin the way to ``wanted`` (n_mv,); the MV from now on, which is there already where none is limited."""
        self.wanted = wanted if any(s.most < np.inf for s in signals) else None
        return wanted if self.wanted is None else mv

    def toward(self, mv: Array, signals: Sequence[Signal]) -> Array:
        """The MV (n_mv,) one period nearer."""
        if self.wanted is None:
            return mv
        ahead = np.array([s.toward(*ends) for s, *ends in zip(signals, mv.tolist(), self.wanted.tolist(), strict=True)])
        if np.array_equal(ahead, self.wanted):
            self.wanted = None
        return ahead
