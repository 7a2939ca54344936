"""Measurement noise: its colour, and how it is told from what a signal does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded

from loopwright.pipeline.plants.simulator import Array

TURN_BACK_ERRORS = 3.0  # standard errors by which the changes of a signal turn back before that is called noise
LEAST_STRETCH = 20  # of a stretch
LEAST_CHANGE = 1e-3  # of the noise: a level that never moved would be wrong for good


def deviation(white: Array, colour: Array) -> Array:
    """Standard deviation (n_pv,) of noise with a colour phi whose changes are those of white noise with ``white``.

    sd = white / sqrt(1 - phi),    as the variance of e(k) - e(k-1) is 2 sd^2 (1 - phi)
    """
    return np.asarray(white / np.sqrt(1 - colour))


def coloured(white: Array, colour: Array) -> Array:
    """Noise e (n, ..., n_pv) with e(k) = phi e(k-1) + sqrt(1 - phi^2) w(k) from white noise w, whose sd it has.

    phi is ``colour`` (n_pv,), at least 0 and below 1; e(0) = w(0).
    """
    if not colour.any():
        return white
    found, fresh = white.copy(), np.sqrt(1 - colour**2)
    for k in range(1, len(found)):
        found[k] = colour * found[k - 1] + fresh * white[k]
    return found


def noise_and_change(stretches: Sequence[Array]) -> tuple[Array, Array]:
    """Standard deviations (n,) of the white noise of signals (rows, n), and of their own change from row to row.

        s(k) = d(k) + n(k),   var n = c_2 - c_1,   var Dd = c_0 - 2 var n,   c_j = mean of Ds(k) Ds(k+j)

    with the differences D from row to row. Noise makes each change turn back in the next one; so does all of the
    signal's own motion that is gone a row later, which nobody can act on. A change by no more than ``TURN_BACK_ERRORS``
    standard errors is none, and has no noise. The signal's own change is no less than one standard error or
    ``LEAST_CHANGE`` of the noise, for the record leaves so much open. Stretches shorter than ``LEAST_STRETCH`` say
    nothing.
    """
    width = stretches[0].shape[1] if stretches else 0
    changes = [np.diff(s, axis=0) for s in stretches if len(s) >= LEAST_STRETCH]
    if not changes:
        return np.zeros(width), np.zeros(width)
    own = np.concatenate([c[:-2] ** 2 for c in changes])
    turned = np.concatenate([c[:-2] * (c[2:] - c[1:-1]) for c in changes])
    roots = np.sqrt(len(turned))
    noise, error = turned.mean(axis=0), turned.std(axis=0) / roots
    noise = np.where(noise > TURN_BACK_ERRORS * error, np.minimum(noise, own.mean(axis=0) / 2), 0.0)
    left = own - 2 * np.where(noise > 0, turned, 0.0)
    least = np.maximum(left.std(axis=0) / roots, LEAST_CHANGE**2 * noise)
    return np.sqrt(noise), np.sqrt(np.maximum(own.mean(axis=0) - 2 * noise, least))


def level_gain(noise: Array, change: Array) -> Array:
    """Gain K (n,) with which the level of a signal is followed best: d(k) = d(k-1) + K (s(k) - d(k-1)).

        K = (q + sqrt(q^2 + 4 q)) / (q + sqrt(q^2 + 4 q) + 2),   q = (change / noise)^2

    The steady Kalman filter of a random walk in white noise (Anderson and Moore, Optimal Filtering, 1979, ch. 4), which
    is 1 without noise: the signal is taken as it is.
    """
    q = np.where(noise > 0, change, 1.0) ** 2 / np.where(noise > 0, noise, 1.0) ** 2
    root = q + np.sqrt(q**2 + 4 * q)
    return np.where(noise > 0, root / (root + 2), 1.0)


def running_levels(signals: Array, noise: Array, change: Array) -> Array:
    """Levels d (rows, n) of signals (rows, n) as ``level_gain`` follows them row by row, from the first reading on."""
    from scipy.signal import lfilter  # half a second to load

    found = signals.copy()
    for j in np.flatnonzero(noise > 0):
        gain = float(level_gain(noise, change)[j])
        found[:, j] = lfilter([gain], [1.0, gain - 1.0], signals[:, j], zi=[(1.0 - gain) * signals[0, j]])[0]
    return found


def levels(signals: Array, noise: Array, change: Array) -> Array:
    """Levels d (rows, n) of signals s (rows, n), from all rows before and after each: a record's, not a running loop's.

        min over d:   sum (s(k) - d(k))^2 / noise^2 + sum (d(k) - d(k-1))^2 / change^2

    The fixed-interval smoother of the filter of ``level_gain``. The part of a random
    walk in white noise that they miss goes with none of the levels, so that a plant has the gain to d that it has to
    the walk; other signals come near to that. s itself holds noise that the plant never felt, which makes gains too
    small (Carroll et al., Measurement Error in Nonlinear Models, 2006, ch. 4). Without noise d = s.
    """
    found = signals.copy()
    for j in np.flatnonzero(noise > 0):
        weight = (noise[j] / change[j]) ** 2
        bands = np.full((2, len(signals)), 1 + 2 * weight)
        bands[1, 0] = bands[1, -1] = 1 + weight
        bands[0] = -weight
        if len(signals) > 1:
            found[:, j] = solveh_banded(bands, signals[:, j])
    return found
