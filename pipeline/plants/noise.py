"""Measurement noise with a colour."""

from __future__ import annotations

import numpy as np

from pipeline.plants.simulator import Array


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
