"""Rests by running long, of maps whose course is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.pipeline.dynamics.steady_state import run_to_rest

Array = np.ndarray


def holds(advance: Callable[[Array], Array], calls: list[int]) -> Callable[[Array], tuple[Array, Array]]:
    """A period a call, which is counted."""

    def hold(x: Array) -> tuple[Array, Array]:
        calls.append(1)
        ahead = advance(x)
        return ahead, np.abs(ahead - x)

    return hold


@given(st.floats(0.1, 0.98), st.floats(1e-9, 1e-3))
def test_a_lag_comes_to_rest_where_theory_says(pole: float, still: float):
    calls: list[int] = []
    x, moved = run_to_rest(holds(lambda x: pole * x + (1 - pole) * 3.0, calls), np.zeros(1), 5_000, still)
    assert moved.max() <= still
    assert abs(x[0] - 3.0) <= still * pole / (1 - pole) + 1e-12
    # The change in period k is 3 (1 - a) a^(k-1).
    assert len(calls) == pytest.approx(1 + max(0.0, np.log(still / (3 * (1 - pole))) / np.log(pole)), abs=1.01)


@given(st.floats(0.1, 0.98))
def test_a_band_may_be_a_share_of_the_state(pole: float):
    ends = []
    for size in (1e3, 1e6):
        calls: list[int] = []
        run_to_rest(holds(lambda x, s=size: pole * x + (1 - pole) * s, calls), np.zeros(1), 5_000, 1e-6, relative=True)
        ends.append(len(calls))
    assert abs(ends[0] - ends[1]) <= 1


def test_one_that_integrates_goes_on_to_the_end():
    calls: list[int] = []
    x, moved = run_to_rest(holds(lambda x: x + 0.25, calls), np.zeros(1), 40, 1e-6)
    assert (len(calls), x[0], moved[0]) == (40, 10.0, 0.25)


def test_all_must_stand_still():
    calls: list[int] = []
    poles = np.array([0.1, 0.9])
    x, _ = run_to_rest(holds(lambda x: poles * x, calls), np.ones(2), 5_000, 1e-6)
    assert x[1] < 1e-4
    assert len(calls) > 100


def test_a_run_that_goes_away_ends():
    calls: list[int] = []
    x, _ = run_to_rest(holds(lambda x: 2 * x, calls), np.ones(1), 5_000, 1e-6, within=1e3)
    assert x[0] == 1024.0
    calls.clear()
    run_to_rest(holds(lambda x: x * np.nan, calls), np.ones(1), 5_000, 1e-6, within=1e3)
    assert len(calls) == 1
