"""When a PV answers to the moves of an input: the first row of the answer, for a person to compare with the plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_toeplitz, solve_triangular, toeplitz

from loopwright.pipeline.metrics import Array

FOLLOWED = 80  # rows after a move, whose sum has the sign of the answer
LONGEST, LEAD = 320, 20  # rows after a move, and before it: then the export stores it late
SEEN = 6.0  # standard deviations of what chance gives: an answer at all
BEGINS = 4.5  # standard deviations of the first row of an answer, of which many are looked at
LEAST = 0.05  # of the clearest row: below it a misfit of the model looks like an answer
PART, CHANCE = 0.25, 9.0  # of the largest change: an answer that begins so is excluded where its chi-squared is this
AGAIN = 3.0  # standard deviations that are not taken for chance there
COLOUR = 12  # rows that noise remembers
MOST = 400_000  # rows that are looked at
RIDGE = 1e-6


@dataclass(frozen=True, slots=True)
class FirstAnswer:
    """Rows from a move to the first row that differs by it: ``last``, or from ``first`` on beneath the noise.

    Where ``last`` is below 1 the PV answers before the move: its column is late. ``feedback``: an operator or a
    controller moves the input against what the PV did before, which is no answer.
    """

    first: int
    last: int
    feedback: bool = False


def first_answer(y: Array, u: Array, run: NDArray[np.int64]) -> FirstAnswer | None:
    """The first row of y (n,) that a move of u (n,) changes; None where no answer is seen.

        y(k+1) - y(k) = sum_l h_l (u(k-l) - u(k-l-1)) + e(k),   e(k) = sum_i a_i e(k-i) + w(k)

    for l = -LEAD .. LONGEST - 1 by least squares on both sides filtered by 1 - a(q), so that w is white: once noise of
    y, drifts and an integrator are in a, one row more is told from noise. z_l is what lag l adds to all later ones, in
    standard deviations: the answer begins at the first l where it is more than BEGINS. At most LEAD rows are looked
    back. Where the z_l before a move have the other sign than the answer, they are feedback, and the answer begins
    after the move.
    """
    from scipy.signal import fftconvolve, lfilter

    n = min(len(y), MOST)
    du, dy = np.diff(u[:n], prepend=u[:1]), np.diff(y[:n], append=y[n - 1 : n])
    inside = run[1:n] == run[: n - 1]
    du[1:][~inside], dy[:-1][~inside] = 0.0, 0.0
    du, dy = np.nan_to_num(du), np.nan_to_num(dy)
    if not du.any() or not dy.any() or n < 4 * LONGEST:
        return None
    h = _answer(du, dy)[0]
    white = whitening(dy - fftconvolve(du, h)[LEAD : LEAD + n])
    du, dy = lfilter(white, [1.0], du), lfilter(white, [1.0], dy)
    h, z, size = _answer(du, dy)
    clearest = float(np.abs(z).max())
    if max(clearest, float((np.abs(h) * size).max())) < SEEN:
        return None
    least = max(BEGINS, LEAST * clearest)
    begins = np.abs(z) >= least
    answer = np.cumsum(h[LEAD : LEAD + FOLLOWED])
    way = float(np.sign(answer[int(np.abs(answer).argmax())]))
    before, after = -way * float(z[:LEAD].sum()) / np.sqrt(LEAD), float((way * z[LEAD:]).max())
    feedback = before >= least and after >= SEEN
    if feedback:  # what precedes a move is its cause
        begins &= np.sign(z) == way
        begins[:LEAD] = False
    if not begins.any():
        return None
    last = int(begins.argmax())
    first = max(_earliest(last, h, way * z if feedback else np.abs(z), size), LEAD if feedback else 0)
    return FirstAnswer(first + 1 - LEAD, last + 1 - LEAD, feedback)


def _earliest(last: int, h: Array, z: Array, size: Array) -> int:
    """The earliest lag at which an answer of some size may begin too, within what chance gives."""
    strongest = float(np.abs(h[last : last + LEAD]).max())
    first, total = last, 0.0
    for lag in range(last - 1, -1, -1):
        total += (PART * strongest * float(size[lag])) ** 2
        if total >= CHANCE and z[lag] < AGAIN:
            break
        first = lag
    return first


def _answer(du: Array, dy: Array) -> tuple[Array, Array, Array]:
    """h, z, and the standard deviations in one unit of h where all later lags are known; (lags,) each."""
    n, lags = len(du), LEAD + LONGEST
    size = 1 << (n + lags).bit_length()
    spectrum = np.fft.rfft(du, size)
    both = np.fft.irfft(np.conj(spectrum) * np.fft.rfft(dy, size), size)
    own = np.fft.irfft(np.abs(spectrum) ** 2, size)[:lags]
    cross = np.r_[both[-LEAD:], both[:LONGEST]]
    gram = toeplitz(own) + RIDGE * own[0] * np.eye(lags)
    # The same matrix from the last lag to the first: a row of its Cholesky factor adds a lag to those after it.
    factor = np.linalg.cholesky(gram)
    h = cho_solve((factor, True), cross)
    left = max(float(dy @ dy - h @ cross), 1e-12 * float(dy @ dy)) / max(n - lags, 1)
    added = solve_triangular(factor, cross[::-1], lower=True)[::-1]
    return h, added / np.sqrt(left), np.diag(factor)[::-1] / np.sqrt(left)


def whitening(e: Array) -> Array:
    """1, -a_1 .. -a_COLOUR of e(k) = sum_i a_i e(k-i) + w(k), by Yule and Walker."""
    size = 1 << (len(e) + COLOUR).bit_length()
    own = np.fft.irfft(np.abs(np.fft.rfft(e, size)) ** 2, size)[: COLOUR + 1]
    own[0] = own[0] * (1.0 + 1e-9) + 1e-300  # nothing at all is white too
    return np.r_[1.0, -solve_toeplitz(own[:COLOUR], own[1:])]
