"""Fits of outputs that are read now and then: rows without a reading say nothing, and those that have one say all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_output_error import contracting, drawn, stretch

from loopwright.pipeline.historian.answers import DirectModel
from loopwright.pipeline.models.identified.dynamics import Stretch
from loopwright.pipeline.models.identified.fresh_errors import changes_of, covariance_of, deviation_of, rms
from loopwright.pipeline.models.identified.identified import handed_over, noise_of, remembering
from loopwright.pipeline.models.identified.innovations import Innovations, innovations, with_loads
from loopwright.pipeline.models.identified.output_error import OutputErrorFit, residuals, sensitivity_sums, squares
from loopwright.pipeline.models.identified.residual_tests import residual_figures


def read_now_and_then(part: Stretch, every: int, seed: int) -> Stretch:
    """The second output is read every so many rows; what stands there between is nonsense."""
    rng = np.random.default_rng(seed)
    fresh = np.ones(part.y.shape, dtype=np.bool_)
    fresh[:, 1] = np.arange(len(part)) % every == 0
    return replace(part, y=np.where(fresh, part.y, 1e3 * rng.normal(size=part.y.shape)), fresh=fresh)


@pytest.mark.parametrize("correction", [0.0, 0.3])
def test_what_stands_between_readings_changes_nothing(correction: float) -> None:
    model = contracting(2, 1, 4, 2, 0)
    whole = stretch(model, 2, 400, 1, 0.05)
    one, other = (read_now_and_then(whole, 7, seed) for seed in (2, 3))
    start = np.r_[whole.y[0], np.zeros(2)]
    assert squares(model, [start], [one], correction) == squares(model, [start], [other], correction)
    sums = [sensitivity_sums(model, [start], [of], model.free(), correction) for of in (one, other)]
    assert sums[0] is not None
    assert sums[1] is not None
    assert np.array_equal(sums[0].h, sums[1].h)
    assert np.array_equal(sums[0].g, sums[1].g)


def test_all_rows_fresh_is_the_same_to_the_bit_as_no_word_of_it() -> None:
    model = contracting(2, 1, 4, 2, 0)
    plain = stretch(model, 2, 300, 1, 0.05)
    told = replace(plain, fresh=np.ones(plain.y.shape, dtype=np.bool_))
    start = np.r_[plain.y[0], np.zeros(2)]
    for correction in (0.0, 0.2):
        assert squares(model, [start], [plain], correction) == squares(model, [start], [told], correction)


def test_sensitivities_are_those_of_the_errors_that_count() -> None:
    model = contracting(2, 1, 3, 0, 4)
    part = read_now_and_then(stretch(model, 2, 120, 5, 0.05), 5, 6)
    start, free = np.r_[part.y[0, 0], 0.0, 0.1], model.free()
    for correction in (0.0, 0.3):
        sums = sensitivity_sums(model, [start], [part], free, correction)
        assert sums is not None
        theta = model.vector()
        for k in (0, 4, 10):
            ends = []
            for step in (1e-6, -1e-6):
                moved = theta.copy()
                moved[k] += step
                ends.append(squares(model.with_vector(moved), [start], [part], correction))
            assert -(ends[0] - ends[1]) / 4e-6 == pytest.approx(sums.g[k], rel=1e-4, abs=1e-6)


def test_a_fit_recovers_an_output_from_a_seventh_of_its_rows() -> None:
    true = contracting(2, 1, 2, 0, 7)
    whole = stretch(true, 2, 2_000, 8, 0.02)
    part = read_now_and_then(whole, 7, 9)
    begun = replace(true, a=0.9 * true.a, b=1.2 * true.b)
    found = OutputErrorFit(iterations=40).fit(begun, [part])
    left = residuals(found.model, found.starts, [part])
    assert left is not None
    assert np.isnan(left[0][~part.seen]).all()
    assert found.trained == pytest.approx(0.02, rel=0.1)
    assert np.abs(found.model.a - true.a).max() < 0.05


def test_the_filter_of_a_model_with_its_noise_ignores_rows_without_a_reading() -> None:
    plant = contracting(2, 1, 3, 0, 10)
    model = replace(with_loads(plant, 2), gain=0.1 * np.ones((5, 2)))
    assert isinstance(model, Innovations)
    whole = stretch(plant, 2, 300, 11, 0.05)
    one, other = (innovations(model, [read_now_and_then(whole, 4, seed)]) for seed in (1, 2))
    assert one is not None
    assert other is not None
    assert np.array_equal(one, other, equal_nan=True)
    assert np.isnan(one[:, 1]).mean() == pytest.approx(0.75, abs=0.02)


def test_figures_of_errors_leave_out_what_is_not_read() -> None:
    rng = np.random.default_rng(12)
    plain = 0.5 * rng.normal(size=(3_000, 2))
    seldom = plain.copy()
    seldom[np.arange(3_000) % 10 != 0, 1] = np.nan
    assert rms(seldom) == pytest.approx([0.5, 0.5], rel=0.1)
    assert noise_of([seldom]) == pytest.approx([0.5, 0.5], rel=0.1)
    assert np.isfinite(changes_of([seldom])[0][:, 1]).sum() == 299
    assert deviation_of([plain]).tolist() == plain.std(axis=0).tolist()
    assert covariance_of(seldom) == pytest.approx(0.25 * np.eye(2), abs=0.05)
    figures = residual_figures([seldom], [rng.normal(size=(3_000, 1))], ["a", "b"])
    assert figures["b"]["autocorrelated"] <= 0.12
    assert figures["b"]["input_correlated"] <= 0.12


def test_an_output_that_is_handed_over_late_is_that_output_so_many_rows_before() -> None:
    model, late = drawn(3, 2, 5, 2, 13), (0, 3, 1)
    whole = handed_over(remembering(model, (2, 0)), late)
    rng = np.random.default_rng(14)
    v = rng.normal(size=(60, 2))
    x, z = np.zeros(model.n_x + 2), np.zeros(whole.n_x)
    as_they_are, as_they_come = [], []
    for k in range(60):
        as_they_are.append(x[:3].copy())
        as_they_come.append(z[:3].copy())
        x, z = remembering(model, (2, 0)).advance(x, v[k]), whole.advance(z, v[k])
    y, given = np.array(as_they_are), np.array(as_they_come)
    for i, d in enumerate(late):
        assert given[d:, i] == pytest.approx(y[: 60 - d, i], abs=1e-12)


def test_answers_read_from_readings_alone_have_the_gain_and_an_honest_doubt() -> None:
    rng = np.random.default_rng(15)
    n, every = 4_000, 20
    u = np.repeat(rng.uniform(-1, 1, n // 25), 25)[:n, None]
    y, x = np.empty(n), 0.0
    for k in range(n):
        y[k] = x + 0.05 * rng.normal()
        x += (2.0 * u[k, 0] - x) / 15
    read = np.arange(n) % every == 0
    between = np.where(read, y, 1e6)
    model = DirectModel.of(between, u, np.zeros(n, dtype=np.int64), read=read)
    assert model is not None
    value, sd = model.answer(0, 60, 90)
    assert abs(value - 2.0) < 4 * sd
    assert sd < 0.1
