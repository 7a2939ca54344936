"""When a PV answers to the moves of an input: the first row of the answer, for a person to compare with the plant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.metrics import Array

LONGEST = 320  # rows after a move
SEEN = 6.0  # standard deviations of what chance gives
MOST = 400_000  # rows that are looked at


def first_answer(y: Array, u: Array, run: NDArray[np.int64]) -> int:
    """Rows from a move of u (n,) to the first row of y (n,) that differs by it; -1 where no answer is seen.

        c(l) = sum_k du(k - l) dy(k),   dy(k) = y(k+1) - y(k)

    c over its own scatter at all lags is about normal without an answer; the answer begins before the highest peak, at
    the first lag from which it stays above SEEN, or above a tenth of the peak.
    """
    n = min(len(y), MOST)
    du, dy = np.diff(u[:n], prepend=u[:1]), np.diff(y[:n], append=y[n - 1 : n])
    inside = run[1:n] == run[: n - 1]
    du[1:][~inside], dy[:-1][~inside] = 0.0, 0.0
    du, dy = np.nan_to_num(du), np.nan_to_num(dy)
    if not du.any() or not dy.any() or n < 4 * LONGEST:
        return -1
    size = 1 << (n + LONGEST - 1).bit_length()
    cross = np.fft.irfft(np.conj(np.fft.rfft(du, size)) * np.fft.rfft(dy, size), size)[:LONGEST]
    chance = float(np.linalg.norm(du) * np.std(dy))
    score = np.abs(cross) / max(chance, 1e-300)
    peak = int(np.argmax(score))
    if score[peak] < SEEN:
        return -1
    above = score >= max(SEEN / 2, 0.1 * score[peak])
    first = peak
    while first > 0 and (above[first - 1] or (first > 1 and above[first - 2])):
        first -= 1
    return first + 1
