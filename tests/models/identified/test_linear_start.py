"""Linear start: the ARX's impulse response, the realization of a known system, and what it refuses."""

from __future__ import annotations

import made_plants
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.linear_start import (
    Realizations,
    dead_times,
    high_order_arx,
    within_unit_circle,
)
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales


def response_of(model: Dynamics, n_y: int, length: int) -> np.ndarray:
    h, power = [], np.eye(model.n_x)
    for _ in range(length):
        h.append((power @ model.b)[:n_y])
        power = power @ model.a
    return np.array(h)


@settings(max_examples=15, deadline=None)
@given(
    n_y=st.integers(1, 2),
    n_v=st.integers(1, 2),
    more=st.integers(0, 2),
    pole=st.sampled_from([0.7, 0.95, 1.0]),
    seed=st.integers(0, 99),
)
def test_a_system_is_realized_from_its_impulse_response(n_y: int, n_v: int, more: int, pole: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n_x = n_y + more
    turn = np.linalg.qr(rng.normal(size=(n_x, n_x)))[0]
    a = turn @ np.diag(np.r_[pole, np.linspace(0.2, 0.6, n_x - 1)]) @ turn.T
    system = Dynamics.linear(a, rng.normal(size=(n_x, n_v)))
    h = response_of(system, n_y, 60)
    found = Realizations.of(h, np.full(n_v, 0.5)).order(n_x)
    assert response_of(found, n_y, 60) == pytest.approx(h, abs=1e-4 * np.abs(h).max())


def test_the_arx_finds_gain_and_dead_time() -> None:
    record = made_plants.second_order(delay=6)
    scales = Scales.of(record, 1)
    data = ScaledRecord.of(record, scales)
    h = high_order_arx(data).impulse_response(100)
    gain = h.sum() * scales.y_scale[0] / scales.v_scale[0]
    assert gain == pytest.approx(0.5, rel=0.05)
    assert dead_times(h, data.v.std(axis=0))[0] in (5, 6, 7)


def test_an_integrator_has_a_response_that_stays() -> None:
    record = made_plants.integrator()
    data = ScaledRecord.of(record, Scales.of(record, 1))
    h = high_order_arx(data).impulse_response(60)[:, 0, 0]
    assert h[30:].min() > 0.5 * h.max()


@given(seed=st.integers(0, 99))
def test_poles_are_moved_in_and_no_others(seed: int) -> None:
    a = np.random.default_rng(seed).normal(size=(4, 4))
    poles = np.linalg.eigvals(a)
    moved = np.linalg.eigvals(within_unit_circle(a))
    assert np.abs(moved).max() <= 1 + 1e-9
    expected = np.sort(np.minimum(np.abs(poles), 1))
    assert np.sort(np.abs(moved)) == pytest.approx(expected, abs=1e-7)


def test_orders_that_cannot_be() -> None:
    h = response_of(Dynamics.linear(np.diag([0.5, 0.6]), np.ones((2, 1))), 2, 20)
    with pytest.raises(ModelError, match="cannot carry 2 outputs"):
        Realizations.of(h, np.ones(1)).order(1)
    with pytest.raises(ModelError, match="unstable"):
        Realizations.of(h * 1e6, np.ones(1))


def test_too_few_rows_are_refused() -> None:
    record = made_plants.second_order(n=200)
    with pytest.raises(ModelError, match="too few to identify"):
        high_order_arx(ScaledRecord.of(record, Scales.of(record, 1)).rows(slice(0, 15)))
