"""The calmest choice among numbers that a search tried, for all laws that are searched in closed loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

CALM_COST = 0.05  # of the least error, that less travel may cost: a valve wears, and the model is not the plant


class LoopOutcome(Protocol):
    """The outcome of closed loops with numbers that were tried."""

    @property
    def error(self) -> float:
        """The loops' error, in any unit, without a price of travel."""

    @property
    def travel(self) -> float:
        """The MVs' travel [% of their range a sample]."""


T = TypeVar("T", bound=LoopOutcome)


def calmest(tried: Sequence[T]) -> T:
    """The one of the least travel among those whose error is at most ``CALM_COST`` more than the least.

        min T   subject to   E <= 1.05 min E

    The travel is not in the limit: counted there too, it cost several times these 5 % on plants whose loads wander.
    """
    limit = (1 + CALM_COST) * min(c.error for c in tried)
    return min((c for c in tried if c.error <= limit), key=lambda c: (c.travel, c.error))
