"""Where a plant can be held: rests, balances of what never settles, and local gains, on plants with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.rests import balanced, courses, local_gains, settled
from loopwright.serving.manifest import Signal

POLE = 0.8


def plant(a: np.ndarray, b: np.ndarray, c: np.ndarray, hidden: float = 0.0) -> IdentifiedPlant:
    """Every state an output; ``hidden`` times tanh of the first MV comes to the first state."""
    n, m = b.shape
    w1 = np.zeros((1, n + m))
    w1[0, n] = 1.0
    arrays = IdentifiedArrays(
        a=a, b=b, c=c, w1=w1, b1=np.zeros(1), w2=hidden * np.eye(n, 1), y_center=np.zeros(n), y_scale=np.ones(n),
        v_center=np.zeros(m), v_scale=np.ones(m), rest=np.zeros((n, n + m + 1)),
    )  # fmt: skip
    y, u = (tuple(Signal(f"{kind}{i}", "m", -5.0, 5.0) for i in range(k)) for kind, k in (("y", n), ("u", m)))
    return IdentifiedPlant(Signals(1.0, y, y, (), u), arrays)


def test_a_plant_settles_where_its_equation_stands_still() -> None:
    lag = plant(np.array([[POLE]]), np.array([[0.4]]), np.array([0.1]))
    x = settled(lag, np.zeros(1), np.array([[0.0], [1.0]]))
    assert x[:, 0] == pytest.approx([0.5, 2.5], abs=1e-6)


def test_a_plant_that_runs_away_stays_finite() -> None:
    unstable = plant(np.array([[1.5]]), np.array([[1.0]]), np.zeros(1))
    assert np.isfinite(courses(unstable, np.ones(1), np.ones((1, 1)), 300)).all()


def test_a_level_rests_at_any_height_under_the_mvs_that_balance_it() -> None:
    a, b = np.array([[1.0, 0.0], [0.0, POLE]]), np.array([[0.1, -0.3], [0.2, 0.0]])
    both = plant(a, b, np.array([0.02, 0.0]))
    x, mv, away = balanced(both, np.zeros(2), np.array([0.5, 0.0]), np.array([3.0]), [0])
    assert away < 1e-9
    assert x[0] == pytest.approx(3.0)
    assert both.step(x, mv, np.zeros(0), both.parameters()) == pytest.approx(x, abs=1e-9)
    # Both MVs can balance it: they move as little as they can, towards the nearest point of the line.
    assert np.linalg.norm(mv - [0.5, 0.0]) < 0.5


def test_a_balance_that_no_mv_makes_says_so() -> None:
    deaf = plant(np.array([[1.0]]), np.array([[0.0]]), np.array([0.1]))
    assert balanced(deaf, np.zeros(1), np.zeros(1), np.array([1.0]), [0])[2] > 0.05


def test_a_local_gain_is_the_slope_of_the_rests() -> None:
    bent = plant(np.array([[POLE]]), np.array([[0.2]]), np.zeros(1), hidden=0.6)
    places = np.array([-1.0, 0.0, 1.0])
    gains, rates = local_gains(bent, 0, places, np.zeros(1), 1)
    assert not rates.any()
    assert gains[:, 0] == pytest.approx((0.2 + 0.6 / np.cosh(places) ** 2) / (1 - POLE), rel=0.02)


def test_of_a_level_it_is_a_rate() -> None:
    level = plant(np.array([[1.0]]), np.array([[0.03]]), np.zeros(1))
    gains, rates = local_gains(level, 0, np.array([0.0, 0.5]), np.zeros(1), 1)
    assert rates.all()
    assert gains[:, 0] == pytest.approx([0.03, 0.03])
