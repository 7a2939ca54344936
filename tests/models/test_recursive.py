"""Recursive least squares against the batch problems that it solves."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.lagged.recursive_arx import RecursiveLeastSquares


def drawn(seed: int, rows: int, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=(rows, n))
    return torch.from_numpy(phi), torch.from_numpy(phi @ rng.normal(size=n) + 0.3 * rng.normal(size=rows))


def weighted_least_squares(
    phi: torch.Tensor, y: torch.Tensor, f: float, theta0: torch.Tensor, p0: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """argmin sum_k f^(N-k) (y_k - phi_k' theta)^2 + f^N |theta - theta0|^2 / p0, and the inverse of its Hessian."""
    rows, n = phi.shape
    weight = torch.tensor([f ** (rows - 1 - k) for k in range(rows)], dtype=torch.float64)
    hessian = (phi * weight[:, None]).T @ phi + f**rows / p0 * torch.eye(n, dtype=torch.float64)
    return torch.linalg.solve(hessian, (phi * weight[:, None]).T @ y + f**rows / p0 * theta0), hessian.inverse()


@given(
    seed=st.integers(0, 10**6), n=st.integers(1, 6), rows=st.integers(1, 40), f=st.sampled_from([1.0, 0.98, 0.8, 0.5])
)
@settings(max_examples=25, deadline=None)
def test_solves_the_weighted_least_squares_with_its_prior(seed: int, n: int, rows: int, f: float) -> None:
    phi, y = drawn(seed, rows, n)
    theta0, p0 = torch.from_numpy(np.random.default_rng(seed + 1).normal(size=n)), 7.0
    rls = RecursiveLeastSquares(f)
    predicted, theta, root = rls.run(phi, y, theta0, rls.start(n, p0))
    wanted, covariance = weighted_least_squares(phi, y, f, theta0, p0)
    torch.testing.assert_close(theta, wanted, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(root @ root.T, covariance, rtol=1e-9, atol=1e-9 * float(covariance.abs().max()))
    before, _ = weighted_least_squares(phi[:-1], y[:-1], f, theta0, p0)
    torch.testing.assert_close(predicted[-1], phi[-1] @ before, rtol=1e-9, atol=1e-9)


def test_a_batch_equals_its_rows() -> None:
    rls = RecursiveLeastSquares(0.9, largest=5.0)
    phi, y = drawn(0, 12, 3)
    theta, root = torch.zeros(4, 3, dtype=torch.float64), rls.start(3).expand(4, 3, 3)
    for k in range(3):
        rows = slice(4 * k, 4 * k + 4)
        theta, root, _ = rls(theta, root, phi[rows], y[rows, None])
    for i in range(4):
        _, alone, _ = rls.run(phi[i::4], y[i::4], torch.zeros(3, dtype=torch.float64), rls.start(3))
        torch.testing.assert_close(theta[i], alone, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("f", [0.45, 0.5, 0.8, 0.95, 0.99])
def test_without_excitation_the_covariance_settles_on_its_bound(f: float) -> None:
    """At rest one direction only is excited: the others go to the bound, that one keeps its own equilibrium."""
    bound = 4.0
    rls = RecursiveLeastSquares(f, bound)
    phi = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    theta, root = torch.zeros(3, dtype=torch.float64), rls.start(3, 0.01)
    for _ in range(3_000):
        theta, root, _ = rls(theta, root, phi, torch.ones(1, dtype=torch.float64))
    values = torch.linalg.eigvalsh(root @ root.T)
    torch.testing.assert_close(values[1:], torch.full((2,), bound, dtype=torch.float64), rtol=1e-6, atol=0)
    # 1/P = f/P + 1 at rest, up to what the bound adds
    assert 0.5 * (1 - f) < values[0] < 1 - f + 1e-9
    assert float(phi @ theta) == pytest.approx(1.0, abs=1e-6)


@given(seed=st.integers(0, 10**6), f=st.floats(0.45, 1.0), size=st.sampled_from([1e-3, 1.0, 1e6]))
@settings(max_examples=20, deadline=None)
def test_covariance_stays_within_its_bound_whatever_comes(seed: int, f: float, size: float) -> None:
    rls = RecursiveLeastSquares(f, largest=100.0)
    phi, y = drawn(seed, 200, 4)
    phi = size * torch.cat([phi[:100], phi[:1].expand(100, 4)])  # then nothing new
    _, theta, root = rls.run(phi, y, torch.zeros(4, dtype=torch.float64), rls.start(4))
    assert torch.isfinite(theta).all()
    assert float(torch.linalg.svdvals(root).max()) ** 2 <= 100.0 * (1 + 1e-12)


def test_follows_a_change_after_a_long_rest() -> None:
    """Neither blown up nor asleep: 2,000 samples without news, then other parameters are learnt at once."""
    rls = RecursiveLeastSquares(0.95, largest=10.0)
    rest = torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64)
    theta, root = torch.tensor([0.9, 0.1, 0.0], dtype=torch.float64), rls.start(3, 0.1)
    for _ in range(2_000):
        theta, root, _ = rls(theta, root, rest, (rest * theta).sum()[None])
    new = torch.tensor([0.6, -0.4, 0.7], dtype=torch.float64)
    phi, _ = drawn(3, 80, 3)
    _, theta, _ = rls.run(phi, phi @ new, theta, root)
    torch.testing.assert_close(theta, new, rtol=0, atol=0.02)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"forgetting": 0.0}, "forgetting factor is 0.0"),
        ({"forgetting": 1.1}, "forgetting factor is 1.1"),
        ({"forgetting": 0.3, "largest": 1.0}, "0.45 or above"),
        ({"forgetting": 0.9, "largest": 0.0}, "largest covariance is 0.0"),
    ],
)
def test_wrong_numbers_are_named(options: dict[str, float], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        RecursiveLeastSquares(**options)


def test_the_first_covariance_is_within_the_bound() -> None:
    with pytest.raises(ModelError, match="first covariance is 3"):
        RecursiveLeastSquares(0.9, 2.0).start(3, 3.0)
    with pytest.raises(ModelError, match="first covariance is None"):
        RecursiveLeastSquares(0.9).start(3)
