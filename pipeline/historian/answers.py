"""How a PV answers to an input, read from one-step predictions: right in a closed loop too, and honest about doubt.

A free run under feedback can take the controller, read backwards, for the plant: PV = set point - MV / Kc. A one-step
prediction that knows the PV's own past cannot, because what the controller made of that past tells it nothing new:
only moves of the MV that do not come from the PV do (set points, steps by hand, another loop). Where there are none,
the coefficients are free, and so is the sign.

Source: L. Ljung, System Identification: Theory for the User, 2nd ed., 1999, chapter 13 (the direct method).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_toeplitz, solve_triangular, toeplitz

from loopwright.pipeline.historian.arx_model import Blocks, blocks_of
from loopwright.pipeline.metrics import Array

FINE_LAGS = 6  # lags with a coefficient of their own; later ones share one
LAG_BLOCK_GROWTH = 1.5  # a block over the one before
MOST_LAGS, FEWEST_LAGS = 160, 10  # lags
WIDE_BLOCKS = ((0, 4), (4, 8), (8, 14), (14, 23), (23, 37), (37, 57), (57, 87), (87, 120), (120, 160))  # lags of inputs
"""Wide ones, for a PV with few readings: its answer settles within MOST_LAGS, and a block has a few rows at least."""
MOST_MEMORY = 0.95  # of an error for the one of the reading before: with more its mean is free
ROWS_A_COEFFICIENT = 6  # rows for each coefficient of the model: of the PV, the inputs and a constant
SCORES = 40  # parts of the rows whose sums say how far the coefficients may be off
# eigenvalue of the regressors' covariance, over the largest, below which a direction never moved
FLAT_EIGENVALUE = 1e-12
COEFFICIENT_DRAWS = 200  # sets of coefficients of which a spread is taken


@dataclass(frozen=True, slots=True, eq=False)
class DirectModel:
    """y(k+1) = sum_b a_b mean(y over block b) + sum_j sum_b b_jb mean(u_j over block b) + c + e(k+1), least squares.

    ``theta`` (p,) and its covariance (p, p) hold the blocks of y, then those of each input, then c. The covariance is
    that of white residuals and that of sums over neighbouring rows together; a direction in which the regressors never
    moved is as free as noise leaves it.
    """

    theta: Array
    covariance: Array
    blocks: tuple[Blocks, ...]  # of y, then of each input
    sd: float  # of e
    rows: int

    @classmethod
    def of(
        cls, y: Array, u: Array, run: NDArray[np.int64], longest: int = 40, read: NDArray[np.bool_] | None = None
    ) -> DirectModel | None:
        """Fit to a PV y (n,) and its inputs u (n, m), with lags up to ``longest`` rows; None where rows are too few.

        ``read`` (n,) are the rows with a new reading, see ``of_readings``; None: all.
        """
        if read is not None:
            return cls.of_readings(y, u, run, read)
        longest = min(max(longest, FEWEST_LAGS), MOST_LAGS)
        while (model := cls.of_blocks(y, u, run, [blocks_to(longest)] * (1 + u.shape[1]))) is None:
            if longest <= FEWEST_LAGS:
                return None
            longest = max(longest // 2, FEWEST_LAGS)
        return model

    @classmethod
    def of_readings(cls, y: Array, u: Array, run: NDArray[np.int64], read: NDArray[np.bool_]) -> DirectModel | None:
        """Fit to the readings of y (n,) at the rows ``read`` (n,), from inputs u (n, m); None where these are too few.

        The PV is not known row by row, so that its past tells by the error of the reading before alone:

            y(k+1) = sum_j sum_b b_jb mean(u_j over block b) + c + w(k+1),   w(i) = rho w(i - 1) + e(i) over readings
        """
        blocks = (((0, 1),), *(WIDE_BLOCKS for _ in range(u.shape[1])))
        longest = WIDE_BLOCKS[-1][1]
        k = np.flatnonzero(read[1:])
        k = k[(k >= longest) & (run[np.maximum(k - longest, 0)] == run[k + 1])]
        coefficients = len(WIDE_BLOCKS) * u.shape[1] + 1
        if len(k) - 1 < ROWS_A_COEFFICIENT * coefficients:
            return None
        columns = [blocks_of(c - c.mean(), k, WIDE_BLOCKS) for c in u.T]
        x, target = np.column_stack([*columns, np.ones(len(k))]), y[k + 1] - y[read].mean()
        left = target - x @ np.linalg.lstsq(x, target, rcond=1e-10)[0]
        memory = float(np.clip(left[1:] @ left[:-1] / max(float(left @ left), 1e-300), 0.0, MOST_MEMORY))
        x = np.column_stack([x[1:, :-1] - memory * x[:-1, :-1], x[1:, -1]])
        theta, covariance, sd = _least_squares(x, target[1:] - memory * target[:-1])
        whole, spread = np.zeros(len(theta) + 1), np.zeros((len(theta) + 1, len(theta) + 1))
        whole[1:], spread[1:, 1:] = theta, covariance
        return cls(whole, spread, blocks, sd, len(k))

    @classmethod
    def of_blocks(cls, y: Array, u: Array, run: NDArray[np.int64], blocks: Sequence[Blocks]) -> DirectModel | None:
        """Fit with the ``blocks`` of y, then of each input; None where rows are too few."""
        longest = max(of[-1][1] for of in blocks)
        k = np.arange(longest, len(y) - 1)
        k = k[run[k - longest] == run[k + 1]]
        if len(k) < ROWS_A_COEFFICIENT * (sum(map(len, blocks)) + 1):
            return None
        columns = [blocks_of(c - c.mean(), k, of) for c, of in zip((y, *u.T), blocks, strict=True)]
        x = np.column_stack([*columns, np.ones(len(k))])
        theta, covariance, sd = _least_squares(x, y[k + 1] - y.mean())
        return cls(theta, covariance, tuple(blocks), sd, len(k))

    def answer(self, j: int, first: int, last: int) -> tuple[float, float]:
        """(mean answer over rows ``first`` to ``last`` after a unit step of input j, its standard deviation).

        From the middle two thirds of ``step_answers``.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            found = self.step_answers(j, last)[:, first - 1 :].mean(axis=1)
        found = np.nan_to_num(found, posinf=1e300, neginf=-1e300)
        low, high = np.quantile(found[1:], [0.16, 0.84])
        return float(found[0]), float(max(high / 2 - low / 2, 1e-300))

    def answer_within(self, j: int, first: int, last: int, most: float) -> tuple[float, float] | None:
        """``answer``; None where it goes beyond ``most``: coefficients under which a PV explodes say nothing."""
        value, sd = self.answer(j, first, last)
        return (value, sd) if abs(value) <= most else None

    def step_answers(self, j: int, rows: int) -> Array:
        """Answers (1 + ``COEFFICIENT_DRAWS``, rows) to a unit step of input j.

        The first is that of ``theta``, the others those of sets of coefficients that are as likely.
        """
        rng = np.random.default_rng(0)
        values, vectors = np.linalg.eigh((self.covariance + self.covariance.T) / 2)
        spread = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = self.theta + rng.standard_normal((COEFFICIENT_DRAWS, len(values))) @ spread.T
        thetas, first = np.vstack([self.theta, drawn]), sum(map(len, self.blocks[: 1 + j]))
        own = _by_lag(thetas, self.blocks[0])
        pushes = np.cumsum(_by_lag(thetas[:, first:], self.blocks[1 + j]), axis=1)
        longest = own.shape[1]
        y = np.zeros((len(thetas), longest + rows))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(rows):
                past = y[:, k : k + longest][:, ::-1]
                y[:, longest + k] = np.einsum("ij,ij->i", own, past) + pushes[:, min(k, pushes.shape[1] - 1)]
        return y[:, longest:]


def _least_squares(x: Array, target: Array) -> tuple[Array, Array, float]:
    """(theta (p,), its covariance (p, p), standard deviation of what is left) of target (n,) on columns x (n, p)."""
    scale = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    z, n = x / scale, len(x)
    values, vectors = np.linalg.eigh(z.T @ z / n)
    least = FLAT_EIGENVALUE * values[-1]
    moved = values > least
    known, lost = vectors[:, moved], vectors[:, ~moved]
    inverse = (known / values[moved]) @ known.T
    theta = inverse @ (z.T @ target / n)
    e = target - z @ theta
    edges = np.linspace(0, n, SCORES + 1).astype(int)
    scores = np.array([z[i:j].T @ e[i:j] for i, j in pairwise(edges)]) / n
    white = float(e.var()) / n
    covariance = white * (inverse + lost @ lost.T / least) + inverse @ (scores.T @ scores) @ inverse
    return theta / scale, covariance / np.outer(scale, scale), float(e.std())


def _by_lag(thetas: Array, blocks: Blocks) -> Array:
    """Weights (d, lags) of each lag, of the coefficients (d, blocks ..) of blocks."""
    widths = [b - a for a, b in blocks]
    return np.repeat(thetas[:, : len(blocks)] / widths, widths, axis=1)


def blocks_to(longest: int) -> Blocks:
    """Blocks of lags from 0 to ``longest``, the first ones of one lag each, the later ones wider and wider."""
    edges = list(range(min(FINE_LAGS, longest) + 1))
    width = 2.0
    while edges[-1] < longest:
        edges.append(min(edges[-1] + int(width), longest))
        width *= LAG_BLOCK_GROWTH
    return tuple(pairwise(edges))


# ------------------------------------------------------------------------------------------ the first row of an answer
FOLLOWED_ROWS = 80  # rows after a move, whose sum has the sign of the answer
ROWS_AFTER, LEAD = 320, 20  # rows after a move, and before it: then the export stores it late
ANSWER_SDS = 6.0  # standard deviations of what chance gives: an answer at all
FIRST_ROW_SDS = 4.5  # standard deviations of the first row of an answer, of which many are looked at
LEAST_OF_CLEAREST = 0.05  # of the clearest row: below it a misfit of the model looks like an answer
PART, CHANCE = 0.25, 9.0  # of the largest change: an answer that begins so is excluded where its chi-squared is this
AGAIN = 3.0  # standard deviations that are not taken for chance there
COLOUR = 12  # rows that noise remembers
MOST_ANSWER_ROWS = 400_000  # rows that are looked at
COVARIANCE_RIDGE = 1e-6  # share of the autocovariance at lag 0, on the diagonal: keeps the equations solvable


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

    for l = -LEAD .. ROWS_AFTER - 1 by least squares on both sides filtered by 1 - a(q), so that w is white: once noise
    of y, drifts and an integrator are in a, one row more is told from noise. z_l is what lag l adds to all later ones,
    in standard deviations: the answer begins at the first l where it is more than FIRST_ROW_SDS. At most LEAD rows are
    looked back. Where the z_l before a move have the other sign than the answer, they are feedback, and the answer
    begins after the move.
    """
    from scipy.signal import fftconvolve, lfilter

    n = min(len(y), MOST_ANSWER_ROWS)
    du, dy = np.diff(u[:n], prepend=u[:1]), np.diff(y[:n], append=y[n - 1 : n])
    inside = run[1:n] == run[: n - 1]
    du[1:][~inside], dy[:-1][~inside] = 0.0, 0.0
    du, dy = np.nan_to_num(du), np.nan_to_num(dy)
    if not du.any() or not dy.any() or n < 4 * ROWS_AFTER:
        return None
    h = _answer(du, dy)[0]
    white = whitening(dy - fftconvolve(du, h)[LEAD : LEAD + n])
    du, dy = lfilter(white, [1.0], du), lfilter(white, [1.0], dy)
    h, z, size = _answer(du, dy)
    clearest = float(np.abs(z).max())
    if max(clearest, float((np.abs(h) * size).max())) < ANSWER_SDS:
        return None
    least = max(FIRST_ROW_SDS, LEAST_OF_CLEAREST * clearest)
    begins = np.abs(z) >= least
    answer = np.cumsum(h[LEAD : LEAD + FOLLOWED_ROWS])
    way = float(np.sign(answer[int(np.abs(answer).argmax())]))
    before, after = -way * float(z[:LEAD].sum()) / np.sqrt(LEAD), float((way * z[LEAD:]).max())
    feedback = before >= least and after >= ANSWER_SDS
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
    n, lags = len(du), LEAD + ROWS_AFTER
    size = 1 << (n + lags).bit_length()
    spectrum = np.fft.rfft(du, size)
    both = np.fft.irfft(np.conj(spectrum) * np.fft.rfft(dy, size), size)
    own = np.fft.irfft(np.abs(spectrum) ** 2, size)[:lags]
    cross = np.r_[both[-LEAD:], both[:ROWS_AFTER]]
    gram = toeplitz(own) + COVARIANCE_RIDGE * own[0] * np.eye(lags)
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
