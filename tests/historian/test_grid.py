"""Resampling: exact where it can be, means against aliasing, moves where they happened."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning import row_grid as grid_module
from loopwright.pipeline.historian.cleaning.row_grid import resampled
from loopwright.pipeline.historian.cleaning.sampling import proposed_period, sampling
from loopwright.pipeline.historian.files.export import Series
from loopwright.pipeline.historian.files.quality import Reason


def series(tag: str, t: np.ndarray, v: np.ndarray) -> Series:
    return Series(tag, np.asarray(t, dtype=np.float64), np.asarray(v, dtype=np.float64), np.zeros(len(t), np.uint8))


@settings(max_examples=40, deadline=None)
@given(st.integers(20, 300), st.floats(0.05, 900), st.floats(0, 0.22), st.integers(0, 1000))
def test_jitter_moves_no_row_and_no_move(n: int, h: float, share: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    t = 1.7e9 + h * np.arange(n) + share * h * random.uniform(-1, 1, n)
    u = random.integers(0, 5, n).astype(float)
    grid, _ = resampled([series("y", t, t - t[0])], [series("u", t, u)], h)
    assert abs(len(grid) - n) <= 1
    m = min(len(grid), n)
    assert np.mean(grid.value["u"][:m] == u[:m]) > 0.97
    inside = np.isfinite(grid.value["y"])
    np.testing.assert_allclose(grid.value["y"][inside], (grid.time_s - t[0])[inside], atol=0.8 * h)


def test_thinned_pvs_are_means_against_aliasing_and_mvs_means_over_their_period() -> None:
    t = np.arange(6000.0)
    ripple = np.sin(2 * np.pi * t / 10.0 + 0.3)  # period of the grid: plain picking would give a constant offset
    u = np.where(t < 3005, 0.0, 1.0)
    grid, _ = resampled([series("y", t, 5 + ripple)], [series("u", t, u)], 10.0)
    inner = slice(2, -2)
    np.testing.assert_allclose(grid.value["y"][inner], 5.0, atol=1e-9)
    k = int(np.searchsorted(grid.time_s, 3000.0))
    assert grid.value["u"][k] == pytest.approx(0.5)
    assert set(np.round(np.delete(grid.value["u"], k), 12)) == {0.0, 1.0}


def test_exception_reports_are_held_and_not_for_ever() -> None:
    t = np.arange(0, 4000.0, 5.0)
    at = np.array([0.0, 300.0, 310.0, 900.0, 930.0, 1500.0, 1510.0, 2000.0])
    u = np.arange(8.0)
    rate = sampling(series("u", at, u))
    assert rate.irregular
    grid, _ = resampled([series("y", t, np.sin(t / 50))], [series("u", at, u)], 5.0)
    held = grid.value["u"]
    assert held[grid.time_s == 250.0] == 0.0
    assert held[grid.time_s == 1000.0] == 4.0
    assert np.isnan(held[grid.time_s > 2000.0 + rate.hold_s + 5.0]).all()
    short, _ = resampled([series("y", t, np.sin(t / 50))], [series("u", at, u)], 5.0, hold_s=100.0)
    assert np.isnan(short.value["u"][short.time_s == 250.0]).all()


def test_a_move_in_the_second_half_of_a_period_counts_from_the_next_row() -> None:
    """What is stored by exception, to the second, holds in row k as it stood at the middle of the row's period."""
    h, t = 30.0, np.arange(0, 3600.0, 30.0)
    for after, first in ((1.0, 10), (14.0, 10), (16.0, 11), (29.0, 11)):
        at = np.array([0.0, 7.0, 300.0 + after, 1200.0 + after])
        grid, _ = resampled([series("y", t, np.sin(t / 500))], [series("u", at, np.array([0.0, 0.0, 1.0, 2.0]))], h)
        assert int(np.flatnonzero(grid.value["u"] == 1.0)[0]) == first
        assert int(np.flatnonzero(grid.value["u"] == 2.0)[0]) == first + 30


def test_a_grid_begins_anew_after_a_gap() -> None:
    t = np.r_[np.arange(0, 100.0, 2.0), np.arange(500.7, 600, 2.0)]
    grid, _ = resampled([series("y", t, t)], [], 2.0)
    assert set(grid.piece) == {0, 1}
    np.testing.assert_allclose(grid.value["y"], grid.time_s)
    assert grid.time_s[grid.piece == 1][0] == pytest.approx(500.7)


@pytest.mark.parametrize(("step", "period"), [(1.0, 1.0), (9.998, 9.998), (59.97, 59.97), (7.3, 7.3), (0.1, 0.1)])
def test_the_period_is_the_exact_step(step: float, period: float) -> None:
    assert proposed_period([series("y", step * np.arange(200), np.arange(200.0))]) == pytest.approx(period)


@pytest.mark.parametrize("step", [1 / 610.35, 0.985, 59.97, 1 / 3, 60.0])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_each_reading_of_a_regular_record_is_a_row_to_its_end(step: float, jitter: float) -> None:
    random, n = np.random.default_rng(3), 40_000
    t = step * (np.arange(n) + jitter * random.uniform(-1, 1, n))
    y, u = random.normal(size=n), random.integers(0, 9, n).astype(float)
    h = proposed_period([series("y", t, y)])
    assert abs(h - step) * n < 0.1 * step  # no tenth of a row at the end of the record
    grid, (rate, _) = resampled([series("y", t, y)], [series("u", t, u)], h)
    assert not rate.irregular
    np.testing.assert_array_equal(grid.value["y"], y)
    np.testing.assert_array_equal(grid.value["u"], u)


def test_lost_readings_and_a_clock_that_wanders_move_no_row() -> None:
    random = np.random.default_rng(4)
    n = np.flatnonzero(random.random(40_000) > 0.1)
    t = 0.985 * n + 3.0 * np.sin(n / 8000)  # by three rows to and fro
    grid, _ = resampled([series("y", t, n)], [series("u", t, n)], 0.985, hold_s=20.0)
    known = np.isin(np.arange(len(grid)), n)
    assert len(grid) == n[-1] - n[0] + 1
    np.testing.assert_array_equal(grid.value["y"][known], n)
    np.testing.assert_array_equal(grid.value["u"][known], n)


def test_every_third_row_of_a_regular_record_is_the_mean_of_its_three_readings() -> None:
    n = 30_000
    t, y = 0.985 * np.arange(n), np.random.default_rng(5).normal(size=n)
    grid, _ = resampled([series("y", t, y)], [series("u", t, y)], 3 * 0.985)
    k = np.arange(1, len(grid) - 1)
    np.testing.assert_allclose(grid.time_s[k], t[3 * k])
    np.testing.assert_allclose(grid.value["y"][k], y[: 3 * len(grid)][np.add.outer(3 * k, [-2, -1, 0])].mean(axis=1))
    np.testing.assert_allclose(grid.value["u"][k], y[: 3 * len(grid)][np.add.outer(3 * k, [0, 1, 2])].mean(axis=1))


def test_what_cannot_be_resampled_is_told() -> None:
    y = series("y", np.arange(0, 1e6, 10.0), np.zeros(100_000))
    with pytest.raises(RecordError, match="longer --period"):
        resampled([y], [], 1e-3)
    with pytest.raises(RecordError, match="no process variable has two readings"):
        proposed_period([series("y", np.array([1.0]), np.array([1.0]))])


def test_a_long_grid_in_chunks_is_the_same_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(4)
    t = np.cumsum(random.choice([0.9, 1.0, 1.1, 7.0], 900, p=[0.3, 0.35, 0.3, 0.05]))
    bad = random.random(900) < 0.1
    bad[400:440] = True  # longer than a chunk
    both = [series(tag, t, random.normal(size=900)) for tag in ("y", "u")]
    for one in both:
        one.code[bad] = Reason.TEXT
    whole, _ = resampled(both[:1], both[1:], 1.0, hold_s=3.0)
    monkeypatch.setattr(grid_module, "GRID_CHUNK", 17)
    chunks, _ = resampled(both[:1], both[1:], 1.0, hold_s=3.0)
    assert chunks.bridged == whole.bridged
    for tag in ("y", "u"):
        np.testing.assert_array_equal(chunks.value[tag], whole.value[tag])
        np.testing.assert_array_equal(chunks.code[tag], whole.code[tag])
        assert np.isnan(whole.value[tag]).any()


@pytest.mark.parametrize(("n", "factor"), [(3000, 1), (3000, 3), (3000, 4), (3000, 6), (3001, 100)])
def test_rows_of_several_readings_have_a_value_from_the_first_to_the_last(n: int, factor: int) -> None:
    t, good = 10.0 * np.arange(n), np.zeros(n, np.uint8)
    grid, _ = resampled([Series("y", t, t.copy(), good)], [Series("u", t, t.copy(), good)], 10.0 * factor)
    assert all(np.isfinite(grid.value[tag]).all() for tag in ("y", "u"))
    assert len(grid) >= n // factor
