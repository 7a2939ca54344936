"""Stability over the visited range: stable, integrating, swinging at a rest, growing along the record."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.steady_states import rest_map, stability_figures


def figures(model: Dynamics, rows: int = 400) -> dict[str, object]:
    v = np.repeat(np.random.default_rng(0).uniform(-1, 1, (rows // 20, model.n_v)), 20, axis=0)
    x, states = np.zeros(model.n_x), []
    for row in v:
        states.append(x)
        x = np.clip(model.advance(x, row), -50, 50)
    return stability_figures(model, [np.array(states)], [v])


def linear(pole: float) -> Dynamics:
    return Dynamics.linear(np.diag([pole, 0.3]), np.array([[0.1], [0.2]]))


def test_a_stable_model_forgets_at_its_slowest_pole() -> None:
    found = figures(linear(0.9))
    assert found["stable"] is True
    assert found["growth"] == pytest.approx(0.9, rel=0.01)
    assert found["largest_pole"] == pytest.approx(0.9)
    assert found["unstable_share"] == 0
    assert found["settles"] == 1


def test_an_integrator_is_called_one() -> None:
    found = figures(linear(1.0))
    assert found["stable"] is True
    assert str(found["verdict"]).startswith("integrates")


def test_a_model_without_a_rest_knows_of_none() -> None:
    v = np.random.default_rng(0).uniform(-1, 1, (100, 1))
    table, covariance = rest_map(linear(1.0), np.full((100, 1), 1e3), v, 0)
    assert not table.any()
    assert np.array_equal(covariance, np.eye(2))


def test_growth_is_unstable() -> None:
    found = figures(linear(1.02))
    assert found["stable"] is False
    assert found["unstable_share"] == 1
    assert str(found["verdict"]).startswith("unstable")


def test_a_swing_about_a_rest_is_found_where_five_poles_of_a_would_not() -> None:
    # A rotation that grows inside the units' linear range and is held by their saturation: a limit cycle.
    turn = 0.6 * np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    model = Dynamics(0.5 * turn, np.array([[0.1], [0.0]]), np.zeros(2), np.eye(2, 3), np.zeros(2), 1.4 * turn)
    assert np.abs(np.linalg.eigvals(model.a)).max() < 0.5
    found = figures(model)
    assert found["stable"] is False
    assert float(str(found["settles"])) < 1
