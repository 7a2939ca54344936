"""The innovations form: exact sensitivities, units, the filter that it begins with, and the noise that it tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_output_error import contracting

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.innovations import (
    Innovations,
    PredictionError,
    begun,
    filter_gain,
    forgetting,
    innovations,
    load_moves,
    noise_of_filter,
    typical,
    with_loads,
)
from loopwright.pipeline.models.identified.output_error import OutputErrorFit, residuals, sensitivity_sums

Array = np.ndarray


def drawn(n_y: int = 2, n_v: int = 2, n_hidden: int = 0, seed: int = 0) -> Innovations:
    """A model of 3 states with loads, its filter stable."""
    plant = contracting(n_y, n_v, 3, n_hidden, seed)
    model = with_loads(plant, n_y)
    gain = filter_gain(model.a, n_y, 0.1, 0.01)
    assert gain is not None
    return replace(model, gain=gain)


def rows(model: Innovations, n: int = 300, seed: int = 1) -> Stretch:
    """What the model foresees, and innovations of 1 on top."""
    rng = np.random.default_rng(seed)
    v, e = rng.normal(size=(n, model.n_v)), rng.normal(size=(n, model.n_loads))
    x, y = np.zeros(model.n_x), np.empty((n, model.n_loads))
    for k in range(n):
        y[k] = x[: model.n_loads] + e[k]
        x = model.advance(x + model.gain @ e[k], v[k])
    return Stretch(y, v)


@pytest.mark.parametrize("n_hidden", [0, 2])
def test_sensitivities_are_those_of_finite_differences(n_hidden: int) -> None:
    model, start = drawn(n_hidden=n_hidden), np.full(5, 0.1)
    data, free = rows(model, 40), model.free()
    sums = sensitivity_sums(model, [start], [data], free, 0.0)
    assert sums is not None
    jac = np.empty((80, int(free.sum())))
    for column, place in enumerate(np.flatnonzero(free)):
        ends = []
        for sign in (1, -1):
            theta = model.vector()
            theta[place] += sign * 1e-6
            found = residuals(model.with_vector(theta), [start], [data])
            assert found is not None
            ends.append(found[0].ravel())
        jac[:, column] = (ends[1] - ends[0]) / 2e-6
    np.testing.assert_allclose(sums.h, jac.T @ jac, rtol=1e-6, atol=1e-5)


def test_a_fit_leaves_how_the_loads_go_on() -> None:
    model = drawn(n_hidden=2)
    rng = np.random.default_rng(0)
    theta = model.vector()
    theta[model.free()] += rng.normal(size=int(model.free().sum()))
    moved = model.with_vector(theta)
    n = model.plant.n_x
    np.testing.assert_array_equal(moved.a[n:], np.eye(5)[n:])
    np.testing.assert_array_equal(moved.a[:n, n:], np.eye(n, 2))
    assert not moved.w1[:, n:5].any()
    assert not moved.b[n:].any()
    assert np.all(moved.plant.a != model.plant.a)


def test_other_units_of_the_outputs_change_no_prediction() -> None:
    model, size = drawn(n_hidden=2), np.array([0.2, 30.0])
    data = rows(model)
    scaled = Stretch(data.y / size, data.v)
    first, second = innovations(model, [data]), innovations(model.rescaled(size), [scaled])
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(second * size, first, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(model.rescaled(size).rescaled(1 / size).vector(), model.vector(), rtol=1e-12)


def test_the_errors_of_the_true_model_are_its_innovations() -> None:
    model = drawn()
    errors = innovations(model, [rows(model, 3_000)])
    assert errors is not None
    assert typical(errors) == pytest.approx(1.0, rel=0.05)
    lagged = np.mean(errors[1:] * errors[:-1], axis=0)
    assert np.all(np.abs(lagged) < 4 / np.sqrt(len(errors)))


def loaded(n: int = 4_000, noise: float = 0.3, change: float = 0.02, seed: int = 3) -> tuple[Dynamics, Stretch]:
    """A lag under random steps, a load that wanders, and white measurement noise: (the plant, its rows)."""
    rng = np.random.default_rng(seed)
    plant = Dynamics.linear(np.array([[0.9]]), np.array([[0.2]]))
    v = np.repeat(rng.normal(size=n // 40), 40)[:, None]
    x, d, y = np.zeros(1), 0.0, np.empty((n, 1))
    for k in range(n):
        y[k] = x + noise * rng.normal()
        x, d = plant.advance(x, v[k]) + d, d + change * rng.normal()
    return plant, Stretch(y, v)


def test_the_filter_tells_the_noise_from_the_load() -> None:
    plant, data = loaded()
    model = PredictionError(iterations=20).fit(begun(plant, [data]), [data], gain_alone=True).model
    assert isinstance(model, Innovations)
    errors = innovations(model, [data])
    assert errors is not None
    assert noise_of_filter(model, errors)[0] == pytest.approx(0.3, rel=0.1)
    # The stationary Kalman gain of these variances, which nobody told the fit.
    best = filter_gain(model.a, 1, 1e-9, (0.02 / 0.3) ** 2)
    assert best is not None
    np.testing.assert_allclose(model.gain, best, atol=0.05)


def test_fits_find_the_plant_under_a_wandering_load_where_free_runs_do_not() -> None:
    wrong = Dynamics.linear(np.array([[0.8]]), np.array([[0.5]]))
    by_steps, by_runs = [], []
    for seed in range(5):
        _, data = loaded(seed=seed)
        for found, model in (
            (by_steps, PredictionError(iterations=30).fit(begun(wrong, [data]), [data]).model.plant),
            (by_runs, OutputErrorFit(iterations=30).fit(wrong, [data]).model),
        ):
            found.append(float(model.b[0, 0] / (1 - model.a[0, 0])))
    assert np.mean(by_steps) == pytest.approx(2.0, rel=0.05)
    missed, of_runs = (float(np.abs(np.array(gains) - 2.0).mean()) for gains in (by_steps, by_runs))
    assert missed < 0.15
    assert of_runs > 5 * missed


def test_the_moves_of_the_loads_are_those_that_the_filter_sees() -> None:
    """L e of the loads' rows, over the rows that count of each stretch; none where the filter explodes."""
    model, n_x = drawn(), 5
    parts = [rows(model, 400, 1), rows(model, 300, 2)]
    found = load_moves(model, parts)
    errors = [innovations(model, [part]) for part in parts]
    expected = [e[:-1] @ model.gain[n_x - 2 :].T for e in errors if e is not None]
    np.testing.assert_allclose(found, np.concatenate(expected), atol=1e-9)
    wild = replace(model, a=2 * model.a)
    assert innovations(wild, parts) is None
    assert load_moves(wild, parts).shape == (0, 2)


@pytest.mark.parametrize("n_y", [1, 2])
def test_a_filter_that_runs_away_gives_way_to_one_of_the_same_spectrum_that_forgets(n_y: int) -> None:
    model = drawn(n_y)
    c, eye = np.eye(n_y, model.n_x), np.eye(n_y)

    def poles(of: Innovations) -> np.ndarray:
        return np.asarray(np.abs(np.linalg.eigvals(of.a - of.a @ of.gain @ c)))

    size = next(s for s in np.linspace(1, 40, 400) if poles(replace(model, gain=s * model.gain)).max() > 1.02)
    wild, covariance = replace(model, gain=size * model.gain), eye + 0.3 * (1 - eye)
    calm = forgetting(wild, covariance)
    before = poles(wild)
    assert np.sort(poles(calm)) == pytest.approx(np.sort(np.minimum(before, 1 / before)))

    def shaped(of: Innovations, at: complex) -> np.ndarray:
        return np.eye(n_y) + c @ np.linalg.solve(at * np.eye(of.n_x) - of.a, of.a @ of.gain)

    seen = []
    for angle in (0.1, 0.7, 1.9, 3.0):
        at = np.exp(1j * angle)
        ratio = np.linalg.solve(shaped(calm, at), shaped(wild, at))
        seen.append(ratio @ covariance @ ratio.conj().T)
    assert np.array(seen) == pytest.approx(np.broadcast_to(seen[0].real, (4, n_y, n_y)), abs=1e-6)
    assert np.linalg.det(seen[0].real) > np.linalg.det(covariance)
    assert forgetting(calm, covariance) is calm


def test_a_fit_ends_in_a_filter_that_forgets() -> None:
    model, c = drawn(1), np.eye(1, 4)
    gains = (replace(model, gain=size * model.gain) for size in np.linspace(1, 40, 4000))
    wild = next(of for of in gains if np.abs(np.linalg.eigvals(of.a - of.a @ of.gain @ c)).max() > 1.02)
    fitted = PredictionError(iterations=0).fit(wild, [rows(model)], [rows(model, seed=2)])
    assert isinstance(fitted.model, Innovations)
    assert np.abs(np.linalg.eigvals(fitted.model.a - fitted.model.a @ fitted.model.gain @ c)).max() < 1
    assert fitted.held_out < 0.5 * typical(innovations(wild, [rows(model, seed=2)]))


def test_slow_outputs_count_as_much_as_fast_ones() -> None:
    errors = np.column_stack([np.full(10, 0.01), np.full(10, 1.0)])
    assert typical(errors) == pytest.approx(0.1)
    assert typical(None) == np.inf


def test_a_plant_that_no_filter_holds_is_an_error() -> None:
    data = Stretch(np.zeros((100, 1)), np.full((100, 1), 1e3))
    with pytest.raises(ModelError):
        begun(Dynamics.linear(np.array([[3.0, 0.0], [0.0, 4.0]]), np.array([[1.0], [1.0]])), [data])
