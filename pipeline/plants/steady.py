"""Steady states of a plant with one MV and one CV: every branch, where branches meet, and the plant near one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

CURVE_POINTS = 800  # points of the curve over the set point's range
STARTS = 60  # random starts for the first point of the curve


class SteadyStates:
    """Roots (x, mv) of [dx/dt; cv(x) - cv], with the controlled variable cv given.

    Solving for the MV at a given CV, and not the other way round, finds every branch of a plant
    with multiplicity: the steady MV is a function of the CV, while the converse need not hold.
    Each unknown is scaled by its signal's range, the derivative by range and period.
    """

    def __init__(
        self, rate: Callable[[Any, Any], Any], cv_of: Callable[[Any], Any], unknown: Sequence[Signal], cv_signal: Signal
    ) -> None:
        """``rate(x, mv)`` is dx/dt per period, ``cv_of(x)`` the CV; ``unknown``: the signals of x, then of the MV."""
        self.low = np.array([s.low for s in unknown])
        self.span = np.array([s.high - s.low for s in unknown])
        self.range = cv_signal
        z, cv = ca.SX.sym("z", len(unknown)), ca.SX.sym("cv")
        v = self.low + self.span * z
        x, mv = v[:-1], v[-1:]
        miss = (cv_of(x) - cv) / (self.range.high - self.range.low)
        balance = ca.vertcat(rate(x, mv) / self.span[:-1], miss)
        function = ca.Function("balance", [z, cv], [ca.densify(balance), ca.densify(ca.jacobian(balance, z))])
        n = len(unknown)
        self._z, self._cv = np.zeros(n), np.zeros(1)
        self._miss, self._slope = np.zeros(n), np.zeros((n, n), order="F")
        # CasADi's buffers skip its conversion of arguments, which takes far longer than these few sums.
        self._buffer: Any  # CasADi's types have other signatures than its buffers
        self._evaluate: Any
        self._buffer, self._evaluate = function.buffer()
        self._buffer.set_arg(0, self._z.data)
        self._buffer.set_arg(1, self._cv.data)
        self._buffer.set_res(0, self._miss.data)
        self._buffer.set_res(1, self._slope.T.data)

    def balance(self, z: Array, cv: float) -> tuple[Array, Array]:
        """[dx/dt; cv(x) - cv] and its Jacobian by the scaled unknowns z, shapes (n,) and (n, n)."""
        self._z[:], self._cv[0] = z, cv
        self._evaluate()
        return self._miss.copy(), self._slope.copy()

    def at(self, cv: float, guess: tuple[Array, float] | None) -> tuple[Array, float] | None:
        """(x, mv) of the steady state at ``cv`` found from a near one; None where none is found."""
        if guess is not None:
            start = (np.append(*guess) - self.low) / self.span
            root = self._newton(start, cv)
            root = self._robust(start, cv) if root is None else root
        else:
            starts = np.random.default_rng(0).uniform(0.02, 0.98, (STARTS, self.low.size))
            root = next((r for r in (self._robust(s, cv) for s in starts) if r is not None), None)
        if root is None:
            return None
        v = self.low + self.span * root
        return v[:-1], float(v[-1])

    def curve(self) -> tuple[Array, Array, Array]:
        """(cv (n,), x (n, n_x), mv (n,)) over the set point's range; each point starts from its neighbour."""
        rows: list[tuple[float, Array, float]] = []
        guess = None
        # From the top: where one end of the range has no steady state, the other end mostly has one.
        for cv in np.linspace(self.range.high, self.range.low, CURVE_POINTS + 2)[1:-1]:
            solved = self.at(float(cv), guess)
            if solved is not None:
                guess = solved
                rows.append((float(cv), *solved))
        rows.reverse()
        n_x = self.low.size - 1
        return (
            np.array([r[0] for r in rows]),
            np.array([r[1] for r in rows]).reshape(-1, n_x),
            np.array([r[2] for r in rows]),
        )

    def _newton(self, z: Array, cv: float) -> Array | None:
        for _ in range(12):
            miss, slope = self.balance(z, cv)
            try:
                step = np.linalg.solve(slope, miss)
            except np.linalg.LinAlgError:
                return None
            z = z - step
            size = np.max(np.abs(step))
            if not size < 1.0:  # NaN too
                return None
            if size < 1e-13:
                return z
        return None

    def _robust(self, z: Array, cv: float) -> Array | None:
        from scipy import optimize  # a quarter of a second to load, for whoever needs a plant's signals alone

        def balance(v: Array) -> Any:
            return self.balance(v, cv)

        with np.errstate(all="ignore"):
            found = optimize.root(balance, z, jac=True, method="hybr", tol=1e-13)
        solved = np.all(np.isfinite(found.x)) and np.max(np.abs(self.balance(found.x, cv)[0])) < 1e-9
        return np.asarray(found.x) if solved else None


@dataclass(frozen=True, slots=True, eq=False)
class Linearization:
    """Deviations from a steady state (x, mv), time in seconds whatever the plant is written in.

    d(dx)/dt = A dx + B dmv,    dpv = C dx
    """

    x: Array  # shape: (n_x,)
    mv: Array  # shape: (n_mv,)
    a: Array  # shape: (n_x, n_x), 1/s
    b: Array  # shape: (n_x, n_mv)
    c: Array  # shape: (n_pv, n_x)

    @property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of A [1/s], largest real part first."""
        values = np.linalg.eigvals(self.a).astype(np.complex128)
        order = np.lexsort((values.imag, -values.real))
        return np.asarray(values[order])

    def sampled(self, period_s: float) -> tuple[Array, Array]:
        """Zero-order-hold discretization (Phi, Gamma): x(k+1) = Phi x(k) + Gamma mv(k)."""
        from scipy import linalg  # loads for long, and most who import this room linearize nothing

        n, m = self.b.shape
        block = np.zeros((n + m, n + m))
        block[:n, :n], block[:n, n:] = self.a, self.b
        power = linalg.expm(block * period_s)
        return power[:n, :n], power[:n, n:]

    def sampled_zeros(self, period_s: float, pv: int = 0, mv: int = 0) -> NDArray[np.complex128]:
        """Zeros of the sampled transfer function from one MV to one PV, shape (n_zeros,).

        The exact one-step inverse puts a closed-loop eigenvalue on each of them.
        """
        from scipy import linalg

        phi, gamma = self.sampled(period_s)
        n = phi.shape[0]
        pencil = np.zeros((n + 1, n + 1))
        pencil[:n, :n], pencil[:n, n], pencil[n, :n] = phi, gamma[:, mv], self.c[pv]
        mass = np.zeros_like(pencil)
        mass[:n, :n] = np.eye(n)
        # In homogeneous form, because the pencil has infinite eigenvalues beside the zeros.
        alpha, beta = linalg.eigvals(pencil, mass, homogeneous_eigvals=True)
        finite = np.abs(beta) > 1e-8 * np.abs(alpha)
        return np.asarray(alpha[finite] / beta[finite], dtype=np.complex128)
