"""Is a law's closed loop stable? Linear loops along the steady states, Lyapunov functions, and loops from anywhere."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import linalg
from torch import Tensor

from loopwright.pipeline.errors import LawError, PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.tuning.loop_search import BatchLoops, LawStep

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


# --------------------------------------- closed loops from anywhere until they hold their set points, many side by side
CHECK = 25  # samples between two looks at who has arrived


@dataclass(frozen=True, slots=True, eq=False)
class Starts:
    """Where loops begin: states, set points and MVs, a row each."""

    x: Array  # (n, n_x)
    sp: Array  # (n, n_sp)
    mv: Array  # (n, n_mv) applied before the first sample

    def __post_init__(self) -> None:
        if not len(self.x) == len(self.sp) == len(self.mv) or not len(self.x):
            raise PlantError(
                f"starts have {len(self.x)} states, {len(self.sp)} set points and {len(self.mv)} MVs; one of each"
            )

    def batches(self, size: int) -> list[Starts]:
        """The same starts, so many at a time."""
        places = [slice(i, i + size) for i in range(0, len(self.x), size)]
        return [Starts(self.x[at], self.sp[at], self.mv[at]) for at in places]


@dataclass(frozen=True, slots=True, eq=False)
class Recovery:
    """How loops ended."""

    arrived: NDArray[np.bool_]  # (n,) within the band for the whole of the holding time
    samples: Array  # (n,) from the start until the band was entered for good; all of them where not arrived
    end: Array  # (n, n_x) last state seen
    courses: Array  # (watched, samples / every, n_x) of the first loops; NaN after they arrived

    @classmethod
    def together(cls, batches: Sequence[Recovery]) -> Self:
        """The loops of several batches as one."""
        return cls(*(np.concatenate([getattr(batch, f.name) for batch in batches]) for f in fields(cls)))


def recover(
    plant: Simulator,
    law: LawStep,
    n_state: int,
    starts: Starts,
    *,
    samples: int,
    band: float,
    holding: int,
    watched: int = 0,
    every: int = 5,
) -> Recovery:
    """Run a law from many starts, all in one batch, without noise, until they hold their set points.

    A loop has arrived when its controlled variable stays within ``band`` [CV] of the set point for
    ``holding`` samples, and is then no longer simulated: a linear loop's stability says the rest.
    A loop that has not arrived after ``samples`` counts as lost. The first ``watched`` loops keep their
    courses, one state in ``every``. A state that is not finite never arrives.
    """
    n, n_x = starts.x.shape
    arrived, taken, end = np.zeros(n, dtype=bool), np.full(n, float(samples)), starts.x.copy()
    courses = np.full((watched, -(-samples // every), n_x), np.nan)
    at, sp, inside = np.arange(n), torch.from_numpy(starts.sp), np.zeros(n)  # of the loops that still run
    loops = BatchLoops(plant, law, n_state, (n,), starts.x.copy(), starts.mv)
    for k in range(samples):
        if k % every == 0:
            courses[at[at < watched], k // every] = loops.x[at < watched]
        pv = loops.measured()
        inside = np.where(np.abs(pv[:, 0] - sp[:, 0].numpy()) <= band, inside + 1, 0)
        done = inside >= holding
        if k % CHECK == 0 and done.any():
            arrived[at[done]], taken[at[done]] = True, k + 1 - inside[done]
            end[at[done]] = loops.x[done]
            stay = ~done & np.isfinite(loops.x).all(axis=1)
            at, sp, inside, pv = at[stay], sp[stay], inside[stay], pv[stay]
            loops.keep(stay)
            if not len(at):
                break
        loops.step(sp, pv)
    end[at] = loops.x
    return Recovery(arrived, taken, end, courses)


def other_rests(plant: EquationPlant, samples: int = 1_500, moving: float = 1e-9) -> Array:
    """States (n, n_x) at which the plant rests, the MV at one of its ends, outside the range of its set point.

    They are looked for from the corners of the states' ranges: a reactor that has gone out, or run away. Empty
    where the plant has none.
    """
    low, high = (np.array([getattr(s, end) for s in plant.state_signals]) for end in ("low", "high"))
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(len(low), -1).T
    sp, mv = plant.sp_signals[0], plant.mv_signals[0]
    rests: list[Array] = []
    advance = plant.many(len(corners))
    for end in (mv.low, mv.high):
        x, before = corners, corners
        for _ in range(samples):
            before, x = x, advance(x, np.full((len(x), 1), end))
        cv = plant.measured(x)[:, 0]
        still = np.isfinite(x).all(axis=1) & (np.abs(x - before).max(axis=1) <= moving * np.abs(x).max(axis=1))
        for state in x[still & ~((cv >= sp.low) & (cv <= sp.high))]:
            if all(np.abs(state - known).max() > 1e-6 * np.abs(state).max() for known in rests):
                rests.append(state)
    return np.array(rests).reshape(-1, len(low))
