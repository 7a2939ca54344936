"""When a PV answers to the moves of an input: the first row of the answer, for a person to compare with the plant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from pipeline.metrics import Array

LONGEST, LEAD = 320, 20  # rows after a move, and before it: then the export stores it late
NONE = -LEAD - 1  # no answer is seen
SEEN = 6.0  # standard deviations of what chance gives
MOST = 400_000  # rows that are looked at
RIDGE = 1e-6


def first_answer(y: Array, u: Array, run: NDArray[np.int64]) -> int:
    """Rows from a move of u (n,) to the first row of y (n,) that differs by it, NONE where no answer is seen.

    Below 1 the PV seems to answer before the move: its column is late. At most LEAD rows are looked back.

        y(k+1) - y(k) = sum_l h_l (u(k-l) - u(k-l-1)) + e(k),   l = -LEAD .. LONGEST - 1

    by least squares, so that moves which follow each other do not blur it. The answer begins before the clearest h_l,
    at the first lag from which h stays above half of SEEN standard deviations, or a tenth of the clearest.
    """
    n = min(len(y), MOST)
    du, dy = np.diff(u[:n], prepend=u[:1]), np.diff(y[:n], append=y[n - 1 : n])
    inside = run[1:n] == run[: n - 1]
    du[1:][~inside], dy[:-1][~inside] = 0.0, 0.0
    du, dy = np.nan_to_num(du), np.nan_to_num(dy)
    if not du.any() or not dy.any() or n < 4 * LONGEST:
        return NONE
    size = 1 << (n + LONGEST + LEAD).bit_length()
    spectrum = np.fft.rfft(du, size)
    both = np.fft.irfft(np.conj(spectrum) * np.fft.rfft(dy, size), size)
    lags = LEAD + LONGEST
    own = np.fft.irfft(np.abs(spectrum) ** 2, size)[:lags]
    cross = np.r_[both[-LEAD:], both[:LONGEST]]
    gram = toeplitz(own) + RIDGE * own[0] * np.eye(lags)
    inverse = np.linalg.inv(gram)
    h = inverse @ cross
    left = max(float(dy @ dy - h @ cross), 1e-12 * float(dy @ dy)) / n
    score = np.abs(h) / np.sqrt(left * np.diag(inverse))
    peak = int(np.argmax(score))
    if score[peak] < SEEN:
        return NONE
    above = score >= max(SEEN / 2, 0.1 * score[peak])
    first = peak
    while first > 0 and (above[first - 1] or (first > 1 and above[first - 2])):
        first -= 1
    return first + 1 - LEAD
