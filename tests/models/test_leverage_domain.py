"""The leverage domain against its definition and against linear regression."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models import load_model
from loopwright.pipeline.models.static.leverage_domain import LeverageDomain

seeds = st.integers(0, 10_000)
factors = st.floats(1.0, 50.0)


def data(seed: int, k: int = 200, n: int = 3) -> np.ndarray:
    """Correlated data with columns of very different size and place, as engineering units are."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(k, n)) @ rng.normal(size=(n, n))
    return mixed * 10.0 ** rng.uniform(-4, 4, n) + rng.normal(size=n) * 10.0 ** rng.uniform(-2, 3, n)


def textbook_leverage(u: np.ndarray, at: np.ndarray) -> np.ndarray:
    """z' (sum z z')^-1 z in extended precision from orthonormal columns: the definition itself."""
    z = np.column_stack([np.ones(len(u)), u])
    scale = np.abs(z).max(axis=0)
    r = np.linalg.qr(z / scale, mode="r")
    t = np.linalg.solve(r.T, (np.column_stack([np.ones(len(at)), at]) / scale).T)
    return (t**2).sum(axis=0)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_leverage_is_the_hat_matrix_diagonal(seed: int) -> None:
    u = data(seed)
    h = LeverageDomain.fit(u)(torch.from_numpy(u))[:, 0].numpy()
    np.testing.assert_allclose(h, textbook_leverage(u, u), rtol=1e-6, atol=1e-9)
    # The trace of a projection is its rank, so h* is three times the mean leverage.
    assert h.sum() == pytest.approx(4, rel=1e-8)
    assert LeverageDomain.fit(u).threshold.item() == pytest.approx(3 * h.mean(), rel=1e-8)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_bounds_lie_on_the_threshold_and_the_centre_on_the_regression(seed: int) -> None:
    u = data(seed)
    domain = LeverageDomain.fit(u)
    x = torch.from_numpy(u[:20, :-1])
    at = domain.interval(x)
    inside = at.room[:, 0] > 0
    assert inside.any()
    for w in domain.bounds(at, torch.zeros(20, 1, dtype=torch.float64)):
        h = domain(torch.cat([x, w], dim=-1))
        torch.testing.assert_close(h[inside], domain.threshold.expand(int(inside.sum()), 1), rtol=1e-9, atol=0)
    centred = (u[:, :-1] - u[:, :-1].mean(0)) / u[:, :-1].std(0)
    coefficient = np.linalg.lstsq(np.column_stack([np.ones(len(u)), centred]), u[:, -1], rcond=None)[0]
    predicted = np.column_stack([np.ones(20), centred[:20]]) @ coefficient
    np.testing.assert_allclose(at.centre[:, 0].numpy(), predicted, rtol=1e-8, atol=1e-9 * u[:, -1].std())


@given(seeds, factors)
@settings(max_examples=25, deadline=None)
def test_narrowing_is_equations_18_and_19(seed: int, r: float) -> None:
    u = data(seed)
    domain = LeverageDomain.fit(u)
    at = domain.interval(torch.from_numpy(u[:5, :-1]))
    y = at.centre  # so that states outside the domain agree too
    wide, narrow = domain.bounds(at, y), domain.bounds(at, y, r)
    low, high = (w.numpy() for w in wide)
    expected = ((r + 1) * low + (r - 1) * high) / (2 * r), ((r + 1) * high + (r - 1) * low) / (2 * r)
    tolerance = 1e-12 * float(np.abs(u[:, -1]).max())
    for got, want in zip(narrow, expected, strict=True):
        np.testing.assert_allclose(got.numpy(), want, rtol=1e-12, atol=tolerance)
    assert (narrow[0] >= wide[0] - tolerance).all()
    assert (narrow[1] <= wide[1] + tolerance).all()


def test_narrowing_by_one_is_the_identity_and_by_much_the_centre() -> None:
    domain = LeverageDomain.fit(data(1))
    at = domain.interval(domain.mean_x)
    w_min, w_max = domain.bounds(at, at.centre)
    same = domain.bounds(at, at.centre, 1.0)
    assert torch.equal(w_min, same[0])
    assert torch.equal(w_max, same[1])
    narrow = domain.bounds(at, at.centre, 1e12)
    torch.testing.assert_close(narrow[0], at.centre, rtol=1e-9, atol=0)
    torch.testing.assert_close(narrow[1], at.centre, rtol=1e-9, atol=0)


def test_bounds_are_the_output_where_the_state_is_outside() -> None:
    u = data(2)
    domain = LeverageDomain.fit(u)
    far = domain.mean_x + 1e3 * torch.from_numpy(u[:, :-1].std(axis=0))
    at = domain.interval(far)
    y = torch.tensor([0.25], dtype=torch.float64)
    assert at.room.item() < 0
    assert [w.item() for w in domain.bounds(at, y, 2.0)] == [0.25, 0.25]


@given(seeds, st.floats(-3, 3), st.floats(-3, 3))
@settings(max_examples=25, deadline=None)
def test_leverage_does_not_depend_on_units(seed: int, log_factor: float, shift: float) -> None:
    u = data(seed)
    moved = u * 10.0**log_factor + shift * u.std(axis=0)
    before = LeverageDomain.fit(u)(torch.from_numpy(u))
    after = LeverageDomain.fit(moved)(torch.from_numpy(moved))
    torch.testing.assert_close(after, before, rtol=1e-5, atol=1e-8)


def test_domain_survives_its_file(tmp_path) -> None:
    domain = LeverageDomain.fit(data(3))
    domain.save(tmp_path / "domain.npz")
    again = load_model(tmp_path / "domain.npz")
    assert isinstance(again, LeverageDomain)
    u = torch.from_numpy(data(4))
    assert torch.equal(again(u), domain(u))


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (lambda u: u[:4], "more than 4 rows"),
        (lambda u: np.where(np.arange(len(u))[:, None] == 7, np.nan, u), "row 7, column 0"),
        (lambda u: np.column_stack([u[:, 0], np.full(len(u), 3.0), u[:, 2]]), "column 1 .* constant at 3"),
        (lambda u: np.column_stack([u[:, 0], u[:, 1], 2 * u[:, 0] - u[:, 1]]), "column 2 .* linear function"),
        (lambda u: u[:, 0], "shape"),
    ],
)
def test_unusable_data_are_named(broken, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        LeverageDomain.fit(broken(np.random.default_rng(0).normal(size=(50, 3))))
