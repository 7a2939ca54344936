"""The partition sweep as one would write it down first: plain numpy and LAPACK, every step in full.

Nothing of Loopwright is imported, so that no other thread pool disturbs numpy's.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]


def choose(u: Array, c: int) -> Array:
    """Centres of fuzzy means on scaled samples, one vectorized distance to all samples for each."""
    half = 0.5 * (c - 1)
    near = np.rint((u + 1) * half).clip(0, c - 1) / half - 1
    radius2 = u.shape[1] / (c - 1) ** 2 * (1 + 1e-9)
    covered = np.zeros(len(u), dtype=bool)
    centres = []
    while not covered.all():
        k = int(np.argmin(covered))
        centres.append(near[k])
        covered |= ((u - near[k]) ** 2).sum(axis=1) <= radius2
        covered[k] = True
    return np.array(centres)


def responses(u: Array, centres: Array) -> Array:
    """Thin-plate spline responses (K, L)."""
    d2 = (u**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2 * u @ centres.T
    return 0.5 * d2 * np.log(np.maximum(d2, 1e-30))


def sweep(x: Array, y: Array, x_val: Array, y_val: Array, counts: list[int], limits: tuple[float, float]) -> Any:
    """Rows (c, centres, RMSE of the validation data) and the seconds spent."""
    begun = time.perf_counter()
    low, high = x.min(axis=0), x.max(axis=0)
    u, u_val = (2 * (a - low) / (high - low) - 1 for a in (x, x_val))
    rows = []
    for c in counts:
        centres = choose(u, c)
        n = len(centres)
        z = responses(u, centres)
        r = np.linalg.qr(np.column_stack([z, y]), mode="r")
        w = solve_triangular(r[:n, :n], r[:n, n])
        train, validation = (
            float(np.sqrt(np.mean((f.clip(*limits) - t) ** 2)))
            for f, t in ((z @ w, y), (responses(u_val, centres) @ w, y_val))
        )
        rows.append((c, n, train, validation))
    return rows, time.perf_counter() - begun
