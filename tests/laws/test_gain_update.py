"""The closed form of the gain update against a bounded least-squares solver, and what PID gains mean."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from loopwright.pipeline.laws.gain_update import LONGEST_ACTION, PidForm, gain_update

LO, HI = np.array([0.0, 0.0, 0.0]), np.array([5.0, 2.0, 8.0])
W = np.array([1.0, 0.3, 2.0])


class Problem(NamedTuple):
    """Rows of problems; lambda is one number a row, to be drawn like the rest."""

    z_prev: np.ndarray  # (n, 3)
    rho: np.ndarray  # (n, 3)
    v: np.ndarray  # (n, 1)
    c: np.ndarray  # (n, 1)
    lam: np.ndarray  # (n, 1)

    def objective(self, z: np.ndarray) -> np.ndarray:
        miss = (self.rho * z).sum(axis=1) - self.v[:, 0]
        return 0.5 * self.c[:, 0] * miss**2 + 0.5 * self.lam[:, 0] * ((z - self.z_prev) ** 2 / W).sum(axis=1)

    def solved(self) -> np.ndarray:
        return gain_update(*map(torch.from_numpy, (*self, W, LO, HI, np.ones(1)))).numpy()


def drawn(n: int, seed: int) -> Problem:
    """Gains often at a bound, errors and moves of all sizes, and each error now and then zero."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(LO, HI, (n, 3))
    z = np.where(rng.random((n, 3)) < 0.2, LO, np.where(rng.random((n, 3)) < 0.2, HI, z))
    rho = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-3, 1.5, (n, 1)) * (rng.random((n, 3)) > 0.1)
    return Problem(
        z,
        rho,
        rng.normal(size=(n, 1)) * 10 ** rng.uniform(-3, 1, (n, 1)),
        10 ** rng.uniform(-4, 3, (n, 1)),
        10 ** rng.uniform(-5, 1, (n, 1)),
    )


def solver(p: Problem) -> np.ndarray:
    """Minimizers by scipy's bounded least squares, as scaled residuals."""
    best = np.empty_like(p.z_prev)
    for i, (z, rho, v, c, lam) in enumerate(zip(*p, strict=True)):
        root = np.sqrt(lam / W)
        a = np.vstack([np.sqrt(c) * rho, np.diag(root)])
        b = np.concatenate([np.sqrt(c) * v, root * z])
        best[i] = lsq_linear(a, b, (LO, HI), method="bvls", tol=1e-14).x
    return best


def test_equals_a_bounded_least_squares_solver() -> None:
    problem = drawn(10_000, 0)
    z = problem.solved()
    assert ((z >= LO) & (z <= HI)).all()
    ours, theirs = problem.objective(z), problem.objective(solver(problem))
    assert np.max((ours - theirs) / np.maximum(1, theirs)) < 1e-9
    assert np.mean((z <= LO) | (z >= HI)) > 0.2  # the bounds were really met
    assert np.mean(((z > LO) & (z < HI)).all(axis=1)) > 0.2


CORNERS = {
    "no error": {"rho": [0, 0, 0]},
    "one error": {"rho": [0, 1.5, 0]},
    "nothing to do": {"v": [1 * 0.5 + 0.5 * 1 - 0.3 * 2], "rho": [1, 1, -0.3], "z_prev": [0.5, 0.5, 2]},
    "all gains at their lower bound": {"z_prev": LO, "v": [-4]},
    "all gains at their upper bound": {"z_prev": HI, "v": [400]},
    "pushed off the bounds": {"z_prev": HI, "v": [-400]},
    "no slope": {"v": [0], "c": [1e-300]},
    "no curvature": {"c": [0]},
    "tiny c": {"c": [1e-12], "v": [1e6]},
    "large c": {"c": [1e9]},
    "huge errors": {"rho": [1e5, -3e5, 1e6], "v": [1e3]},
    "two gains break at once": {"rho": [1, 1, 1], "z_prev": [1, 1, 1], "v": [50], "c": [1]},
}


@pytest.mark.parametrize("name", CORNERS)
def test_corners(name: str) -> None:
    plain = {"z_prev": [1, 0.5, 2], "rho": [0.4, -1.1, 0.7], "v": [0.9], "c": [2], "lam": [0.01]}
    problem = Problem(*(np.array([v], dtype=float) for v in {**plain, **CORNERS[name]}.values()))
    z = problem.solved()
    assert np.isfinite(z).all()
    assert ((z >= LO) & (z <= HI)).all()
    ours, theirs = problem.objective(z), problem.objective(solver(problem))
    assert ours == pytest.approx(theirs, rel=1e-9, abs=1e-9)
    if name in {"no error", "nothing to do", "no slope", "no curvature"}:
        np.testing.assert_allclose(z, problem.z_prev, rtol=0, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_no_gain_can_be_moved_for_the_better(seed: int) -> None:
    """The conditions of Karush, Kuhn and Tucker, which no solver is needed for."""
    p = drawn(50, seed)
    z = p.solved()
    slope = p.c * p.rho * ((p.rho * z).sum(axis=1, keepdims=True) - p.v) + p.lam * (z - p.z_prev) / W
    terms = (np.abs(p.rho) * HI).sum(axis=1, keepdims=True) + np.abs(p.v)
    slack = 1e-12 * (p.c * np.abs(p.rho).max(axis=1, keepdims=True) * terms + p.lam * HI.max() / W.min())
    assert (slope <= slack)[z > LO].all()
    assert (slope >= -slack)[z < HI].all()


def test_stiffness_and_weights_decide_which_gain_gives_way() -> None:
    plain = {"z_prev": [1.0, 1.0, 1.0], "rho": [1.0, 1.0, 1.0], "v": [3.6], "c": [1.0], "lam": [1e-9]}
    z = Problem(*(np.array([v]) for v in plain.values())).solved()[0]
    assert z.sum() == pytest.approx(3.6)
    np.testing.assert_allclose((z - 1) / W, np.full(3, (z[0] - 1) / W[0]))
    stiff = Problem(*(np.array([v]) for v in {**plain, "lam": [1e9]}.values())).solved()[0]
    np.testing.assert_allclose(stiff, 1, atol=1e-6)


def test_candidates_broadcast() -> None:
    """Many wanted moves over one set of errors, as a search for the penalty asks for them."""
    p = drawn(4, 1)
    v, c = (np.repeat(a[:, None, :], 13, axis=1) * np.linspace(0.1, 2, 13)[:, None] for a in (p.v, p.c))
    fixed = [torch.from_numpy(a[:, None, :]) for a in (p.z_prev, p.rho)]
    rest = [torch.from_numpy(a) for a in (p.lam[:1], W, LO, HI, np.ones(1))]
    one = [rest[0][0], *rest[1:]]
    together = gain_update(*fixed, torch.from_numpy(v), torch.from_numpy(c), *rest)
    assert together.shape == (4, 13, 3)
    for i, j in itertools.product(range(4), range(13)):
        alone = gain_update(fixed[0][i, 0], fixed[1][i, 0], torch.from_numpy(v[i, j]), torch.from_numpy(c[i, j]), *one)
        torch.testing.assert_close(together[i, j], alone, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("index", range(3))
def test_nan_stays_nan(index: int) -> None:
    p = drawn(1, 2)
    p[1][0, index] = np.nan
    assert np.isnan(p.solved()).any()


@given(
    kc=st.floats(0.01, 5),
    tau_i=st.floats(20, 500),
    tau_d=st.floats(0.1, 60),
    e=st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_gains_are_the_pid_of_equation_4(kc: float, tau_i: float, tau_d: float, e: tuple[float, ...]) -> None:
    dt, unit = 15.0, -40.0
    k0 = kc * (1 + dt / (2 * tau_i) + tau_d / dt)
    k1 = -kc * (1 - dt / (2 * tau_i) + 2 * tau_d / dt)
    k2 = kc * tau_d / dt
    # The right inverse of equation 4, in the place of equation 25.
    assert (k0 - k1 - 3 * k2) / 2 == pytest.approx(kc)
    z = torch.tensor([(k0 - k1 - 3 * k2) / 2, k0 + k1 + k2, k2], dtype=torch.float64)
    rho = torch.tensor([e[0] - e[1], (e[0] + e[1]) / 2, e[0] - 2 * e[1] + e[2]], dtype=torch.float64)
    assert float(rho @ z) == pytest.approx(k0 * e[0] + k1 * e[1] + k2 * e[2], abs=1e-9)
    form = PidForm(dt, unit, HI)
    np.testing.assert_allclose(form(z).numpy(), [unit * kc, tau_i, tau_d], rtol=1e-9)


def test_times_stay_finite_without_an_action() -> None:
    z = torch.tensor([[0.0, 1.0, 2.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1e-20, 1e-21, 1e-25]], dtype=torch.float64)
    times = 2 * LONGEST_ACTION * np.array([[0, 1], [1, 0], [0, 0], [0, 0]])
    np.testing.assert_allclose(PidForm(2.0, 1.0, HI)(z)[:, 1:].numpy(), times, atol=1e-9)
