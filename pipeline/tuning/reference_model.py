"""Reference models: how a controlled variable should follow its set point, optimal by ITAE."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.plants.steady import Linearization

ORDERS = range(1, 7)
# D. Graham, R. C. Lathrop, The synthesis of "optimum" transient response, AIEE Transactions 72, 1953.
CLASSIC: dict[int, tuple[float, ...]] = {
    1: (),
    2: (1.4,),
    3: (1.75, 2.15),
    4: (2.1, 3.4, 2.7),
    5: (2.8, 5.0, 5.5, 3.4),
    6: (3.25, 6.6, 8.6, 7.45, 3.95),
}
"""Coefficients of s^(n-1)..s^1 of the tables in use, found on an analogue computer."""
ITAE_GRID = 0.01  # of the time wn t over which the ITAE is integrated
GRID_DOUBLINGS = 13  # of the grid: 8192 points, up to wn t = 82
DECIMALS = 4  # of a coefficient: far finer than the criterion tells apart, coarser than a search's last bits


@dataclass(frozen=True, slots=True)
class ReferenceModel:
    """All-pole model of unit gain from a set point r to the course y that the CV should take.

        M(s) = wn^n / (s^n + d_{n-1} wn s^(n-1) + ... + d_1 wn^(n-1) s + wn^n)

    Its state is x_i = y^(i-1) / wn^(i-1), i = 1..n, in the unit of the set point: at rest at a level
    it is (level, 0, .., 0).

    ``order`` is n >= 1, ``coefficients`` d_{n-1} .. d_1 for s^(n-1) .. s^1 [-], ``wn`` the natural frequency
    [rad/s]. Raises ValueError where they make no model, or one with poles that are not stable.

    Source: [reference_ann, eq. 7 and 8].
    """

    order: int
    coefficients: tuple[float, ...]
    wn: float = 1.0

    def __post_init__(self) -> None:
        if self.order < 1 or len(self.coefficients) != self.order - 1:
            raise ValueError(
                f"a reference model of order {self.order} has {len(self.coefficients)} coefficients; "
                "give an order of at least 1 and one coefficient fewer than it"
            )
        if not (math.isfinite(self.wn) and self.wn > 0):
            raise ValueError(f"the natural frequency of a reference model is {self.wn} rad/s; it must be above 0")
        if not _stable(np.array(self.coefficients)):
            raise ValueError(
                f"a reference model with coefficients {self.coefficients} of s^{self.order - 1}..s^1 is not stable; "
                "give a polynomial whose roots all have a negative real part"
            )

    @classmethod
    def optimal(cls, order: int, wn: float = 1.0) -> Self:
        """The model of least ITAE that the search finds for this order; quick, and the same every time."""
        return cls(order, searched(order), wn)

    @classmethod
    def classic(cls, order: int, wn: float = 1.0) -> Self:
        """The model of the classic table; raises ValueError beyond order 6."""
        if order not in CLASSIC:
            raise ValueError(f"the classic table has no order {order}; it has 1 to {max(CLASSIC)}")
        return cls(order, CLASSIC[order], wn)

    def continuous(self) -> Linearization:
        """A (n, n) and B (n, 1) [1/s], and C (1, n), of dx/dt = A x + B r, y = C x = x_1."""
        return _chain(np.array(self.coefficients), self.wn)

    def sampled(self, period_s: float) -> tuple[Array, Array]:
        """(phi (n, n), gamma (n, 1)) of x(k+1) = phi x(k) + gamma r(k), the set point r held over each period."""
        return self.continuous().sampled(period_s)

    def response(self, levels: ArrayLike, period_s: float) -> Array:
        """The course y, shape (n, 1), for the set points r, (n,) or (n, 1), from rest at the first of them."""
        r = np.asarray(levels, dtype=np.float64).reshape(-1)
        phi, gamma = self.sampled(period_s)
        x = np.zeros(self.order)
        x[0] = r[0]
        y = np.empty((len(r), 1))
        for k, level in enumerate(r):
            y[k] = x[0]
            x = phi @ x + gamma[:, 0] * level
        return y

    def itae(self) -> float:
        """ITAE of a unit step, integral of t |1 - y(t)| dt, with time counted in 1/wn."""
        return itae(np.array(self.coefficients))


def itae(coefficients: Array) -> float:
    """ITAE of a unit step for d_{n-1} .. d_1 at wn = 1, to about 1e-5; inf where the model is not stable.

    By the trapezoidal rule; where f = t (1 - y) changes its sign between two points, |f| is that of a straight
    line: the ITAE then stays smooth in the coefficients, and a search finds its bottom.
    """
    if not _stable(coefficients):
        return math.inf
    phi, _ = _chain(coefficients).sampled(ITAE_GRID)
    # The error's own state starts at (1, 0, .., 0) and decays: x(k) = phi^k x(0), twice as many points a pass.
    x = np.zeros((len(phi), 1))
    x[0] = 1.0
    for _ in range(GRID_DOUBLINGS):
        x = np.hstack([x, phi @ x])
        phi = phi @ phi
    times: Array = ITAE_GRID * np.arange(x.shape[1], dtype=np.float64)
    f = times * x[0]
    size = np.abs(f)
    crossed = np.flatnonzero(f[:-1] * f[1:] < 0)
    excess = size[crossed] * size[crossed + 1] / (size[crossed] + size[crossed + 1])
    return float(ITAE_GRID * (size.sum() - (size[0] + size[-1]) / 2 - excess.sum()))


@cache
def searched(order: int, seed: int = 0, neighbours: int = 400) -> tuple[float, ...]:
    """Coefficients d_{n-1} .. d_1 of least ITAE, rounded to ``DECIMALS``.

    Random neighbourhood search from the binomial polynomial (s + 1)^n: of polynomials drawn near the
    best one so far, a better one takes its place; the neighbourhood widens after a success and shrinks
    after failures. It comes close, and a Nelder-Mead simplex goes the rest of the way, which from
    order 6 on the search alone does not. Raises ValueError for an order below 1.

    Source: [reference_ann, section on optimal models] (the search).
    """
    if order < 1:
        raise ValueError(f"the order of a reference model is {order}; it must be at least 1")
    if order == 1:
        return ()
    rng = np.random.default_rng(seed)
    best = np.array([math.comb(order, i) for i in range(1, order)], dtype=np.float64)
    least, width = itae(best), 0.2
    for _ in range(neighbours):
        trial = best * np.exp(width * rng.standard_normal(order - 1))
        cost = itae(trial)
        if cost < least:
            best, least, width = trial, cost, min(1.5 * width, 0.5)
        else:
            width = max(0.95 * width, 1e-3)
    from scipy.optimize import minimize  # loads for long, for whoever only reads what a law's parameters are

    polished = minimize(itae, best, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12, "maxiter": 2_000})
    return tuple(round(float(v), DECIMALS) for v in polished.x)


def _stable(coefficients: Array) -> bool:
    return bool(np.all(np.roots([1.0, *coefficients, 1.0]).real < 0))


def _chain(coefficients: Array, wn: float = 1.0) -> Linearization:
    """The chain of integrators y, dy/dt / wn, .. from r to y."""
    n = len(coefficients) + 1
    a = np.diag(np.ones(n - 1), 1)
    a[-1] = [-1.0, *(-d for d in coefficients[::-1])]
    return Linearization(np.zeros(n), np.zeros(1), wn * a, wn * np.eye(n)[:, -1:], np.eye(n)[:1])
