"""Whether a settling time is certain: a finite impulse response beside it, whose noise has poles of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.historian.first_answer import COLOUR, whitening
from loopwright.pipeline.historian.linear import blocks_of, least_squares
from loopwright.pipeline.metrics import Array

WIDER = 1.25  # by which a block of lags is longer than the one before
FOLLOWED = 2.0  # settling times, over which the answer is followed
KNOWN = 0.06  # of the answer's end: its standard deviation, from which on it is not known where it settles
AGREES = 1.6  # ratio of two settling times that are the same, blocks of lags being as wide as they are
WITHIN = 0.1  # of the end, as `Linear.settling`
ROWS_A_LAG = 4  # rows of the fit for each of its coefficients, at least
RAMP, GROWS = 60, 1.3  # rows over which a ramp is followed, and its end over the middle
MOST_ROWS = 24_000


@dataclass(frozen=True, slots=True, eq=False)
class StepAnswer:
    """The answer s (m,) of a PV to a unit step of an input, at the ends of blocks of lags, and its likely errors."""

    lag: NDArray[np.int64]  # (m,) rows after the step
    value: Array  # (m,)
    sd: Array  # (m,)

    @property
    def known(self) -> bool:
        """Whether the end is certain to a share KNOWN of itself."""
        return bool(self.sd[-1] <= KNOWN * abs(self.value[-1]))

    @property
    def settles(self) -> int:
        """Rows after which the answer stays within WITHIN of its end, as far as the errors tell."""
        outside = np.abs(self.value - self.value[-1]) > WITHIN * abs(self.value[-1]) + self.sd
        return int(self.lag[np.flatnonzero(outside)[-1] + 1]) if outside.any() else int(self.lag[0])


def step_answers(y: Array, u: Sequence[Array], run: NDArray[np.int64], length: int) -> list[StepAnswer] | None:
    """The answer of y (n,) to each input of u, (n,) each, over ``length`` rows; None of too few rows.

        y(k+1) - y(k) = sum_j sum_l h_jl (u_j(k-l) - u_j(k-l-1)) + e(k),   e(k) = sum_i a_i e(k-i) + w(k)

    by least squares on both sides filtered by 1 - a(q). The noise has poles of its own, so that a load that comes and
    goes slowly does not make the answer seem slow; ``Linear`` has the same poles for both.
    """
    from scipy.signal import lfilter  # half a second to load

    blocks = _blocks(length)
    keep = _rows(y, run, blocks[-1][1] + COLOUR)
    if len(keep) < ROWS_A_LAG * len(blocks) * len(u):
        return None
    same = np.r_[False, run[1:] == run[:-1]]
    du = [np.nan_to_num(np.where(same, np.diff(c, prepend=c[:1]), 0.0)) for c in u]
    dy = np.nan_to_num(np.where(np.r_[same[1:], False], np.diff(y, append=y[-1:]), 0.0))
    theta, cov = _fit(dy, du, keep, blocks)
    white = whitening((dy - _answer(du, theta, keep, blocks))[keep])
    dy, du = lfilter(white, [1.0], dy), [lfilter(white, [1.0], c) for c in du]
    theta, cov = _fit(dy, du, keep, blocks)
    m = len(blocks)
    ones, lag, found = np.tril(np.ones((m, m))), np.array([b for _, b in blocks]), []
    for own in (slice(i * m, (i + 1) * m) for i in range(len(u))):
        spread = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", ones, cov[own, own], ones), 0.0))
        found.append(StepAnswer(lag, np.cumsum(theta[own]), spread))
    return found


def certain(y: Array, u: Sequence[Array], run: NDArray[np.int64], settling: Mapping[int, int]) -> frozenset[int]:
    """Inputs of u, (n,) each, after which y (n,) takes about ``settling`` rows, by impulse responses of their own.

    One fit for all inputs of which the response is followed for as long.
    """
    lengths: dict[int, list[int]] = {}
    for i, rows in settling.items():
        lengths.setdefault(_blocks(int(np.ceil(FOLLOWED * rows)))[-1][1], []).append(i)
    found = set()
    for length, inputs in lengths.items():
        answers = step_answers(y, u, run, length)
        if answers is not None:
            found |= {i for i in inputs if answers[i].known and _agree(answers[i].settles, settling[i])}
    return frozenset(found)


def _agree(one: int, other: int) -> bool:
    """Whether two settling times [rows] are the same."""
    return 1 / AGREES < (one + 1) / (other + 1) < AGREES


def grows(y: Array, u: Sequence[Array], run: NDArray[np.int64], i: int) -> bool:
    """Whether y (n,) goes on and on after a step of input ``i``, for certain."""
    answers = step_answers(y, u, run, RAMP)
    if answers is None or not (found := answers[i]).known:
        return False
    middle = int(np.searchsorted(found.lag, found.lag[-1] / 2))
    return bool(abs(found.value[-1]) > GROWS * abs(found.value[middle]))


def _blocks(length: int) -> list[tuple[int, int]]:
    """Lags first .. last-1 that share a coefficient, from 0 to ``length`` or a little more."""
    ends = [0, 1]
    while ends[-1] < length:
        ends.append(max(ends[-1] + 1, int(WIDER * ends[-1])))
    return list(pairwise(ends))


def _rows(y: Array, run: NDArray[np.int64], back: int) -> NDArray[np.int64]:
    """Rows k with ``back`` rows before and one after in their run, y known as far back as noise remembers."""
    k = np.arange(back, len(y) - 1)
    missing = np.r_[0, np.cumsum(~np.isfinite(y))]
    k = k[(run[k - back] == run[k + 1]) & (missing[k + 2] == missing[k - COLOUR])]
    return k[:MOST_ROWS]


def _fit(dy: Array, du: Sequence[Array], k: NDArray[np.int64], blocks: list[tuple[int, int]]) -> tuple[Array, Array]:
    x = np.column_stack([blocks_of(c, k, tuple(blocks)) for c in du])
    theta, cov, _ = least_squares(x, dy[k])
    return theta, cov


def _answer(du: Sequence[Array], theta: Array, k: NDArray[np.int64], blocks: list[tuple[int, int]]) -> Array:
    out = np.zeros(len(du[0]))
    out[k] = np.column_stack([blocks_of(c, k, tuple(blocks)) for c in du]) @ theta
    return out
