"""Ages by clocks that do not agree."""

from __future__ import annotations

import numpy as np
import pytest

from serving.opcua.ages import Ages

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


@pytest.mark.parametrize("jump", [3600.0, -3600.0])
def test_a_clock_that_was_set_is_believed_after_three_values(jump: float) -> None:
    ages = Ages(1)
    for k in range(10):
        ages.update(float(k), [float(k)])
    seen = [ages.update(float(k), [k + jump])[0] for k in range(10, 16)]
    assert seen[2:] == [0.0] * 4
    assert seen[:2] == ([0.0, 0.0] if jump > 0 else pytest.approx([3600.0, 3600.0], rel=1e-6))


def test_without_a_source_time_the_arrival_is_all_that_is_known() -> None:
    assert Ages(2).update(5.0, [None, 5.0]) == [0.0, 0.0]
