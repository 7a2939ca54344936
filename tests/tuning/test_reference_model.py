"""Reference models: their matrices against scipy, costs against closed forms, the search against neighbours."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal
from scipy.integrate import quad, solve_ivp

from loopwright.pipeline.tuning.reference_model import CLASSIC, ORDERS, ReferenceModel, itae, searched


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("wn", [0.05, 1.7])
def test_sampled_matrices_are_the_zero_order_hold_of_the_transfer_function(order: int, wn: float) -> None:
    model, period = ReferenceModel.optimal(order, wn), 0.4 / wn
    (phi, gamma), c = model.sampled(period), model.continuous().c
    n, wn = model.order, model.wn
    numerator, denominator = [wn**n], [wn**i * d for i, d in enumerate((1.0, *model.coefficients, 1.0))]
    expected = signal.cont2discrete(signal.tf2ss(numerator, denominator), period, "zoh")
    markov = [float((c @ np.linalg.matrix_power(phi, k) @ gamma)[0, 0]) for k in range(20)]
    a, b, output, *_ = expected
    assert markov == pytest.approx(
        [float((output @ np.linalg.matrix_power(a, k) @ b)[0, 0]) for k in range(20)], abs=1e-9
    )


@pytest.mark.parametrize("order", [1, 2, 4])
def test_response_follows_the_differential_equation_between_moves(order: int) -> None:
    model, period = ReferenceModel.optimal(order, 0.05), 2.0
    levels = np.repeat([0.46, 0.40, 0.52], 60)
    y = model.response(levels, period)
    a, b = model.continuous().a, model.continuous().b
    x = np.zeros(order)
    x[0] = levels[0]
    for i, level in enumerate((0.46, 0.40, 0.52)):
        run = solve_ivp(
            lambda _, x, r=level: a @ x + b[:, 0] * r, (0, 120.0), x, rtol=1e-9, atol=1e-12, dense_output=True
        )
        times = period * np.arange(60)
        assert y[60 * i : 60 * (i + 1), 0] == pytest.approx(run.sol(times)[0], abs=1e-7)
        x = run.y[:, -1]


def test_response_starts_at_rest_and_ends_at_the_level() -> None:
    levels = np.concatenate([np.full(5, 0.46), np.full(300, 0.36)])
    y = ReferenceModel.optimal(3, 0.05).response(levels[:, None], 2.0)
    assert y.shape == (305, 1)
    assert y[:6, 0] == pytest.approx(0.46, abs=1e-14)  # the move at sample 5 shows at sample 6 at the earliest
    assert y[-1, 0] == pytest.approx(0.36, abs=1e-9)


@given(st.integers(1, 6), st.floats(-2.0, 2.0), st.floats(-3.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_response_is_linear_in_the_levels(order: int, scale: float, shift: float) -> None:
    model, levels = ReferenceModel.classic(order, 0.3), np.random.default_rng(0).normal(size=40)
    expected = scale * model.response(levels, 1.0) + shift
    assert model.response(scale * levels + shift, 1.0) == pytest.approx(expected, abs=1e-12)


def test_itae_of_the_first_order_in_closed_form() -> None:
    assert itae(np.array([])) == pytest.approx(1.0, abs=2e-5)  # of e = exp(-t)


@pytest.mark.parametrize("zeta", [0.6, 0.7])
def test_itae_of_the_second_order_against_quadrature(zeta: float) -> None:
    root = math.sqrt(1 - zeta**2)

    def error(t: float) -> float:
        return math.exp(-zeta * t) * (math.cos(root * t) + zeta / root * math.sin(root * t))

    # Between its zeros the error keeps its sign.
    first = (math.pi - math.atan(root / zeta)) / root
    ends = [0.0, *(first + k * math.pi / root for k in range(12))]
    total = sum(abs(quad(lambda t: t * error(t), a, b)[0]) for a, b in pairwise(ends))
    assert itae(np.array([2 * zeta])) == pytest.approx(total, abs=2e-5)


@pytest.mark.parametrize("order", [n for n in ORDERS if n > 1])
def test_search_beats_the_classic_table_and_its_own_neighbours(order: int) -> None:
    found = np.array(searched(order))
    least = itae(found)
    assert least < itae(np.array(CLASSIC[order]))
    rng = np.random.default_rng(1)
    for size in (0.003, 0.03):
        assert all(itae(found * np.exp(size * rng.standard_normal(order - 1))) > least for _ in range(30))


def test_search_does_not_depend_on_its_seed() -> None:
    assert itae(np.array(searched(4, seed=3))) == pytest.approx(itae(np.array(searched(4))), rel=1e-5)


def test_an_unstable_polynomial_costs_infinitely_much() -> None:
    assert itae(np.array([0.5, 0.5])) == math.inf


@pytest.mark.parametrize(
    ("order", "coefficients", "wn", "words"),
    [
        (2, (), 1.0, "one coefficient fewer"),
        (0, (), 1.0, "order of at least 1"),
        (2, (-1.0,), 1.0, "not stable"),
        (2, (1.4,), 0.0, "must be above 0"),
        (2, (1.4,), math.nan, "must be above 0"),
    ],
)
def test_models_that_make_no_sense_are_refused(
    order: int, coefficients: tuple[float, ...], wn: float, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        ReferenceModel(order, coefficients, wn)


def test_orders_that_no_table_has_are_refused() -> None:
    with pytest.raises(ValueError, match="1 to 6"):
        ReferenceModel.classic(7)
    with pytest.raises(ValueError, match="at least 1"):
        searched(0)
