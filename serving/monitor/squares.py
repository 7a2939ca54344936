"""Mean squares of errors over blocks, as charts take them: by their logarithms."""

from __future__ import annotations

from math import exp
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

LEAST_SIGMA = 0.2  # of the logarithm of a block's mean square: a smaller scatter is not believed
LEAST_SQUARE = 1e-18  # of a range: the error of a plant without noise
MOST_LOG = 700.0  # whose exponential is still a number


def log_mean_square(sums: Array, count: int) -> Array:
    """log(sums / count) of the sums (n,) of the squares of ``count`` errors, which are shares of their ranges."""
    return np.asarray(np.log(sums / count + LEAST_SQUARE))


def rms_ratio(shift: float) -> float:
    """By how many times a root mean square is larger whose logarithm of the mean square lies ``shift`` higher."""
    return exp(min(shift / 2, MOST_LOG))
