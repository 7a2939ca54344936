"""Steady states of a plant with one MV and one CV: every branch, and where branches meet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from loopwright.pipeline.plants.simulator import Array
from loopwright.serving.manifest import Signal

GRID = 800  # points of the curve over the set point's range
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
        for cv in np.linspace(self.range.high, self.range.low, GRID + 2)[1:-1]:
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
