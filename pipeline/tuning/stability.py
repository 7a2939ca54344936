"""Is a law's closed loop stable? Its linear loops along the steady states, and quadratic Lyapunov functions of them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
import torch
from scipy import linalg
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.tuning.development import LawStep

STATE_REST_STEPS = 50  # steps at rest until a law's state no longer changes
BISECTIONS = 9  # of the contraction rate: to within 0.2 % of the way to 1
LARGEST_MARGIN = 100.0  # gain margin beyond which none is sought
CONTRACTION_ROUNDING = 1e-9  # a verified contraction this far below 1 counts as one


@dataclass(frozen=True, slots=True, eq=False)
class FrozenLoops:
    """A law's linear closed loops at g steady states, each as if the plant stayed there: z = [dx, dmv, dstate].

    At each steady state the plant is linearized and sampled with its MV held, and the law
    differentiated where it stands after some steps at rest. So the loops follow from the very
    module that is exported, whatever its form.
    """

    cv: Array  # (g,)
    phi: Array  # (g, n_x, n_x) the sampled plant
    gamma: Array  # (g, n_x, n_mv)
    law: Array  # (g, n_mv + n_state, n_x + n_mv + n_state) what the law makes of z

    @classmethod
    def of(cls, plant: EquationPlant, law: LawStep, n_state: int, cvs: Array) -> Self:
        """The loops of a law with ``n_state`` states over ``plant``, at controlled variables ``cvs`` (g,).

        Raises PlantError where there is no such steady state, LawError for a law that does not rest there.
        """
        points = [plant.steady_state_at(float(cv)) for cv in cvs]
        pv = torch.tensor(np.array([plant.measure(x) for x, _ in points]))
        mv = torch.tensor(np.array([u for _, u in points]))
        sp = pv[:, : len(plant.sp_signals)]
        dv = torch.from_numpy(np.tile(plant.dv_nominal, (len(cvs), 1)))
        state = torch.zeros(len(cvs), n_state, dtype=torch.float64)
        given = mv
        with torch.no_grad():
            for _ in range(STATE_REST_STEPS):
                given, state, _ = law(sp, pv, dv, mv, state)
        if not torch.allclose(given, mv, rtol=0, atol=1e-6 * float(mv.abs().max())):
            raise LawError("a law that moves its MV while on set point has no linear loop there: let it come to rest")

        def step(measured: Tensor, applied: Tensor, past: Tensor, r: Tensor, d: Tensor) -> Tensor:
            move, after, _ = law(r, measured, d, applied, past)
            return torch.cat([move, after])

        slopes = torch.func.vmap(torch.func.jacrev(step, argnums=(0, 1, 2)))(pv, mv, state, sp, dv)
        by_pv, by_mv, by_state = (s.detach().numpy() for s in slopes)
        lins = [plant.linearize(x, u) for x, u in points]
        sampled = [lin.sampled(plant.period_s) for lin in lins]
        by_x = by_pv @ np.array([lin.c for lin in lins])
        phi, gamma = (np.array(part) for part in zip(*sampled, strict=True))
        return cls(np.asarray(cvs, dtype=np.float64), phi, gamma, np.concatenate([by_x, by_mv, by_state], axis=2))

    def matrices(self, gain: float = 1.0) -> Array:
        """M (g, n, n) that takes z one period on, set point at rest, of a plant ``gain`` times as strong."""
        g, n_x, n_mv = self.gamma.shape
        n = self.law.shape[2]
        m = np.zeros((g, n, n))
        m[:, n_x:] = self.law
        m[:, :n_x] = gain * self.gamma @ self.law[:, :n_mv]
        m[:, :n_x, :n_x] += self.phi
        return m

    def gain_margin(self) -> float:
        """By how much the plant's gain may grow until one of the loops is no longer stable; ``LARGEST_MARGIN`` at most.

        0 where a loop is unstable as it is.
        """
        if not spectral_radius(self.matrices()).max() < 1:
            return 0.0
        gains = np.geomspace(1.0, LARGEST_MARGIN, 40)
        lost = next((i for i, k in enumerate(gains) if spectral_radius(self.matrices(float(k))).max() >= 1), None)
        if lost is None:
            return LARGEST_MARGIN
        low, high = float(gains[lost - 1]), float(gains[lost])
        for _ in range(12):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if spectral_radius(self.matrices(middle)).max() < 1 else (low, middle)
        return low


def spectral_radius(loops: Array) -> Array:
    """Largest size of an eigenvalue of each matrix, shape (g,), for matrices (g, n, n); below 1 is stable."""
    return np.asarray(np.abs(np.linalg.eigvals(loops)).max(axis=-1))


def feedback(loops: Array) -> Array:
    """The matrices (g, m, m) of the states that act on any other; the rest only watch, and are as stable as these."""
    keep = np.arange(loops.shape[1])
    while True:
        acts = np.abs(loops[:, keep][:, :, keep]).max(axis=(0, 1)) > 0
        if acts.all():
            return loops[:, keep][:, :, keep]
        keep = keep[acts]


def quadratic_contraction(loops: Array) -> float:
    """The rate r at which one quadratic function shrinks under every one of the matrices (g, n, n).

        find P > 0 with  M_k' P M_k <= r^2 P  for all k, r as small as a bisection finds it

    sqrt(x'Px) then shrinks by r a period however the loop changes among the M_k: a proof of stability
    for any course of the operating point over them, where r < 1. NaN where there is no such P.
    The solver's answer is not believed: the rate is computed anew from its P.

    Source: Boyd, El Ghaoui, Feron, Balakrishnan, Linear Matrix Inequalities in System and Control
    Theory, section 5.1; solved by Clarabel through CVXPY.
    """
    import cvxpy  # takes a second to load, which only the laws with such a proof should cost

    low, high = float(spectral_radius(loops).max()), 1.0
    if not low < 1:
        return float("nan")
    at = _balanced(loops, low)
    n = at.shape[1]
    p, rate = cvxpy.Variable((n, n), symmetric=True), cvxpy.Parameter(nonneg=True)
    constraints = [p >> np.eye(n), *(m.T @ p @ m << rate * p for m in at)]
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.trace(p)), constraints)
    best = float("nan")
    for trial in [1.0 - 1e-5, *([None] * BISECTIONS)]:
        r = 0.5 * (low + high) if trial is None else trial
        rate.value = r**2
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a solution may be inaccurate: it is checked below
            try:
                problem.solve(solver=cvxpy.CLARABEL)
                reached = float("nan") if p.value is None else _rate(at, np.asarray(p.value))
            except cvxpy.SolverError:
                reached = float("nan")
        if reached < 1 - CONTRACTION_ROUNDING:
            best = reached if np.isnan(best) else min(best, reached)
            high = min(r, reached)
        elif trial is None:
            low = r
        else:
            break
    return best


def pairwise_contraction(loops: Array, at: Array, points: Sequence[float]) -> Array:
    """``quadratic_contraction`` between each two neighbouring points, shape (len(points) - 1,).

    ``loops`` (g, n, n) belong to the operating points ``at`` (g,); those from one point to the next,
    both included, share a function. Raises LawError where a pair has fewer than two loops.
    """
    rates = []
    for low, high in pairwise(sorted(points)):
        inside = (at >= low - 1e-12) & (at <= high + 1e-12)
        if inside.sum() < 2:
            raise LawError(f"between {low:g} and {high:g} lie {inside.sum()} linear loops; a pair needs its two ends")
        rates.append(quadratic_contraction(loops[inside]))
    return np.array(rates)


def _balanced(loops: Array, radius: float) -> Array:
    """The matrices in coordinates in which the middle one shrinks the plain norm, so that the solver sees like sizes.

    Rows and columns are first scaled to like sizes; then P0 of M' P0 M - r0^2 P0 = -I, with r0 half
    way from the largest radius to 1, gives the coordinates sqrt(P0).
    """
    small = feedback(loops)
    middle = small[len(small) // 2]
    _, scale = linalg.matrix_balance(middle, permute=False)
    small = np.linalg.inv(scale) @ small @ scale
    shrunk = small[len(small) // 2] / (0.5 * (1 + radius))
    root = np.linalg.cholesky(linalg.solve_discrete_lyapunov(shrunk.T, np.eye(len(shrunk)))).T
    return np.asarray(root @ small @ np.linalg.inv(root))


def _rate(loops: Array, p: Array) -> float:
    """The rate at which sqrt(x'Px) really shrinks; NaN where P is not positive definite."""
    try:
        root = np.linalg.cholesky(0.5 * (p + p.T)).T
    except np.linalg.LinAlgError:
        return float("nan")
    return float(np.linalg.norm(root @ loops @ np.linalg.inv(root), ord=2, axis=(-2, -1)).max())
