"""Faults of the actuators of many loops side by side.

The kinds are the ones that a control valve shows in the field: it sticks for a while, its zero or its span is out of
adjustment, or its drive is slow. A fault is one of one MV.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

STUCK, ZERO, SPAN, SLOW = "stuck", "zero error", "span error", "slow"
KINDS = (STUCK, ZERO, SPAN, SLOW)
STUCK_FROM, STUCK_FOR = (0.1, 0.6), (0.05, 0.3)  # of the test: when it begins to stick, and for how long
MOST_ZERO, MOST_SPAN = 0.02, 0.05  # of the MV's range, and of the travel from its low end
STROKE = (5.0, 30.0)  # periods that a slow actuator takes over the MV's range


@dataclass(frozen=True)
class Fault:
    """One fault of one actuator.

    ``size`` is the zero error as a share of the MV's range, the span error as a share of the travel, or the periods
    of a full stroke. A stuck one holds its position from sample ``start`` up to, and without, sample ``end``.
    """

    kind: str
    mv: int
    size: float = 0.0
    start: int = 0
    end: int = 0

    def words(self, signals: Sequence[Signal]) -> str:
        """The fault for a person."""
        name = signals[self.mv].name
        if self.kind == STUCK:
            return f"{name} stuck from sample {self.start} to {self.end}"
        if self.kind == SLOW:
            return f"{name} slow: {self.size:.3g} periods for its range"
        return f"{name} {self.kind} of {100 * self.size:+.2g} %"


def draw_fault(rng: np.random.Generator, signals: Sequence[Signal], samples: int) -> Fault:
    """A fault drawn at random over a test of ``samples``; a discrete MV can only stick."""
    mv, share = int(rng.integers(len(signals))), rng.uniform(size=3)
    kind = KINDS[min(int(share[0] * len(KINDS)), len(KINDS) - 1)] if signals[mv].values is None else STUCK
    if kind == STUCK:
        start = int(samples * (STUCK_FROM[0] + share[1] * (STUCK_FROM[1] - STUCK_FROM[0])))
        length = int(samples * (STUCK_FOR[0] + share[2] * (STUCK_FOR[1] - STUCK_FOR[0])))
        return Fault(kind, mv, start=start, end=start + max(length, 1))
    if kind == SLOW:
        return Fault(kind, mv, size=float(STROKE[0] + share[1] * (STROKE[1] - STROKE[0])))
    most = MOST_ZERO if kind == ZERO else MOST_SPAN
    return Fault(kind, mv, size=float(most * (2 * share[1] - 1)))


class Actuators:
    """The actuators of ``n`` loops: from commands to positions that are read back, and to what the plants receive.

        position(k) = position(k-1) + clip(command - position(k-1), -rate, rate),   held while it is stuck
        acting(k)   = clip(low + (1 + span) (position - low) + zero (high - low), low, high)

    The read-back knows nothing of an error of zero or span. With ``late`` the plant receives acting(k-1).
    """

    def __init__(
        self, signals: Sequence[Signal], faults: Sequence[Fault | None], mv0: Array, late: Sequence[bool]
    ) -> None:
        n, m = mv0.shape
        self.low, self.high = (np.array([getattr(s, end) for s in signals]) for end in ("low", "high"))
        self.rate, self.zero, self.span = np.full((n, m), np.inf), np.zeros((n, m)), np.zeros((n, m))
        self.start, self.end = np.zeros((n, m), dtype=np.int64), np.zeros((n, m), dtype=np.int64)
        for i, fault in enumerate(faults):
            if fault is None:
                continue
            at = (i, fault.mv)
            wide = self.high[fault.mv] - self.low[fault.mv]
            if fault.kind == STUCK:
                self.start[at], self.end[at] = fault.start, fault.end
            elif fault.kind == SLOW:
                self.rate[at] = wide / fault.size
            elif fault.kind == ZERO:
                self.zero[at] = fault.size * wide
            else:
                self.span[at] = fault.size
        self.wrong = (self.zero != 0) | (self.span != 0)
        self.late = np.array(late, dtype=bool)[:, None]
        self.position, self.before = mv0.copy(), mv0.copy()

    def move(self, k: int, command: Array) -> tuple[Array, Array]:
        """(position, acting), both (n, n_mv), over sample ``k`` under commands (n, n_mv)."""
        way = command - self.position
        slow = np.abs(way) > self.rate
        moved = np.where(slow, self.position + np.sign(way) * np.where(slow, self.rate, 0.0), command)
        self.position = np.where((k >= self.start) & (k < self.end), self.position, moved)
        bent = self.low + (1 + self.span) * (self.position - self.low) + self.zero
        acting = np.where(self.wrong, np.clip(bent, self.low, self.high), self.position)
        given = np.where(self.late, self.before, acting)
        self.before = acting
        return self.position, given
