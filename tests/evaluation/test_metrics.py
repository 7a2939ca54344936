"""Figures of closed loops and models: their definitions, and what must hold for any data."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from loopwright.pipeline import metrics
from loopwright.pipeline.evaluation import closed_loop
from loopwright.pipeline.evaluation.closed_loop import closed_loop_metrics, lock_ups
from loopwright.pipeline.evaluation.metric import METRICS

KEYS = {m.name for m in METRICS.values() if m.of} | {"ise", "masse", "max_asse", "overshoot", "settling", "mv_travel"}
SIGNAL = npst.arrays(np.float64, 40, elements=st.floats(-1e3, 1e3))


def second_order(zeta: float, n: int, h: float) -> np.ndarray:
    """Step response of 1/(s^2 + 2 zeta s + 1)."""
    t = h * np.arange(n)
    w = np.sqrt(1 - zeta**2)
    return 1 - np.exp(-zeta * t) * (np.cos(w * t) + zeta / w * np.sin(w * t))


@given(SIGNAL, SIGNAL)
def test_closed_loop_metrics_are_nonnegative_and_json_safe(sp: np.ndarray, pv: np.ndarray) -> None:
    found = closed_loop_metrics(sp, pv, pv, hold=10, period_s=0.5)
    assert set(found) == KEYS
    assert all(value >= 0 for value in found.values())
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["masse"] <= found["max_asse"] * (1 + 1e-12)
    assert found["settling"] <= 10 * 0.5


@given(SIGNAL, SIGNAL, st.floats(0.1, 10))
def test_scaling_the_signals_scales_the_figures(sp: np.ndarray, pv: np.ndarray, a: float) -> None:
    one, scaled = ((metrics.mae(s, p), metrics.sse(s, p)) for s, p in ((sp, pv), (a * sp, a * pv)))
    assert scaled == pytest.approx((a * one[0], a**2 * one[1]))


@given(SIGNAL, SIGNAL)
def test_rmse_lies_between_mae_and_the_largest_error(t: np.ndarray, p: np.ndarray) -> None:
    assert metrics.mae(t, p) <= metrics.rmse(t, p) + 1e-9
    assert metrics.rmse(t, p) <= np.max(np.abs(t - p)) + 1e-9


def test_a_perfect_loop_has_no_error() -> None:
    sp = np.repeat([0.1, 0.9], 20)
    found = closed_loop_metrics(sp, sp, np.zeros(40), hold=20, period_s=1.0)
    assert all(value == 0 for value in found.values())


def test_mae_pairs_set_point_and_output_of_the_same_sample() -> None:
    # A loop with one period of delay misses each change by the whole step, for one sample.
    sp = np.repeat([0.0, 1.0, 0.0], 10)
    pv = np.concatenate([[0.0], sp[:-1]])
    assert metrics.mae(sp, pv) == pytest.approx(2 / 30)


@pytest.mark.parametrize("zeta", [0.2, 0.5, 0.7])
def test_overshoot_of_a_second_order_response(zeta: float) -> None:
    y = second_order(zeta, 4000, 0.01)
    expected = np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2))
    assert closed_loop.overshoots(np.ones(4000), y, 0) == pytest.approx([expected], rel=1e-3)


def test_overshoot_does_not_depend_on_the_direction_or_size_of_the_step() -> None:
    y = second_order(0.3, 300, 0.1)
    sp = np.concatenate([np.full(300, 0.5), np.full(300, 0.2)])
    pv = np.concatenate([0.5 * y, 0.5 - 0.3 * y])
    first, second = closed_loop.overshoots(sp, pv, 300)
    assert first == pytest.approx(second)


def test_a_disturbance_is_no_step() -> None:
    assert closed_loop.overshoots(np.ones(50), 1 + 0.01 * np.sin(np.arange(50)), 0).size == 0


def test_settling_of_a_first_order_lag() -> None:
    tau, h = 2.0, 0.01
    y = 1 - np.exp(-h * np.arange(3000) / tau)
    assert h * closed_loop.settling_samples(np.ones(3000), y, 0)[0] == pytest.approx(-tau * np.log(0.02), abs=2 * h)


def test_a_hold_that_never_settles_counts_whole() -> None:
    sp = np.repeat([1.0, 2.0], 25)
    assert closed_loop.settling_samples(sp, np.zeros(50), 25).tolist() == [25.0, 25.0]


def test_steady_state_error_averages_noise_but_not_offset() -> None:
    noise = np.tile([0.01, -0.02, 0.03, -0.01, -0.01], 20)
    sp = np.repeat([0.2, 0.7], 50)
    assert closed_loop.max_asse(sp, sp + noise, 50) == pytest.approx(0.0, abs=1e-12)
    assert closed_loop.steady_errors(sp, sp + noise + np.repeat([0.0, 0.1], 50), 50) == pytest.approx(
        [0.0, 0.1], abs=1e-12
    )


def test_itae_starts_again_at_each_hold() -> None:
    sp, pv = np.ones(20), np.zeros(20)
    assert closed_loop.itae(sp, pv, 10, 0.5) == pytest.approx(2 * 0.25 * sum(range(10)))
    assert closed_loop.itae(sp, pv, 0, 0.5) == pytest.approx(0.25 * sum(range(20)))


def test_several_loops_average_but_keep_the_worst_steady_state_error() -> None:
    sp = np.ones((30, 2))
    pv = sp - [0.1, 0.3]
    found = closed_loop_metrics(sp, np.hstack([pv, pv]), np.zeros((30, 3)), hold=0, period_s=1.0)
    assert found["mae"] == pytest.approx(0.2)
    assert found["max_asse"] == pytest.approx(0.3)


def test_late_squared_errors_leave_the_start_out() -> None:
    sp = 10.0 * np.exp(-0.1 * np.arange(30))
    pv = sp - np.where(np.arange(30) < 8, 5.0, 0.5)
    found = closed_loop_metrics(sp, pv, np.zeros(30), hold=0, period_s=20.0, late_from=8)
    assert set(found) == KEYS | {"sse_late"}
    assert found["sse"] == pytest.approx(8 * 25 + 22 * 0.25)
    assert found["sse_late"] == pytest.approx(22 * 0.25)
    assert found["ise"] == pytest.approx(20 * found["sse"])


@pytest.mark.parametrize("late_from", [30, -1])
def test_a_late_part_without_samples_is_refused(late_from: int) -> None:
    with pytest.raises(ValueError, match=rf"late_from is sample {late_from} of a test of 30; give one of 0..29"):
        closed_loop_metrics(np.zeros(30), np.zeros(30), np.zeros(30), hold=0, period_s=1.0, late_from=late_from)


def test_a_moving_set_point_is_overshot_and_settled_on_as_the_error_says() -> None:
    # From 4 below a falling recipe: 1 past it at sample 5, then on it.
    sp = np.linspace(20.0, 5.0, 40)
    error = np.where(np.arange(40) < 5, 4.0, np.where(np.arange(40) == 5, -1.0, 0.0))
    found = closed_loop_metrics(sp, sp - error, np.zeros(40), hold=0, period_s=20.0, span=100.0)
    assert found["overshoot"] == pytest.approx(0.25)
    assert found["settling"] == pytest.approx(6 * 20.0)
    assert found["masse"] == pytest.approx(0.0, abs=1e-12)


def test_travel_adds_the_ways_of_all_actuators() -> None:
    assert metrics.mv_travel([[0, 0], [1, -2], [0, 0]]) == pytest.approx(6.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_refused(bad: float) -> None:
    pv = np.zeros(10)
    pv[3] = bad
    with pytest.raises(ValueError, match="pv has 10 samples, or some not finite"):
        closed_loop_metrics(np.zeros(10), pv, np.zeros(10), hold=0, period_s=1.0)


def test_locked_up_needs_saturation_and_error_through_half_a_hold() -> None:
    sp = np.repeat([0.5, 0.9], 40)
    off, full = np.full(80, 0.1), np.full(80, 500.0)
    limits = {"low": 0.0, "high": 500.0, "span": 1.0}
    assert lock_ups(sp, off, full, 40, **limits)
    assert lock_ups(sp, off, 0 * full, 40, **limits)
    assert not lock_ups(sp, sp - 0.01, full, 40, **limits)  # near: an extreme set point may need the limit
    assert not lock_ups(sp, off, 0.9 * full, 40, **limits)
    late = full.copy()
    late[[35, 75]] = 250.0
    assert not lock_ups(sp, off, late, 40, **limits)


def test_locked_up_is_far_in_terms_of_the_range() -> None:
    sp, full = np.full(40, 8.0), np.full(40, 1050.0)
    limits = {"low": 850.0, "high": 1050.0, "hold": 0}
    assert lock_ups(sp, sp - 0.06, full, span=2.0, **limits)
    assert not lock_ups(sp, sp - 0.06, full, span=3.5, **limits)


def test_a_batch_that_heats_up_is_not_locked_up_and_one_that_never_follows_is() -> None:
    # Full heating until the falling profile is met at 180 s of 1000, then near it; or full heating to the end.
    t = np.arange(0.0, 1000.0, 20.0)
    sp = 54 + 71 * np.exp(-2.5e-3 * t)
    heating = np.minimum(25 + 0.5 * t, 99.5)
    followed, mv = np.where(t < 180, heating, sp), np.where(t < 180, 1.0, 0.4)
    limits = {"hold": 0, "low": 0.0, "high": 1.0, "span": 110.0}
    assert not lock_ups(sp, followed, mv, **limits)
    assert lock_ups(sp, heating, np.ones(len(t)), **limits)


def test_fit_and_r2_are_zero_for_the_mean_and_full_for_the_truth() -> None:
    t = np.random.default_rng(0).normal(size=50)
    assert metrics.r2(t, t) == 1.0
    assert metrics.fit_percent(t, t) == 100.0
    mean = np.full(50, t.mean())
    assert metrics.r2(t, mean) == pytest.approx(0.0)
    assert metrics.fit_percent(t, mean) == pytest.approx(0.0)


def test_regions_share_the_rows_out() -> None:
    rng = np.random.default_rng(1)
    t, p, at = rng.normal(size=(3, 200))
    regions = {"low": (-np.inf, 0.0), "high": (0.0, np.inf), "none": (50.0, 60.0)}
    found = metrics.per_region(metrics.rmse, t, p, at, regions)
    assert set(found) == {"low", "high"}
    low = at < 0
    whole = np.sqrt((found["low"] ** 2 * low.sum() + found["high"] ** 2 * (~low).sum()) / 200)
    assert whole == pytest.approx(metrics.rmse(t, p))
