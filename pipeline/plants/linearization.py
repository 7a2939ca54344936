"""A plant near one steady state: continuous and sampled linear models, poles and zeros."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.plants.simulator import Array


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
