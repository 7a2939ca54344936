"""Output-error fit: exact sensitivities, what it recovers, and its file-free bookkeeping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from loopwright.pipeline.models.identified import dynamics, output_error
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.output_error import (
    SENSITIVITY_ROWS,
    Equations,
    OutputErrorFit,
    fit_starts,
    free_run_error,
    residuals,
    sensitivity_sums,
    squares,
)


def drawn(n_y: int, n_v: int, n_x: int, n_hidden: int, seed: int) -> Dynamics:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n_x, n_x))
    a *= 0.8 / np.abs(np.linalg.eigvals(a)).max()
    return Dynamics(
        a,
        rng.normal(size=(n_x, n_v)),
        0.1 * rng.normal(size=n_x),
        0.5 * rng.normal(size=(n_hidden, n_x + n_v)),
        rng.normal(size=n_hidden),
        0.2 * rng.normal(size=(n_x, n_hidden)),
    )


def contracting(n_y: int, n_v: int, n_x: int, n_hidden: int, seed: int) -> Dynamics:
    """Like ``drawn``, and its linear part brings states together under every correction, too.

    A correction takes the outputs' feedback away, so that poles within the unit circle are not enough: the hidden
    states alone may be unstable. A norm below 1 is enough, because the correction shrinks each state or leaves it.
    """
    model = drawn(n_y, n_v, n_x, n_hidden, seed)
    return replace(model, a=model.a * (0.8 / np.linalg.norm(model.a, 2)))


def stretch(model: Dynamics, n_y: int, rows: int, seed: int, noise: float = 0.0) -> Stretch:
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(rows, model.n_v))
    empty = Stretch(np.zeros((rows, n_y)), v)
    run = model.free_run(rng.normal(size=model.n_x), empty)
    assert run is not None
    return Stretch(run[0][:, :n_y] + noise * rng.normal(size=(rows, n_y)), v)


@settings(max_examples=12, deadline=None)
@given(
    n_y=st.integers(1, 2),
    n_v=st.integers(1, 2),
    more=st.integers(0, 2),
    n_hidden=st.integers(0, 2),
    correction=st.sampled_from([0.0, 0.05, 1.0]),
    rows=st.sampled_from([5, SENSITIVITY_ROWS + 7]),
    seed=st.integers(0, 50),
)
def test_the_gradient_is_that_of_the_free_run(
    n_y: int, n_v: int, more: int, n_hidden: int, correction: float, rows: int, seed: int
) -> None:
    model = contracting(n_y, n_v, n_y + more, n_hidden, seed)
    data = [stretch(model, n_y, rows, seed + k, 0.3) for k in range(2)]
    starts = fit_starts(model, data, correction, iterations=0)
    theta = model.vector()
    free = np.random.default_rng(seed).random(len(theta)) < 0.7
    sums = sensitivity_sums(model, starts, data, free, correction)
    assert sums is not None
    direction = free * np.random.default_rng(seed + 1).normal(size=len(theta))
    step = 1e-6
    ends = [squares(model.with_vector(theta + s * direction), starts, data, correction) for s in (step, -step)]
    assert -2 * float(sums.g @ direction[free]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4, abs=1e-4)
    move = np.random.default_rng(seed + 2).normal(size=model.n_x)
    moved = [squares(model, [starts[0], starts[1] + s * move], data, correction) for s in (step, -step)]
    assert -2 * float(sums.of_starts[1][2] @ move) == pytest.approx(
        (moved[0] - moved[1]) / (2 * step), rel=1e-4, abs=1e-4
    )


@pytest.mark.parametrize(("n_y", "n_v", "n_hidden"), [(1, 1, 0), (2, 3, 5)])
def test_starts_of_many_stretches_are_those_of_each_to_the_bit(n_y: int, n_v: int, n_hidden: int) -> None:
    model = contracting(n_y, n_v, n_y + 3, n_hidden, 4)
    data = [stretch(model, n_y, 20 + k, k, 0.3) for k in range(9)]
    for one, start in zip(data, fit_starts(model, data, iterations=0), strict=True):
        x = zero = np.r_[one.y[0], np.zeros(3)]
        for _ in range(100):
            x = model.advance(x, one.v[0])
        settled = np.r_[one.y[0], x[n_y:]]
        assert np.array_equal(start, min(zero, settled, key=lambda x: squares(model, [x], [one])))
    together = fit_starts(model, data, 0.1)
    assert all(np.array_equal(x, fit_starts(model, [one], 0.1)[0]) for x, one in zip(together, data, strict=True))


@pytest.mark.parametrize("parameters", [True, False])
def test_the_step_is_that_of_plain_cholesky_factors_to_the_bit(parameters: bool) -> None:
    model = drawn(1, 1, 3, 2, 3)
    data = [stretch(model, 1, 30, k, 0.3) for k in range(4)]
    free = np.full(len(model.vector()), parameters)
    sums = sensitivity_sums(model, [np.zeros(3)] * 4, data, free, 0.0)
    assert sums is not None
    h, g, parts = sums.h + 0.1 * np.eye(len(sums.h)), sums.g, []
    for cross, own, right in sums.of_starts:
        factor = linalg.cho_factor(own + 0.02 * np.eye(3))
        parts.append((linalg.cho_solve(factor, cross.T), linalg.cho_solve(factor, right)))
        h, g = h - cross @ parts[-1][0], g - cross @ parts[-1][1]
    wanted = linalg.solve(h, g, assume_a="pos") if parameters else g
    step, moves = sums.solve(0.1, 0.02)
    assert np.array_equal(step, wanted)
    assert all(np.array_equal(move, mean - back @ wanted) for move, (back, mean) in zip(moves, parts, strict=True))


def test_a_start_without_a_least_error_is_no_step() -> None:
    sums = Equations(np.zeros((0, 0)), np.zeros(0), [(np.zeros((0, 2)), -np.eye(2), np.ones(2))])
    with pytest.raises(np.linalg.LinAlgError):
        sums.solve(0.0, 1e-9)


def test_the_step_solves_the_whole_system() -> None:
    model = drawn(1, 1, 2, 1, 3)
    data = [stretch(model, 1, 30, k, 0.3) for k in range(3)]
    starts = [np.zeros(2)] * 3
    free = np.ones(len(model.vector()), dtype=bool)
    sums = sensitivity_sums(model, starts, data, free, 0.0)
    assert sums is not None
    step, moves = sums.solve(0.1, 0.02)
    n, m = len(step), 2
    whole, right = np.zeros((n + 3 * m, n + 3 * m)), np.zeros(n + 3 * m)
    whole[:n, :n], right[:n] = sums.h + 0.1 * np.eye(n), sums.g
    for i, (cross, own, g) in enumerate(sums.of_starts):
        at = slice(n + i * m, n + (i + 1) * m)
        whole[:n, at], whole[at, :n], whole[at, at], right[at] = cross, cross.T, own + 0.02 * np.eye(m), g
    expected = np.linalg.solve(whole, right)
    assert np.concatenate([step, *moves]) == pytest.approx(expected)


def test_one_step_prediction_is_the_free_run_with_full_correction() -> None:
    model = drawn(2, 1, 2, 2, 5)
    data = stretch(model, 2, 40, 1, 0.5)
    found = residuals(model, [data.y[0]], [data], 1.0)
    assert found is not None
    assert found[0][1:] == pytest.approx(data.y[1:] - model.advance(data.y[:-1], data.v[:-1]))


def test_a_start_is_found_again() -> None:
    model = drawn(1, 1, 3, 2, 7)
    data = stretch(model, 1, 200, 2)
    errors, _ = free_run_error(model, [data])
    assert errors[0] < 1e-4


def test_a_nonlinear_system_is_fitted_down_to_its_noise() -> None:
    truth = drawn(1, 1, 2, 2, 11)
    data, held = stretch(truth, 1, 800, 1, 0.1), stretch(truth, 1, 300, 2, 0.1)
    rng = np.random.default_rng(0)
    theta = truth.vector()
    start = truth.with_vector(theta + 0.05 * rng.normal(size=len(theta)))
    fitted = OutputErrorFit(iterations=30).fit(start, [data], [held])
    assert fitted.trained == pytest.approx(0.1, rel=0.1)
    assert fitted.held_out < 0.115
    assert free_run_error(start, [held])[0][0] > 1.3 * fitted.held_out


def test_what_is_not_free_stays() -> None:
    model = drawn(1, 1, 2, 0, 2)
    data = stretch(drawn(1, 1, 2, 0, 3), 1, 200, 1, 0.1)
    fitted = OutputErrorFit(iterations=5).fit(model, [data], free=model.mask(b=True, c=True))
    assert np.array_equal(fitted.model.a, model.a)
    assert not np.array_equal(fitted.model.b, model.b)


def test_a_ridge_shrinks_the_nonlinear_weights() -> None:
    truth = drawn(1, 1, 2, 2, 11)
    data = stretch(truth, 1, 400, 1, 0.3)
    sizes = [
        float(np.sum(f.model.w1**2) + np.sum(f.model.w2**2))
        for f in (OutputErrorFit(iterations=15, ridge=r).fit(truth, [data]) for r in (0.0, 300.0))
    ]
    assert sizes[1] < 0.8 * sizes[0]


def test_a_model_of_another_layout_in_memory_is_not_compiled_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = drawn(1, 1, 3, 2, 4)
    turned = replace(plain, **{name: np.asfortranarray(getattr(plain, name)) for name in ("a", "b", "w1", "w2")})
    data, every = stretch(plain, 1, 50, 1, 0.1), np.ones(len(plain.vector()), dtype=bool)
    layouts = set()
    for place, name in ((output_error, "propagate"), (dynamics, "hold_inputs"), (dynamics, "run_rows")):
        loop = getattr(place, name)

        def noted(*given: object, name: str = name, loop: Callable[..., object] = loop) -> object:
            layouts.add((name, *(g.flags.c_contiguous for g in given if isinstance(g, np.ndarray))))
            return loop(*given)

        monkeypatch.setattr(place, name, noted)
    sums = [sensitivity_sums(m, [np.zeros(3)], [data], every, 0.0) for m in (plain, turned)]
    held = [m.hold(np.zeros((4, 3)), np.ones((4, 1)), 20)[0] for m in (plain, turned)]
    assert sums[0] is not None
    assert sums[1] is not None
    assert sums[0].g == pytest.approx(sums[1].g)
    assert held[0] == pytest.approx(held[1])
    assert sorted(name for name, *_ in layouts) == ["hold_inputs", "propagate", "run_rows"]
    assert all(all(flags) for _, *flags in layouts)


def test_the_same_data_give_the_same_bytes() -> None:
    model = drawn(1, 1, 3, 2, 4)
    data = [stretch(drawn(1, 1, 2, 1, 9), 1, 200, 1, 0.1)]
    first, second = (OutputErrorFit(iterations=4).fit(model, data).model.vector() for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_an_explosion_counts_as_an_infinite_error() -> None:
    unstable = Dynamics.linear(np.array([[1.5]]), np.array([[1.0]]))
    data = Stretch(np.zeros((200, 1)), np.ones((200, 1)))
    assert squares(unstable, [np.zeros(1)], [data]) == np.inf
    assert np.isinf(free_run_error(unstable, [data])[0]).all()
    assert sensitivity_sums(unstable, [np.zeros(1)], [data], np.ones(3, dtype=bool), 0.0) is None


def test_a_correction_makes_a_stable_model_explode_whose_hidden_states_are_unstable() -> None:
    """Poles 0.8 and 0.4; measured outputs in place of its own leave the hidden state to itself, with a pole at 1.2."""
    model = Dynamics.linear(np.array([[0.0, 1.0], [-0.32, 1.2]]), np.array([[1.0], [0.0]]))
    data, start = Stretch(np.ones((400, 1)), np.ones((400, 1))), np.zeros(2)
    every = np.ones(len(model.vector()), dtype=bool)
    assert np.isfinite(squares(model, [start], [data]))
    assert sensitivity_sums(model, [start], [data], every, 0.0) is not None
    assert squares(model, [start], [data], 1.0) == np.inf
    assert sensitivity_sums(model, [start], [data], every, 1.0) is None
