"""Figures of responses against theory: lags, dead times, integrators, inverse responses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.pipeline.dynamics.step_response import (
    SLOPE_KEPT,
    answers_after,
    first_answer_within,
    first_beyond,
    first_change,
    late_change,
    late_distance,
    late_slope,
    ramp_delay,
    reached,
    settled_index,
    settling_index,
    slope_thirds,
    starts_inverse,
    two_point_lag,
)

taus = st.floats(0.3, 40.0)  # periods
dead_times = st.integers(0, 60)  # periods
gains = st.floats(0.01, 100.0).flatmap(lambda g: st.sampled_from([g, -g]))
arrays = st.lists(st.floats(-10, 10), min_size=1, max_size=30).map(np.array)


def times(n: int, dead: int = 0) -> np.ndarray:
    """Periods (n,) since an input that is late acts; the first value stands one period after the step."""
    return np.maximum(np.arange(1.0, n + 1) - dead, 0.0)


def lag(tau: float, n: int = 1500, dead: int = 0) -> np.ndarray:
    return 1 - np.exp(-times(n, dead) / tau)


# --------------------------------------------------------------------------------------------------- settling
@given(taus, st.floats(0.005, 0.5), dead_times, gains)
def test_a_lag_settles_after_its_time_constant_times_the_logarithm(tau: float, band: float, dead: int, gain: float):
    y = gain * lag(tau, dead=dead)
    periods = int(settling_index(y, band * abs(gain))) + 1
    wanted = dead - np.log(band) * tau
    assert wanted - 1e-6 <= periods < wanted + 1 + 1e-6


@given(arrays, st.floats(0, 5))
def test_settling_is_the_first_value_from_which_on_all_lie_within(y: np.ndarray, band: float):
    for found, distance in ((settling_index(y, band), np.abs(y - y[-1])), (settled_index(y, band), y)):
        within = [k for k in range(len(y) + 1) if (distance[k:] <= band).all()]
        assert found == within[0]


@given(arrays, st.floats(0, 5), st.floats(0, 5))
def test_a_wider_band_is_reached_no_later(y: np.ndarray, one: float, other: float):
    narrow, wide = sorted((one, other))
    assert settling_index(y, wide) <= settling_index(y, narrow)


def test_each_response_and_each_value_may_have_its_own_band():
    y = np.array([[4.0, 2.0, 1.0, 0.0], [4.0, 2.0, 1.0, 0.0]])
    assert settling_index(y, np.array([1.0, 2.0])).tolist() == [2, 1]
    assert settling_index(y[0], np.array([0.0, 3.0, 0.0, 0.0])) == 3
    assert settling_index(np.zeros(5), 0.0) == 0
    assert settled_index(np.ones(5), 0.5) == 5


# --------------------------------------------------------------------------------------------------- first answer
@given(taus, dead_times, gains)
def test_a_lag_answers_one_period_after_its_dead_time(tau: float, dead: int, gain: float):
    assert answers_after(gain * lag(tau, dead=dead)) == dead + 1
    assert first_change(np.diff(gain * lag(tau, dead=dead), prepend=0.0), 0.5) == dead


@given(dead_times, gains)
def test_two_lags_answer_once_they_are_fast_enough(dead: int, gain: float):
    """The slope t exp(-t / tau) / tau^2 is a tenth of its largest, at t = tau, where t = 0.038 tau."""
    t, tau = times(1500, dead), 100.0
    y = gain * (1 - (1 + t / tau) * np.exp(-t / tau))
    assert answers_after(y) == pytest.approx(dead + 0.038 * tau, abs=2)


def test_a_response_that_does_not_move_has_no_answer():
    assert answers_after(np.zeros((2, 7))).tolist() == [8, 8]
    assert first_beyond(np.array([[0.0, 1.0, 3.0], [0.0, 0.0, 0.0]]), np.array([1.0, 0.0])).tolist() == [2, 3]


@given(taus, dead_times, gains)
def test_some_periods_of_a_lag_show_its_first_answer(tau: float, dead: int, gain: float):
    y = gain * lag(tau, dead=dead)
    assert first_answer_within(y, 1e-9 * abs(gain)) == dead + 1
    assert first_answer_within(y[: dead + 1], 0.0) == dead + 1
    assert first_answer_within(y[:dead], 0.0) is None


@given(dead_times, st.integers(100, 1500))
def test_a_ramp_and_an_inverse_response_answer_at_once_however_long_they_are(dead: int, n: int):
    k = times(n, dead)
    assert first_answer_within(-0.02 * k, 0.0) == dead + 1
    inverse = 2 * (1 - 0.97**k) - 1.5 * (1 - 0.8**k)
    assert inverse.min() < -0.2
    assert first_answer_within(inverse, 0.0) == dead + 1


@given(dead_times)
def test_what_grows_for_ever_answers_as_in_its_first_periods(dead: int):
    """A pole beyond 1 makes the last change the fastest, which would put off the answer with each period."""
    y = 1.05 ** times(900, dead) - 1
    assert first_answer_within(y, 0.0) == dead + first_answer_within(y[dead : dead + 60], 0.0)
    assert answers_after(y) > dead + 700


# --------------------------------------------------------------------------------------------------- late motion
@given(st.floats(0.01, 10.0), taus, dead_times)
def test_an_integrator_ends_on_its_slope_late_by_dead_time_and_lag(rate: float, tau: float, dead: int):
    y = rate * (times(1500, dead) - tau * lag(tau, dead=dead))
    slope = float(late_slope(y, 300))
    assert slope == pytest.approx(rate, rel=1e-6)
    assert ramp_delay(len(y), float(y[-1]), slope) == pytest.approx(dead + tau, rel=1e-3, abs=1e-3)
    _, middle, end = slope_thirds(np.diff(y))
    assert end > SLOPE_KEPT * middle


@given(taus)
def test_a_lag_loses_its_slope(tau: float):
    y = lag(tau, n=400)
    _, middle, end = slope_thirds(np.diff(y))
    assert end <= SLOPE_KEPT * middle
    assert late_slope(y, 80) == pytest.approx(late_change(y, 80) / 80)
    assert late_distance(y, 80) == pytest.approx(abs(late_change(y, 80)))  # it rises to its end


def test_a_swing_is_far_from_its_end_though_it_comes_back():
    y = np.sin(np.arange(101) * np.pi / 10)
    assert abs(late_change(y, 20)) < 1e-9
    assert late_distance(y, 20) == pytest.approx(1.0)


# --------------------------------------------------------------------------------------------------- shape
@given(st.floats(3.0, 40.0), dead_times, st.sampled_from([0.5, 1.0, 30.0]))
def test_the_lag_through_two_points_of_a_lag_is_itself(tau: float, dead: int, period_s: float):
    found, theta = two_point_lag(lag(tau, dead=dead), period_s)
    assert found == pytest.approx(tau * period_s, rel=0.03, abs=0.05 * period_s)
    assert theta == pytest.approx(dead * period_s, abs=0.1 * period_s)


@given(dead_times)
def test_a_dead_time_alone_has_the_shortest_lag(dead: int):
    """Both points lie in one period: a straight line is all that is known of it."""
    tau, theta = two_point_lag((times(200, dead) > 0).astype(float), 2.0)
    assert tau == pytest.approx(2.0 * 1.5 * (0.632 - 0.283))
    assert theta == pytest.approx(2.0 * (dead + 0.632) - tau)


def test_no_lag_is_shorter_than_half_a_period():
    tau, theta = two_point_lag(np.array([0.0, 1.5, 1.0]), 2.0)
    assert (tau, theta) == (1.0, pytest.approx(2.0 * (1 + 0.632 / 1.5) - 1.0))


def test_a_share_is_reached_between_two_samples():
    rising = np.array([0.25, 0.75, 1.0])
    assert reached(rising, 0.125) == pytest.approx(0.5)
    assert reached(rising, 0.5) == pytest.approx(1.5)
    assert reached(rising, 1.1) == 3.0


@given(st.floats(0.1, 3.0), st.floats(4.0, 30.0))
def test_an_inverse_response_goes_below_its_start(zero: float, tau: float):
    """(1 - zero s) / (s + 1)(tau s + 1) begins with the slope -zero / tau."""
    t = 0.01 * times(4000)
    fast, slow = np.exp(-t), np.exp(-t / tau)
    y = 1 - (tau + zero) / (tau - 1) * slow + (1 + zero) / (tau - 1) * fast
    assert starts_inverse(y) == (-y.min() > 0.1 * y[-1])
    assert starts_inverse(y, 1e-9)
    assert not starts_inverse(lag(tau), 1e-9)
