"""Errors of outputs that are not new readings in every row: NaN there, and left out of every figure.

An analyser has a number now and then. Its error counts in the rows of new numbers alone; other outputs' in each row.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.pipeline.plants.simulator import Array


def counted(errors: Array) -> Array:
    """The errors (n, n_y) with 0 in place of those that do not count."""
    return np.nan_to_num(errors, nan=0.0, posinf=np.inf, neginf=-np.inf) if np.isnan(errors).any() else errors


def rms(errors: Array) -> Array:
    """The rms (n_y,) of the errors (n, n_y) that count."""
    return np.asarray(np.sqrt(np.nanmean(errors**2, axis=0)))


def sum_of_squares(residuals: Sequence[Array]) -> float:
    """Sum of the squared errors of all stretches (n, n_y)."""
    return float(sum(np.vdot(r, r) for r in map(counted, residuals)))


def deviation_of(errors: Sequence[Array]) -> Array:
    """Standard deviation (n_y,) of the errors of all stretches (n, n_y) that count."""
    whole = np.concatenate(list(errors))
    return np.asarray(np.nanstd(whole, axis=0) if np.isnan(whole).any() else whole.std(axis=0))


def changes_of(errors: Sequence[Array]) -> list[Array]:
    """Changes (n - 1, n_y) of each stretch's errors from one that counts to the next, NaN behind the last one."""
    return [_changes(of) if np.isnan(of).any() else np.diff(of, axis=0) for of in errors]


def _changes(errors: Array) -> Array:
    found = np.full((max(len(errors) - 1, 0), errors.shape[1]), np.nan)
    for i, of in enumerate(errors.T):
        steps = np.diff(of[np.isfinite(of)])
        found[: len(steps), i] = steps
    return found


def covariance_of(errors: Array) -> Array:
    """The second moments (n_y, n_y) of errors (n, n_y), each pair over the rows in which both count."""
    both = counted(errors)
    if both is errors:
        return np.asarray(errors.T @ errors / max(len(errors), 1))
    known = np.isfinite(errors).astype(np.float64)
    count = np.maximum(known.T @ known, 1.0)
    size = rms(errors)
    # Pairs of few rows may give what is no covariance: no correlation is then as good a guess.
    found = (both.T @ both) / count
    return found if np.linalg.eigvalsh(found).min() > 0 else np.diag(size**2)
