"""Blocks of which engineers build control schemes: PI with tracking, selectors, feedforward, and their tuning.

The rule of tuning: gains and reset times start where the plant's file has them, from its lags; then each number in
turn is multiplied and divided by a factor that shrinks (1.6, 1.25, 1.1) as long as the cost of two days falls, whose
seeds are not scored. The cost is what is scored: the error on set points, ten times what lies beyond a range, half of
the MVs' travel, all in %, and what the costs of ``operate`` make of the day.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from loopwright.pipeline.plants.simulator import Array

FACTORS = (1.6, 1.25, 1.1)


@dataclass
class Pi:
    """A PI in velocity form: out += Kc (e(k) - e(k-1) + e(k)/Ti) from the output that really acts, within its ends.

    ``kc`` [output a PV unit] carries the sign: e = sp - pv. A first-order filter of ``filtered`` samples on the PV.
    """

    kc: float
    ti: float
    low: float
    high: float
    filtered: float = 0.0
    before: float | None = field(default=None, init=False)
    pv: float | None = field(default=None, init=False)

    def __call__(self, sp: float, pv: float, out: float, *, dt: float = 1.0) -> float:
        """The next output from the present one; ``dt`` samples have passed since the last call."""
        share = 1.0 if not self.filtered else 1 - np.exp(-dt / self.filtered)
        self.pv = pv if self.pv is None else self.pv + share * (pv - self.pv)
        error = sp - self.pv
        before = error if self.before is None else self.before
        self.before = error
        return float(np.clip(out + self.kc * (error - before + dt * error / self.ti), self.low, self.high))


def limited(mv: Array, wanted: Array, low: Array, high: Array, rates: Sequence[float | None]) -> Array:
    """MVs within operators' limits and no faster than their rates."""
    most = np.array([np.inf if r is None else r for r in rates])
    return np.asarray(np.clip(np.clip(wanted, low, high), mv - most, mv + most))


def searched(start: Array, cost: Callable[[Array], float]) -> Array:
    """The numbers with the least cost, one after another moved by factors; see the module."""
    best, least = start.copy(), cost(start)
    for factor in FACTORS:
        for _ in range(2):
            moved = False
            for i in range(len(best)):
                for by in (factor, 1 / factor):
                    while True:
                        tried = best.copy()
                        tried[i] *= by
                        found = cost(tried)
                        if not found < least - 1e-3 * abs(least):
                            break
                        best, least, moved = tried, found, True
            if not moved:
                break
    return best
