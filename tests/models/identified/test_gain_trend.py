"""A gain that changes while the record is taken is told with its size, and a steady one is not."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.gain_trend import GainTrend, gain_trends


def plant(pole: float = 0.9) -> Dynamics:
    """x+ = pole x + (1 - pole) v: a gain of 1."""
    return Dynamics.linear(np.array([[pole]]), np.array([[1 - pole]]))


def rows(seed: int, last: float, curve: float = 0.0, n: int = 4000) -> list[Stretch]:
    """Rows of the plant whose gain goes from 1 to ``last``, of a curved MV, with a load that wanders and noise."""
    random = np.random.default_rng(seed)
    v = np.repeat(random.uniform(-1.5, 1.5, n), random.integers(10, 80, n))[:n]
    y, x, load = np.zeros(n), 0.0, 0.0
    for k in range(n):
        y[k] = x + load + 0.02 * random.standard_normal()
        load = 0.99 * load + 0.02 * random.standard_normal()
        x = 0.9 * x + 0.1 * (1 + (last - 1) * k / n) * (v[k] + curve * v[k] ** 2)
    return [Stretch(y[: n // 2, None], v[: n // 2, None]), Stretch(y[n // 2 :, None], v[n // 2 :, None])]


def trend(seed: int, last: float, curve: float = 0.0) -> GainTrend:
    return gain_trends(plant(), rows(seed, last, curve), 1)[0][0]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("last", [0.5, 0.7, 1.4])
def test_a_gain_that_changes_is_certain_and_has_its_size(seed: int, last: float) -> None:
    found = trend(seed, last)
    assert found.certain
    assert found.change == pytest.approx(last - 1, abs=0.1)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("curve", [0.0, 0.3])
def test_a_steady_gain_has_no_trend(seed: int, curve: float) -> None:
    assert not trend(seed, 1.0, curve).certain


def test_of_two_mvs_the_one_that_changes_is_named() -> None:
    random, n = np.random.default_rng(3), 4000
    v = np.column_stack([np.repeat(random.uniform(-1, 1, n), 25)[:n], np.repeat(random.uniform(-1, 1, n), 40)[:n]])
    model = Dynamics.linear(np.diag([0.9, 0.8]), np.array([[0.1, 0.05], [0.1, 0.2]]))
    y, x = np.zeros((n, 2)), np.zeros(2)
    for k in range(n):
        y[k] = x + 0.02 * random.standard_normal(2)
        b = model.b.copy()
        b[:, 1] *= 1 - 0.5 * k / n
        x = model.a @ x + b @ v[k]
    found = gain_trends(model, [Stretch(y, v)], 2)
    assert [[of.certain for of in row] for row in found] == [[False, True], [False, True]]


def test_a_model_that_explodes_has_none() -> None:
    assert gain_trends(plant(3.0), rows(0, 0.5), 1) == []
