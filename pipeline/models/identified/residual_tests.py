"""Findings in the residual of a free run: dynamics that are missing, noise that has a colour."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.pipeline.plants.simulator import Array

LAGS = 25
"""Lags of the residual's correlations."""


def residual_figures(
    residuals: Sequence[Array], inputs: Sequence[Array], names: Sequence[str]
) -> dict[str, dict[str, float]]:
    """For each PV's free-run residual: shares of its correlations outside the 99 % band of a white one.

    ``autocorrelated`` over lags 1 .. 25, ``input_correlated`` with the inputs at lags 0 .. 25; .01 is what chance
    gives. A share of the second far above that says that dynamics are missing; the first also sees coloured noise.
    """
    e = np.concatenate([r - r.mean(axis=0) for r in residuals])
    v = np.concatenate([u - u.mean(axis=0) for u in inputs])
    n = len(e)
    if n <= 2 * LAGS:
        return {}
    figures = {}
    for i, name in enumerate(names):
        own = _correlations(e[:, i], e[:, i])
        bound = 2.58 / np.sqrt(n)
        cross = []
        for u in v.T:
            # Correlated inputs widen the band: the product of both autocorrelations, after Bartlett.
            wide = np.sqrt(max(1 + 2 * float(np.sum(own[1:] * _correlations(u, u)[1:])), 1.0))
            cross.append(np.abs(_correlations(e[:, i], u)) > bound * wide)
        figures[name] = {
            "autocorrelated": float(np.mean(np.abs(own[1:]) > bound)),
            "input_correlated": float(np.mean(cross)),
        }
    return figures


def _correlations(later: Array, earlier: Array) -> Array:
    """Correlation coefficients of later(k) and earlier(k - l), l = 0 .. ``LAGS``."""
    norm = max(float(np.linalg.norm(later) * np.linalg.norm(earlier)), 1e-300)
    n = len(later)
    return np.array([float(later[lag:] @ earlier[: n - lag]) for lag in range(LAGS + 1)]) / norm
