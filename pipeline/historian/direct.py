"""How a PV answers to an input, read from one-step predictions: right in a closed loop too, and honest about doubt.

A free run under feedback can take the controller, read backwards, for the plant: PV = set point - MV / Kc. A one-step
prediction that knows the PV's own past cannot, because what the controller made of that past tells it nothing new:
only moves of the MV that do not come from the PV do (set points, steps by hand, another loop). Where there are none,
the coefficients are free, and so is the sign.

Source: L. Ljung, System Identification: Theory for the User, 2nd ed., 1999, chapter 13 (the direct method).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.linear import Blocks, blocks_of
from loopwright.pipeline.metrics import Array

FINE = 6  # lags with a coefficient of their own; later ones share one
WIDER = 1.5  # a block over the one before
LONGEST, SHORTEST = 160, 10  # lags
ROWS_A_COEFFICIENT = 6
SCORES = 40  # parts of the rows whose sums say how far the coefficients may be off
FLAT = 1e-12  # eigenvalue of the regressors' covariance, over the largest, below which a direction never moved
DRAWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class DirectModel:
    """y(k+1) = sum_b a_b mean(y over block b) + sum_j sum_b b_jb mean(u_j over block b) + c + e(k+1), least squares.

    ``theta`` (p,) and its covariance (p, p) hold the blocks of y, then those of each input, then c. The covariance is
    that of white residuals and that of sums over neighbouring rows together; a direction in which the regressors never
    moved is as free as noise leaves it.
    """

    theta: Array
    covariance: Array
    blocks: Blocks
    inputs: int
    sd: float  # of e
    rows: int

    @classmethod
    def of(cls, y: Array, u: Array, run: NDArray[np.int64], longest: int = 40) -> DirectModel | None:
        """Fit to a PV y (n,) and its inputs u (n, m), with lags up to ``longest`` rows; None where rows are too few."""
        longest = min(max(longest, SHORTEST), LONGEST)
        while True:
            blocks = blocks_to(longest)
            k = np.arange(longest, len(y) - 1)
            k = k[run[k - longest] == run[k + 1]]
            if len(k) >= ROWS_A_COEFFICIENT * (len(blocks) * (1 + u.shape[1]) + 1):
                break
            if longest <= SHORTEST:
                return None
            longest = max(longest // 2, SHORTEST)
        columns = [blocks_of(c - c.mean(), k, blocks) for c in (y, *u.T)]
        x = np.column_stack([*columns, np.ones(len(k))])
        target = y[k + 1] - y.mean()
        scale = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
        z, n = x / scale, len(k)
        values, vectors = np.linalg.eigh(z.T @ z / n)
        least = FLAT * values[-1]
        moved = values > least
        known, lost = vectors[:, moved], vectors[:, ~moved]
        inverse = (known / values[moved]) @ known.T
        theta = inverse @ (z.T @ target / n)
        e = target - z @ theta
        edges = np.linspace(0, n, SCORES + 1).astype(int)
        scores = np.array([z[i:j].T @ e[i:j] for i, j in pairwise(edges)]) / n
        white = float(e.var()) / n
        covariance = white * (inverse + lost @ lost.T / least) + inverse @ (scores.T @ scores) @ inverse
        return cls(theta / scale, covariance / np.outer(scale, scale), blocks, u.shape[1], float(e.std()), n)

    def answer(self, j: int, first: int, last: int) -> tuple[float, float]:
        """(mean answer over rows ``first`` to ``last`` after a unit step of input j, its standard deviation).

        From the middle two thirds of ``DRAWS`` sets of coefficients that are as likely as these.
        """
        rng = np.random.default_rng(0)
        values, vectors = np.linalg.eigh((self.covariance + self.covariance.T) / 2)
        spread = vectors * np.sqrt(np.maximum(values, 0.0))
        thetas = self.theta + rng.standard_normal((DRAWS, len(values))) @ spread.T
        with np.errstate(over="ignore", invalid="ignore"):
            found = self._steps(np.vstack([self.theta, thetas]), j, last)[:, first - 1 :].mean(axis=1)
        found = np.nan_to_num(found, posinf=1e300, neginf=-1e300)
        low, high = np.quantile(found[1:], [0.16, 0.84])
        return float(found[0]), float(max(high / 2 - low / 2, 1e-300))

    def answer_within(self, j: int, first: int, last: int, most: float) -> tuple[float, float] | None:
        """``answer``; None where it goes beyond ``most``: coefficients under which a PV explodes say nothing."""
        value, sd = self.answer(j, first, last)
        return (value, sd) if abs(value) <= most else None

    def _steps(self, thetas: Array, j: int, rows: int) -> Array:
        """Answers (d, rows) to a unit step of input j under coefficients (d, p)."""
        m, longest = len(self.blocks), self.blocks[-1][1]
        widths = np.repeat([b - a for a, b in self.blocks], [b - a for a, b in self.blocks])
        of = np.repeat(np.arange(m), [b - a for a, b in self.blocks])
        own, pushes = thetas[:, of] / widths, np.cumsum(thetas[:, m * (1 + j) + of] / widths, axis=1)
        y = np.zeros((len(thetas), longest + rows))
        for k in range(rows):
            past = y[:, k : k + longest][:, ::-1]
            y[:, longest + k] = np.einsum("ij,ij->i", own, past) + pushes[:, min(k, longest - 1)]
        return y[:, longest:]


def blocks_to(longest: int) -> Blocks:
    """Blocks of lags from 0 to ``longest``, the first ones of one lag each, the later ones wider and wider."""
    edges = list(range(min(FINE, longest) + 1))
    width = 2.0
    while edges[-1] < longest:
        edges.append(min(edges[-1] + int(width), longest))
        width *= WIDER
    return tuple(pairwise(edges))
