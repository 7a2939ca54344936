"""Action of a loop when a fault lasts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.errors import LoopError
from loopwright.serving.manifest import Signal
from loopwright.serving.ranges import within

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Fallback:
    """HOLD keeps the last MV; after ``after_s`` [s] of a fault in a row the loop does more than that.

    With ``mv`` (n_mv,) each MV moves there, by at most ``rate`` (n_mv,) [mv units/s] and its ``max_move``. With
    ``hand_back`` the command asks to hand the plant to its own controller; once that is done the loop writes no more
    (SHADOW).

    Raises LoopError for times or rates that are not above zero, and where both ways or none is asked for.
    """

    after_s: float
    mv: tuple[float, ...] | None = None
    rate: tuple[float, ...] | None = None
    hand_back: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.after_s < inf:
            raise LoopError(f"after_s is {self.after_s}; it must be a finite number of seconds, 0 or more")
        if self.hand_back == (self.mv is not None):
            raise LoopError("a fallback either goes to a safe MV or hands back")
        if (self.mv is None) != (self.rate is None):
            raise LoopError("a safe MV needs the rate at which the loop goes there, one a manipulated variable")
        for name, values in (("mv", self.mv), ("rate", self.rate)):
            if values is not None and not all(map(isfinite, values)):
                raise LoopError(f"{name} is {values}; it needs finite numbers")
        if self.rate is not None and not all(r > 0 for r in self.rate):
            raise LoopError(f"rate is {self.rate}; each must be above zero")

    def check(self, signals: Sequence[Signal]) -> None:
        """LoopError where the safe MV is none of these MVs, or the rates are not as many."""
        if self.mv is None or self.rate is None:
            return
        within(self.mv, signals, "safe MV")
        if len(self.rate) != len(signals):
            raise LoopError(f"the fallback has {len(self.rate)} rates; it needs {len(signals)}, one an MV")

    def toward(self, mv: Array, signals: Sequence[Signal], period_s: float) -> Array:
        """The MV (n_mv,) one period nearer to the safe one; a discrete MV goes there at once."""
        if self.mv is None or self.rate is None:
            return mv
        most = np.array(
            [
                inf if s.values is not None else min(r * period_s, s.max_move or inf)
                for s, r in zip(signals, self.rate, strict=True)
            ]
        )
        move = np.array(self.mv) - mv
        near = np.abs(move) <= most
        return np.where(near, self.mv, np.clip(mv + np.clip(move, -most, most), *_ends(signals)))


def _ends(signals: Sequence[Signal]) -> tuple[Array, Array]:
    return np.array([s.low for s in signals]), np.array([s.high for s in signals])
