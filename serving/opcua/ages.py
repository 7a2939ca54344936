"""How old values are, by clocks that need not agree."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf

DRIFT = 2e-4  # seconds a second by which two clocks may part
JUMP_S = 600.0  # by more than that no value is late: a clock was set
CONFIRMED = 3  # values of another clock's time before it is believed


@dataclass(slots=True)
class _Course:
    source: float = -inf  # the last source time [s]
    arrived: float = 0.0  # when it was first seen [s]
    age: float = 0.0  # as it was then [s]
    offset: float = inf  # least arrival minus source: the clocks' difference and the shortest way [s]
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=CONFIRMED))  # arrival minus source
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=CONFIRMED - 1))  # from arrival to arrival [s]
    before: float | None = None  # least arrival minus source before a clock was set that is not yet confirmed


class Ages:
    """Ages of values from the source times that come with them, and from when they arrive here.

    The source's clock and ours differ by an unknown offset. The least difference ever seen is that offset and the
    shortest way; what a value takes longer than that is its age. While the same source time comes again, the value
    grows older.

    A value that is late still comes after the one before it, so a source time that goes back tells that a clock was
    set, or that the stamp before it was wrong. The new offset is believed once ``CONFIRMED`` values agree on it that
    came in a steady rhythm; how old the values were before the jump is kept. A clock that is set back by less than the
    time between two values looks like values that take so much longer, and counts as that.
    """

    def __init__(self, n: int) -> None:
        self._courses = [_Course() for _ in range(n)]

    def update(self, arrived: float, sources: Sequence[float | None]) -> list[float]:
        """Age [s] of each value; of one without a source time 0, since only its arrival is known."""
        return [_aged(c, arrived, s) for c, s in zip(self._courses, sources, strict=True)]


def _aged(c: _Course, arrived: float, source: float | None) -> float:
    if source is None:
        return 0.0
    if source == c.source:
        return c.age + arrived - c.arrived
    lag = arrived - source
    relaxed = c.offset + DRIFT * (arrived - c.arrived)
    if source < c.source:
        c.before = min(c.recent) if c.before is None else c.before
        c.recent.clear()
        c.steps.clear()
    elif c.recent:
        c.steps.append(arrived - c.arrived)
    c.recent.append(lag)
    spread = max(c.recent) - min(c.recent) if len(c.recent) == CONFIRMED else inf
    if lag < relaxed:
        c.offset, c.before = lag, None
    elif lag - relaxed > JUMP_S and spread < JUMP_S / 10:
        c.offset, c.before = min(c.recent), None
    elif c.before is not None and spread < min(c.steps, default=0.0):
        c.offset, c.before = relaxed + min(c.recent) - c.before, None
    else:
        c.offset = relaxed
    c.source, c.arrived, c.age = source, arrived, lag - c.offset
    return c.age
