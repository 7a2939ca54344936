"""Curves in a residual: seen in white residuals of bent plants, not in those of linear ones."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.models.identified.candidates import misses
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.residual_tests import curved
from loopwright.pipeline.models.identified.structure_search import WHITE

FIRST = Dynamics.linear(np.array([[0.8]]), np.array([[0.5]]))


def record(bend: float, n: int = 1500, noise: float = 0.1, seed: int = 0) -> Stretch:
    """y+ = .8 y + .5 u + bend (u^2 - 1/3) under moves that jump each period; ``noise`` on the measured output."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, n), np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = 0.8 * y[k] + 0.5 * u[k] + bend * (u[k] ** 2 - 1 / 3)
    return Stretch((y + noise * rng.normal(size=n))[:, None], u[:, None])


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_shows_no_curve(seed: int) -> None:
    data = record(0.0, seed=seed)
    assert not curved(FIRST, [data.y[0]], [data])
    assert not curved(FIRST, [data.y[0]], [data], 1.0)


def test_a_curve_shows_although_the_residual_is_white() -> None:
    data = record(0.4, noise=0.0)
    assert not misses(FIRST, [data.y[0]], [data], WHITE, 1.0)
    assert curved(FIRST, [data.y[0]], [data], 1.0)


def test_too_few_rows_show_nothing() -> None:
    data = record(0.4, n=9, noise=0.0)
    assert not curved(FIRST, [data.y[0]], [data])


def test_a_run_that_explodes_shows_nothing() -> None:
    data = record(0.4)
    wild = Dynamics.linear(np.array([[2.0]]), np.array([[0.5]]))
    assert not curved(wild, [data.y[0]], [data])
