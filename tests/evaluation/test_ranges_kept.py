"""Figures of ranges, profit, travel and rests over arrays, against sums by hand and properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.pipeline.evaluation.ranges_kept import (
    beyond,
    borne_by_last,
    gain_share,
    mean_beyond,
    most_beyond,
    mv_travel_from,
    profit,
    rest_miss,
    share_clamped,
    share_outside,
    stretches_outside,
)

LEVEL = [1.0, 2.0, 5.5, 7.0, 4.0]


def test_a_range_is_left_by_what_lies_beyond_the_nearer_end():
    assert beyond(LEVEL, 2.0, 5.0).tolist() == [1.0, 0.0, 0.5, 2.0, 0.0]
    assert share_outside(LEVEL, 2.0, 5.0) == pytest.approx(3 / 5)
    assert share_outside(LEVEL, 2.0, 5.0, by=0.5) == pytest.approx(2 / 5)  # .5 beyond is no more than noise hides
    assert mean_beyond(LEVEL, 2.0, 5.0) == pytest.approx(3.5 / 5)
    assert most_beyond(LEVEL, 2.0, 5.0) == 2.0
    assert [(s.start, s.stop) for s in stretches_outside(LEVEL, 2.0, 5.0)] == [(0, 1), (2, 4)]


def test_the_ends_may_move_over_the_samples():
    assert beyond([3.0, 3.0], [2.0, 4.0], [5.0, 5.0]).tolist() == [0.0, 1.0]


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30), st.floats(-500, 500), st.floats(0, 500))
def test_only_what_is_beyond_counts(course: list[float], low: float, width: float):
    out = beyond(course, low, low + width)
    assert np.all(out >= 0)
    assert np.array_equal(out == 0, (np.asarray(course) >= low) & (np.asarray(course) <= low + width))
    assert share_outside(course, low, low + width) == pytest.approx(float(np.mean(out > 0)))
    assert sum(s.stop - s.start for s in stretches_outside(course, low, low + width)) == np.count_nonzero(out)


def test_a_range_upside_down_an_open_one_and_an_empty_series_are_refused():
    for low, high in ((2.0, 1.0), (0.0, np.inf), (np.nan, 1.0)):
        with pytest.raises(ValueError, match="low <= high"):
            beyond(LEVEL, low, high)
    with pytest.raises(ValueError, match="no sample"):
        share_outside([], 0.0, 1.0)
    with pytest.raises(ValueError, match="period"):
        profit([[1.0]], [[1.0]], [1.0], [1.0], 0.0)


def test_profit_is_what_the_costs_of_an_hours_periods_sum_to():
    y, u = np.array([[2.0], [4.0]]), np.array([[1.0, 10.0], [3.0, 10.0]])
    # A period: -(-5 y + 2 u_1 + .1 u_2); 360 periods of 10 s an hour.
    by_hand = 360 * np.mean([5 * 2 - 2 * 1 - 1, 5 * 4 - 2 * 3 - 1])
    assert profit(y, u, [-5.0], [2.0, 0.1], 10.0) == pytest.approx(by_hand)
    changed = np.array([[0.0, 0.0], [1.0, 0.0]])  # a cost that an operator put in later
    assert profit(y, u, [0.0], changed, 10.0) == pytest.approx(-360 * np.mean([0.0, 3.0]))


def test_the_share_of_a_gain_does_not_depend_on_where_zero_lies():
    assert gain_share(9.0, 1.0, 11.0) == pytest.approx(0.8)
    assert gain_share(-991.0, -999.0, -989.0) == pytest.approx(0.8)
    assert gain_share(0.0, 5.0, 10.0) == pytest.approx(-1.0)  # worse than where it stood
    assert gain_share(5.0, 5.0, 5.0) is None


def test_travel_counts_the_first_move_too():
    assert mv_travel_from([[3.0, 1.0], [2.0, 1.0]], [1.0, 1.0]).tolist() == [3.0, 0.0]


def test_an_mv_at_an_operators_limit_is_clamped_there():
    assert share_clamped([20.0, 30.0, 60.0, 60.0], 20.0, 60.0) == pytest.approx(3 / 4)
    assert share_clamped([40.0, 40.0], 40.0, 40.0) == 1.0
    assert share_clamped([20.0, 30.0, 60.0, 60.0], 20.0, 60.0, engineered=(0.0, 60.0)) == pytest.approx(1 / 4)


def test_the_resting_value_counts_at_the_end():
    assert rest_miss([0.0, 0.0, 4.0, 6.0], 5.0, last=2) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="last"):
        rest_miss([0.0], 5.0, last=2)


def test_the_last_rank_bears_what_the_ones_before_it_do_not():
    ranks = {"a": 1.0, "b": 3.0, "c": 3.0}
    assert borne_by_last({"a": 0.01, "b": 0.59, "c": 0.4}, ranks) == pytest.approx(0.99)
    assert borne_by_last({"a": 0.0, "b": 0.0, "c": 0.0}, ranks) is None
    assert borne_by_last({"b": 0.3, "c": 0.4}, ranks) is None
