"""Ages by clocks that do not agree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.serving.opcua.sampling import Ages

OFFSETS = [0.0, 3600.0, -3600.0, 1e9]


@pytest.mark.parametrize("offset", OFFSETS)
def test_the_clocks_difference_is_no_age(offset: float) -> None:
    ages = Ages(1)
    rng = np.random.default_rng(0)
    for k in range(1000):
        (age,) = ages.update(k + rng.uniform(0.0, 0.05), [k + offset])
        assert 0 <= age <= 0.06


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_source_time_that_stands_still_grows_old(offset: float) -> None:
    ages = Ages(2)
    for k in range(10):
        ages.update(k + 0.01, [k + offset, k + offset])
    for k in range(10, 20):
        still, moving = ages.update(k + 0.01, [9 + offset, k + offset])
        assert still == pytest.approx(k - 9)
        assert moving < 0.01


def test_values_that_come_later_and_later_are_that_old() -> None:
    """A gateway whose queue fills: each value is new, and older than the one before."""
    ages = Ages(1)
    for k in range(100):
        (age,) = ages.update(k + 0.02 * k, [float(k)])
    assert age == pytest.approx(0.02 * 99, rel=0.02)


def test_clocks_that_drift_apart_make_nothing_old() -> None:
    ages = Ages(1)
    for k in range(0, 400_000, 100):  # 100 ppm for five days
        (age,) = ages.update(k * 1.0001, [float(k)])
    assert age < 0.1


@pytest.mark.parametrize("jump", [86400.0, 3600.0, 60.0, 5.0, -5.0, -60.0, -3600.0, -86400.0])
def test_a_clock_that_was_set_is_believed_after_three_values(jump: float) -> None:
    ages = Ages(1)
    for k in range(10):
        ages.update(float(k), [float(k)])
    seen = [ages.update(float(k), [k + jump])[0] for k in range(10, 16)]
    assert seen[2:] == pytest.approx([0.0] * 4, abs=2e-3)
    assert seen[:2] == ([0.0, 0.0] if jump > 0 else pytest.approx([-jump, -jump], rel=1e-3))


def test_without_a_source_time_the_arrival_is_all_that_is_known() -> None:
    assert Ages(2).update(5.0, [None, 5.0]) == [0.0, 0.0]


JITTER_S = 0.2
JUMPS = st.floats(0.0, np.log10(86_400.0)).map(lambda e: 10.0**e)  # 1 s to a day
SIGNS = st.sampled_from([-1.0, 1.0])


def fed(ages: Ages, arrivals: np.ndarray, sources: np.ndarray) -> np.ndarray:
    return np.array([ages.update(a, [s])[0] for a, s in zip(arrivals.tolist(), sources.tolist(), strict=True)])


def arrivals(n: int, seed: int, begin: float = 0.0) -> np.ndarray:
    """Once a second, each up to ``JITTER_S`` late."""
    return begin + np.arange(n) + np.random.default_rng(seed).uniform(0.0, JITTER_S, n)


@given(JUMPS, SIGNS, st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_a_clock_that_is_set_costs_some_scans_and_no_hours(jump: float, sign: float, seed: int) -> None:
    """Set back by up to one period it looks like a delay; beyond that it is known."""
    n, at = 40, 20
    found = fed(Ages(1), arrivals(n, seed), np.arange(n) + sign * jump * (np.arange(n) >= at))
    slack = 2 * JITTER_S + (1.0 if sign < 0 and jump < 1 + JITTER_S else 0.0)
    assert (found[:at] <= JITTER_S + 0.01).all()
    assert (found[at + 3 :] <= slack + 0.01).all()


@given(JUMPS, st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_one_stamp_of_the_future_costs_some_scans_and_no_hours(jump: float, seed: int) -> None:
    n, at = 40, 20
    found = fed(Ages(1), arrivals(n, seed), np.arange(n) + jump * (np.arange(n) == at))
    slack = 2 * JITTER_S + (1.0 if jump < 1 + JITTER_S else 0.0)
    assert (found[at + 4 :] <= slack + 0.01).all()


@given(JUMPS, SIGNS, st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_after_a_jump_a_value_that_stands_still_is_found_as_fast(jump: float, sign: float, seed: int) -> None:
    n, at, stands = 40, 15, 25
    k = np.arange(n)
    found = fed(Ages(1), arrivals(n, seed), np.minimum(k, stands) + sign * jump * (k >= at))
    assert (found[stands + 1 :] >= k[stands + 1 :] - stands - 3 * JITTER_S).all()


@given(st.floats(1.5, 500.0), st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_a_queue_that_filled_while_nothing_came_is_old(delay: float, seed: int) -> None:
    """Values that come in a steady rhythm again, each so late: no source time went back, so no clock was set."""
    k = np.arange(40)
    sources = np.where(k < 20, k, np.maximum(19, k - delay))
    found = fed(Ages(1), arrivals(len(k), seed), sources)
    assert (found[20:] >= k[20:] - sources[20:] - JITTER_S - 0.01).all()


def test_what_was_old_before_a_clock_was_set_is_old_after_it() -> None:
    """A queue that fills, on a server whose clock is set back four times: what three values grew is lost at each."""
    k = np.arange(200)
    found = fed(Ages(1), k * 1.02, k - 5.0 * (k // 40))
    settled = k % 40 > 2
    lost = 0.02 * 3 * (k // 40) + 2.1e-4 * k
    assert (found >= 0.02 * k - lost - 1e-9).all()
    assert (found[settled] <= 0.02 * k[settled] + 1e-9).all()


def test_two_clocks_that_take_turns_are_not_believed() -> None:
    k = np.arange(100)
    found = fed(Ages(1), k.astype(float), k - 30.0 * (k % 2))
    assert (found[1::2] >= 29).all()
