"""Shares of time: saturated, in HOLD, at a rate limit, outside the applicability domain."""

from __future__ import annotations

from typing import ClassVar

from loopwright.serving.monitor.memory import ANY, COUNT, SIZE, Kept, Remembers


class Share(Remembers):
    """A share of the last ``memory`` scans, and what it was when ``learn`` scans had been seen.

    share(k) = share(k-1) + (x(k) - share(k-1)) / min(k, memory)
    """

    KEPT: ClassVar[Kept] = {"value": SIZE, "first": ANY, "count": COUNT}

    def __init__(self, learn: int, memory: int) -> None:
        self.learn, self.memory_scans = learn, memory
        self.value = 0.0
        self.first = -1.0  # not known yet
        self.count = 0

    def add(self, x: float) -> None:
        """One scan: whether, as 0 or 1; or any figure that is to be averaged."""
        self.count += 1
        self.value += (x - self.value) / min(self.count, self.memory_scans)
        if self.count == self.learn:
            self.first = self.value

    @property
    def learnt(self) -> bool:
        """Whether it has seen enough."""
        return self.count >= self.learn

    @property
    def done(self) -> float:
        """How much of that it has seen, from 0 to 1."""
        return min(self.count / self.learn, 1.0)
