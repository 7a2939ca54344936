"""A linearized plant as tuning rules want it: without states that do not count, or as a lag with dead time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from pipeline.errors import LawError
from pipeline.plants.linearization import Linearization

# Singular values of the Hankel matrix below this share of the largest are rounding.
RANK = 1e-8
# A largest one below this share of |C| |B| is nothing at all.
NOTHING = 1e-14


def minimal(lin: Linearization, pv: int = 0, mv: int = 0) -> Linearization:
    """From one MV to one PV, with the states alone that both see: a linearization of least order.

    The Markov parameters h_k = C A^k B fill the Hankel matrix H_ij = h_(i+j), whose rank is the
    least order; with its singular value decomposition U S V' a realization of that order is

        A = S^-1/2 U' H' V S^-1/2,   B = S^1/2 V' e_1,   C = e_1' U S^1/2,   H'_ij = h_(i+j+1)

    They do not depend on the units of the states. Time is counted in units of the fastest mode.
    A linearization that is of least order comes back as it is, but for the other PVs and MVs.

    Raises LawError where the MV does not act on the PV.

    Source: Ho and Kalman, Regelungstechnik 14 (1966), 545.
    """
    b, c, n = lin.b[:, mv : mv + 1], lin.c[pv : pv + 1], len(lin.a)
    rate = float(np.abs(np.linalg.eigvals(lin.a)).max()) or 1.0
    unit_a = lin.a / rate
    markov = np.array([float((c @ np.linalg.matrix_power(unit_a, k) @ b)[0, 0]) for k in range(2 * n)])
    at = np.arange(n)[:, None] + np.arange(n)
    u, s, vt = np.linalg.svd(markov[at])
    if not s[0] > NOTHING * float(np.linalg.norm(c) * np.linalg.norm(b)):
        raise LawError("the MV does not act on the controlled variable of the linearized plant; check the pairing")
    order = int((s > RANK * s[0]).sum())
    if order == n:
        return Linearization(lin.x, lin.mv, lin.a, b, c)
    root = np.sqrt(s[:order])
    left, right = u[:, :order] / root, vt[:order].T / root
    return Linearization(
        np.zeros(order),
        lin.mv,
        rate * (left.T @ markov[at + 1] @ right),
        (root * vt[:order, 0])[:, None],
        (u[0, :order] * root)[None, :],
    )


@dataclass(frozen=True, slots=True)
class LagWithDeadTime:
    """The transfer function k exp(-theta s) / (tau s + 1)."""

    gain: float  # k [pv/mv]
    tau_s: float
    dead_time_s: float

    @classmethod
    def of(cls, lin: Linearization, pv: int = 0, mv: int = 0) -> Self:
        """The lag whose impulse response has the area, the mean and the variance of the plant's.

            k = G(0),   theta + tau = -G'(0)/G(0),   tau^2 = G''(0)/G(0) - (theta + tau)^2

        Exact for a lag; never a negative dead time. Raises LawError for an unstable plant, and for
        one whose impulse response has no variance above 0 (it oscillates or changes its sign).

        Source: Astrom and Hagglund, Advanced PID Control, section 2.4 (method of moments).
        """
        small = minimal(lin, pv, mv)
        worst = float(small.eigenvalues[0].real)
        if worst >= 0:
            raise LawError(
                f"a lag with dead time needs a stable plant; this one has a pole at {worst:.3g} 1/s here: choose "
                "another operating_cv, or tuning `imc`"
            )
        # G(s) = C (s I - A)^-1 B and its derivatives at s = 0
        first = np.linalg.solve(small.a, small.b)
        second = np.linalg.solve(small.a, first)
        third = np.linalg.solve(small.a, second)
        gain, slope, bend = (float((small.c @ v)[0, 0]) for v in (-first, -second, -2 * third))
        mean = -slope / gain if gain else float("nan")
        variance = bend / gain - mean**2 if gain else float("nan")
        if not (variance > 0 and mean > 0):
            raise LawError(
                f"no lag with dead time has this plant's moments (gain {gain:.3g}, mean {mean:.3g} s, variance "
                f"{variance:.3g} s2); choose tuning `optimized` or `manual`"
            )
        tau = min(float(np.sqrt(variance)), mean)
        return cls(gain, tau, mean - tau)
