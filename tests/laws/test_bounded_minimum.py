"""The minimum of a quadratic problem within bounds: at its end, within its bounds, and what batches and points do."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from identified_models import made_signals
from scipy.optimize import lsq_linear

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.predictive.bounded_minimum import PLAN_RIDGE, BoundedMinimum
from loopwright.pipeline.laws.predictive.predictive import Predictive

Problem = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
seeds = st.integers(0, 2**16)
some = settings(max_examples=60, deadline=None)


def problem(seed: int, m: int, flat: float = 0.1) -> Problem:
    """Curvature, pull, a plan and its bounds; the smaller ``flat``, the more nearly some directions cost nothing."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((m, m)) * flat ** rng.uniform(0, 1, m)
    low = -rng.uniform(0, 1, m)
    return (
        root @ root.T + 1e-4 * np.eye(m),
        3 * rng.standard_normal(m),
        rng.uniform(-1, 1, m),
        low,
        low + rng.uniform(0.1, 2, m),
    )


def minimum(h: np.ndarray, pull: np.ndarray, plan: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """By an active set of scipy, with the price of a step away from the plan."""
    ridge = PLAN_RIDGE * np.diag(h)
    h, pull = h + np.diag(ridge), pull + ridge * np.clip(plan, low, high)
    root = np.linalg.cholesky(h)
    found = lsq_linear(root.T, np.linalg.solve(root, pull), (low, high), method="bvls", tol=1e-14, max_iter=1000)
    return np.asarray(np.clip(found.x, low, high))


def found(given: Problem, changes: int, *, swept: bool = True) -> np.ndarray:
    """The plan of as many changes."""
    h, *rows = (torch.from_numpy(v) for v in given)
    solver = BoundedMinimum(len(rows[0]), changes)
    return np.asarray(solver(h, *(r.unsqueeze(0) for r in rows), swept=swept).squeeze(0).numpy())


def cost(given: Problem, z: np.ndarray) -> float:
    """With the price of the step."""
    h, pull, plan, low, high = given
    off = z - np.clip(plan, low, high)
    return float(z @ h @ z / 2 - pull @ z + PLAN_RIDGE * (np.diag(h) * off**2).sum() / 2)


@given(seeds, st.integers(1, 15), st.sampled_from([1.0, 0.1, 0.01]))
@some
def test_with_enough_changes_it_comes_to_the_minimum_from_any_plan(seed: int, m: int, flat: float) -> None:
    given = problem(seed, m, flat)
    z, best = found(given, 6 * m), minimum(*given)
    assert cost(given, z) <= cost(given, best) + 1e-9 * (1 + abs(cost(given, best)))


@given(seeds, st.integers(2, 15))
@some
def test_two_changes_suffice_where_the_plan_before_has_nearly_its_bounds(seed: int, m: int) -> None:
    """From the minimum of a problem whose pull is a little different, as from sample to sample."""
    h, pull, plan, low, high = problem(seed, m)
    moved = pull + 0.02 * np.random.default_rng(seed + 1).standard_normal(m)
    start = minimum(h, pull, plan, low, high)
    given = (h, moved, start, low, high)
    best, changed = minimum(*given), 0
    changed = int(((np.abs(best - low) < 1e-9) != (np.abs(start - low) < 1e-9)).sum())
    changed += int(((np.abs(best - high) < 1e-9) != (np.abs(start - high) < 1e-9)).sum())
    if changed <= 2:
        np.testing.assert_allclose(found(given, 4, swept=False), best, atol=1e-6)


@given(seeds, st.integers(1, 12), st.integers(0, 3), st.booleans())
@some
def test_the_plan_lies_within_its_bounds(seed: int, m: int, changes: int, swept: bool) -> None:
    given = problem(seed, m, 0.01)
    z = found(given, changes, swept=swept)
    assert np.isfinite(z).all()
    assert (z >= given[3] - 1e-12).all()
    assert (z <= given[4] + 1e-12).all()


@pytest.mark.parametrize("swept", [True, False])
def test_a_range_that_is_a_point_keeps_its_entry_and_the_others_are_at_their_best(swept: bool) -> None:
    h, pull, plan, low, high = problem(5, 6)
    high[2] = low[2] = plan[2] = 0.3
    z = found((h, pull, plan, low, high), 20, swept=swept)
    assert z[2] == 0.3
    rest = [0, 1, 3, 4, 5]
    inner = (h[np.ix_(rest, rest)], (pull - h[2] * 0.3)[rest], plan[rest], low[rest], high[rest])
    np.testing.assert_allclose(z[rest], minimum(*inner), atol=1e-9)


def test_of_two_entries_that_are_the_same_one_is_exchanged_at_a_time() -> None:
    h = np.eye(2)
    z = found((h, np.array([2.0, 2.0]), np.zeros(2), -np.ones(2), np.ones(2)), 2, swept=False)
    np.testing.assert_allclose(z, [1.0, 1.0])


def test_leading_dimensions_are_problems_of_their_own() -> None:
    given = [problem(seed, 5) for seed in (1, 2, 3)]
    h, *rows = (torch.from_numpy(np.stack(v)) for v in zip(*given, strict=True))
    together = BoundedMinimum(5, 3)(h, *(r.unsqueeze(-2) for r in rows), swept=True).squeeze(-2).numpy()
    np.testing.assert_allclose(together, [found(g, 3) for g in given], atol=1e-12)


def test_the_ridge_keeps_a_plan_where_several_cost_the_same() -> None:
    """Two MVs do the same: the sum is what counts, and the plan keeps their difference."""
    h = np.array([[1.0, 1.0], [1.0, 1.0]])
    z = found((h, np.array([0.4, 0.4]), np.array([0.5, -0.5]), -np.ones(2), np.ones(2)), 4)
    np.testing.assert_allclose([z.sum(), z[0] - z[1]], [0.4, 1.0], atol=0.02)


def test_what_would_have_no_effect_is_refused() -> None:
    with pytest.raises(ValueError, match="sweeps"):
        Predictive.Params(sweeps=8, operate={})
    with pytest.raises(ValueError, match="changes"):
        Predictive.Params(changes=3)
    assert Predictive.Params(changes=0, operate={}).changes == 0
    params = Predictive.Params(cv_low=(-0.5,), operate={"y0.low": -0.2})
    with pytest.raises(LawError, match="cv_low"):
        Predictive.check_settings(params, made_signals(1, 1))
