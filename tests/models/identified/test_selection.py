"""When a network stands in for the linear model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import pytest

from loopwright.pipeline.models.identified.structure_search import Selection


@dataclass(frozen=True)
class Judged:
    """What a selection reads of a trial."""

    error: float
    spread: float = 0.0
    seeds: int = 3
    against: int = 0


def selection(linear: float, network: Judged | None, *, drifts: bool = False) -> Selection:
    return Selection(cast(Any, Judged(linear)), cast(Any, network), [], 0.0, settles=True, drifts=drifts)


@pytest.mark.parametrize(
    ("network", "drifts", "wins"),
    [
        (None, False, False),
        (Judged(0.90), False, True),
        (Judged(0.995), False, False),  # by less than 1 %
        (Judged(0.95, spread=0.2), False, False),  # by less than the seeds' own uncertainty
        (Judged(0.95, spread=0.2), True, True),  # they differ by what each took for drift
        (Judged(0.995), True, False),
    ],
)
def test_a_network_wins_by_more_than_chance(network: Judged | None, drifts: bool, wins: bool) -> None:
    found = selection(1.0, network, drifts=drifts)
    assert found.nonlinear is wins
    assert found.chosen is (found.network if wins else found.linear)
