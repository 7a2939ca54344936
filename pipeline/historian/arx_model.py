"""A quick linear model of one PV: not for control, but to tell an outlier from an answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.step_response import SETTLED_IN_RECORD, settling_index
from loopwright.pipeline.metrics import Array

Blocks = tuple[tuple[int, int], ...]

Y_LAGS = 3  # lags of the PV
BLOCKS = ((0, 1), (1, 2), (2, 3), (3, 6), (6, 11), (11, 21), (21, 41))  # lags of an input that share a coefficient
ACAUSAL_LAGS = ((-1, 0), (-2, -1), (-5, -2))  # lags of an input that no plant can answer to
MOST_ARX_ROWS, WINDOW_ROWS = 24_000, 2_000  # of the fit, in windows spread evenly over the record
LATEST_SETTLED = 0.8  # of the rows that an answer is followed: later it has not settled
OUTSIDE_SD = 6.0  # residuals that the second fit leaves out
LEAST_ARX_ROWS = 60  # rows below which no model is fitted
NO_EFFECT = 2.0  # strength of an input that a prediction leaves out
RAMPS = 5.0  # likely errors of the sum of an input's coefficients, from which y integrates it
LONG_RECORD = 1_000_000  # rows, of which a part is looked at


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """y(k+1) = sum a_i y(k-i) + sum_j b_j mean(u over block j) + c, fitted by least squares.

    ``strength`` is the Wald statistic of an input's coefficients over their number, about 1 without an effect.
    """

    a: Array  # (Y_LAGS,)
    b: Array  # (n_inputs, len(blocks)) per block
    c: float  # over inputs as distances from ``centre``
    centre: Array  # (n_inputs,)
    blocks: Blocks
    sd: float  # of the residual, robust
    strength: Mapping[int, float]  # input -> statistic
    explained: float  # share of the variance of y(k+1) - y(k)
    rows: NDArray[np.int64]  # (n,) rows k of the fit
    residual: Array  # (n,)
    integrates: bool = False  # a pole at 1 was asked for: sum a_i = 1
    ramp: Mapping[int, float] = field(default_factory=dict)  # input -> sum of its coefficients over its likely error
    sure: bool = False  # a drift would change little, or was taken off
    slow: int = 0  # knots of the lines in time that took up a drift

    def predicted(self, y: Array, u: Sequence[Array], k: NDArray[np.int64]) -> Array:
        """y(k+1) (m,) from the rows up to k (m,) of y (n,) and of each input u (n,); NaN where one is missing.

        k must increase and leave as many rows before it as the blocks reach back.
        """
        out = self.c + sum(a * y[k - i] for i, a in enumerate(self.a))
        back = self.blocks[-1][1]
        first = int(k[0]) - back
        for i, row in enumerate(self.b):
            if self.strength[i] < NO_EFFECT:
                continue
            part = u[i][first : int(k[-1]) + 1] - self.centre[i]
            out += answer_of(part, k - first, self.blocks, row)
        return np.asarray(out)

    def step_response(self, i: int, length: int = 600) -> Array:
        """Answer of y to a unit step of input ``i`` at k = 0, (length,)."""
        from scipy.signal import lfilter

        drive = np.zeros(length)
        for (first, last), b in zip(self.blocks, self.b[i], strict=True):
            for lag in range(first, last):
                drive[lag:] += b / (last - first)
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable model
            return np.asarray(lfilter([0.0, 1.0], np.r_[1.0, -self.a], drive))

    def slope(self, i: int) -> float:
        """Change of y in a row, long after a unit step of input ``i``; 0 where y does not integrate."""
        past = self.a @ np.arange(len(self.a), dtype=np.float64)  # of y(k) = k: what sum a_i y(k-i) lacks to y(k+1)
        return float(self.b[i].sum() / (1.0 + past)) if self.integrates else 0.0

    def ramps(self, i: int) -> bool:
        """Whether input ``i`` makes y rise or fall for ever, beyond doubt."""
        return self.integrates and abs(self.ramp[i]) > RAMPS

    def settling(self, i: int, length: int = 600) -> int:
        """Rows after which the answer to input ``i`` stays within 10 % of its end; 0 if not in ``length``."""
        answer = self.step_response(i, length)
        if not np.isfinite(answer).all() or abs(answer[-1]) <= 1e-12:
            return 0
        rows = max(int(settling_index(answer, SETTLED_IN_RECORD * abs(answer[-1]))), 1)
        return rows if rows < LATEST_SETTLED * length else 0


def fit_arx(
    y: Array, u: Sequence[Array], run: NDArray[np.int64], integrates: bool = False, slow: int = 0
) -> Linear | None:
    """The model of y (n,) from inputs u, (n,) each, within runs (n,); None where too few rows or no motion are there.

    Rows with NaN take no part. At most MOST_ARX_ROWS rows are used, in windows spread evenly. ``integrates``: with a
    pole at 1. ``slow``: lines in time from this many knots on to the next take up a drift, and stay out of the model.
    """
    blocks: Blocks = BLOCKS
    while True:
        rows = rows_of(y, u, run, blocks[-1][1] - 1)
        parameters = Y_LAGS + 1 + len(u) * (len(blocks) + len(ACAUSAL_LAGS))
        if len(rows) >= max(LEAST_ARX_ROWS, 3 * parameters):
            break
        if len(blocks) <= 3:
            return None
        blocks = blocks[:-1]
    if np.ptp(y[rows + 1]) <= 0:
        return None
    centre = np.array([float(np.mean(c[rows])) for c in u])
    x, target, own = _regressors(y, u, centre, rows, blocks, integrates, slow)
    theta, cov, keep = least_squares(x, target)
    residual = target - x @ theta
    sd = _robust_sd(residual[keep])
    m = len(blocks)
    places = {i: slice(own + i * m, own + (i + 1) * m) for i in range(len(u))}
    strength = {i: _wald(theta[p], cov[p, p]) for i, p in places.items()}
    ramp = {i: float(theta[p].sum() / np.sqrt(max(cov[p, p].sum(), 1e-300))) for i, p in places.items()}
    growth = (y[rows + 1] - y[rows])[keep]
    moved = np.var(growth)
    explained = 1.0 - np.var(residual[keep]) / moved if moved > 0 else 0.0
    b = np.array([theta[p] for p in places.values()]).reshape(len(u), m)
    a = np.r_[1.0 + theta[0], np.diff(theta[:own]), -theta[own - 1]] if integrates else theta[:Y_LAGS]
    return Linear(
        a,
        b,
        float(theta[-1]),
        centre,
        blocks,
        sd,
        strength,
        float(explained),
        rows,
        residual,
        integrates,
        ramp,
        slow=slow,
    )


def _regressors(
    y: Array, u: Sequence[Array], centre: Array, rows: NDArray[np.int64], blocks: Blocks, integrates: bool, slow: int
) -> tuple[Array, Array, int]:
    """The columns (n, m) of a fit over these rows, its target (n,), and how many of the columns are y's own past."""
    past = np.column_stack([y[rows - i] for i in range(Y_LAGS)])
    target, own = (y[rows + 1] - past[:, 0], past[:, :-1] - past[:, 1:]) if integrates else (y[rows + 1], past)
    inputs = [blocks_of(c - m, rows, blocks) for c, m in zip(u, centre, strict=True)]
    return np.column_stack([own, *inputs, *_lines(rows, slow), np.ones(len(rows))]), target, own.shape[1]


def lead(model: Linear, y: Array, u: Sequence[Array], i: int) -> tuple[float, int]:
    """Whether moves of input ``i`` still to come improve the fit of a model of y (n,) from u, (n,) each.

    Their Wald statistic, and by how many rows the strongest comes before its move.
    """
    x, target, _ = _regressors(y, u, model.centre, model.rows, model.blocks, model.integrates, model.slow)
    ahead = blocks_of(u[i] - model.centre[i], model.rows, ACAUSAL_LAGS)
    theta, cov, _ = least_squares(np.column_stack([x, ahead]), target)
    m = x.shape[1]
    t = np.abs(theta[m:]) / np.sqrt(np.maximum(np.diag(cov)[m:], 1e-300))
    best = int(np.argmax(t)) if np.isfinite(t).all() else 0
    return _wald(theta[m:], cov[m:, m:]), -ACAUSAL_LAGS[best][1] + 1


def _lines(rows: NDArray[np.int64], knots: int) -> list[Array]:
    """For each knot but the first, a line (n,) over the rows that is 1 there and 0 at the others."""
    at = np.linspace(rows[0], rows[-1], max(knots, 1))
    return [np.interp(rows, at, unit) for unit in np.eye(max(knots, 1))[1:]]


def rows_of(y: Array, u: Sequence[Array], run: NDArray[np.int64], lag: int) -> NDArray[np.int64]:
    """Rows k with lag rows before and five after in their run, without NaN, in windows spread evenly."""
    after = -ACAUSAL_LAGS[-1][0]
    lag = max(lag, Y_LAGS - 1)
    bad = np.r_[0, np.cumsum(~whole(y, *u), dtype=np.int32)]

    def good(k: NDArray[np.int64]) -> NDArray[np.int64]:
        return k[(run[k - lag] == run[k + after]) & (bad[k + after + 1] == bad[k - lag])]

    last = len(y) - after
    if last - lag > LONG_RECORD:  # a part first, so that a long record needs no long list of rows
        starts = np.linspace(lag, last - WINDOW_ROWS, 4 * MOST_ARX_ROWS // WINDOW_ROWS).astype(np.int64)
        k = good((starts[:, None] + np.arange(WINDOW_ROWS)).ravel())
    else:
        k = good(np.arange(lag, last))
    if len(k) > MOST_ARX_ROWS:
        starts = np.linspace(0, len(k) - WINDOW_ROWS, MOST_ARX_ROWS // WINDOW_ROWS).astype(np.int64)
        k = k[np.unique((starts[:, None] + np.arange(WINDOW_ROWS)).ravel())]
    return k


def whole(*columns: Array) -> NDArray[np.bool_]:
    """Rows (n,) in which no column (n,) is NaN."""
    ok = np.ones(len(columns[0]), dtype=bool)
    for column in columns:
        ok &= np.isfinite(column)
    return ok


def blocks_of(u: Array, rows: NDArray[np.int64], blocks: Blocks) -> Array:
    """Means of u over lags first .. last-1 of each row, (n, blocks)."""
    total = _sums(u)
    return np.column_stack(
        [(total[np.maximum(rows - a + 1, 0)] - total[np.maximum(rows - b + 1, 0)]) / (b - a) for a, b in blocks]
    )


def answer_of(u: Array, rows: NDArray[np.int64], blocks: Blocks, weights: Array) -> Array:
    """``blocks_of`` (n, blocks) times weights (blocks,), without the table: (n,).

    The rows must increase, and u must reach back as far as the blocks do.
    """
    total, out = _sums(u), np.zeros(len(rows))
    start, end = int(rows[0]), int(rows[-1]) + 1
    for (a, b), weight in zip(blocks, weights, strict=True):
        if end - start == len(rows):  # all rows of a stretch
            part = total[start - a + 1 : end - a + 1] - total[start - b + 1 : end - b + 1]
        else:
            part = total[rows - a + 1] - total[rows - b + 1]
        part *= weight / (b - a)
        out += part
    return out


def _sums(u: Array) -> Array:
    """Sum of the values of u (n,) before each row and before the end, (n + 1,); a missing one counts as 0."""
    total = np.empty(len(u) + 1)
    total[0] = 0.0
    np.cumsum(np.where(np.isnan(u), 0.0, u), out=total[1:])
    return total


def least_squares(x: Array, target: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Coefficients and their covariance, from the rows whose residual is within OUTSIDE_SD of a first fit.

    From all rows where the first fit is exact, as of a column that copies another: only its ridge is left then, which
    moves all residuals to one side.
    """
    scale = np.abs(x).max(axis=0)
    scale[scale == 0] = 1.0  # an input that never moves
    z = x / scale
    keep = np.ones(len(z), dtype=bool)
    for _ in range(2):
        gram = z[keep].T @ z[keep]
        gram[np.diag_indices_from(gram)] += 1e-9 * np.trace(gram) / len(gram)
        inverse = np.linalg.pinv(gram, hermitian=True)
        theta = inverse @ (z[keep].T @ target[keep])
        residual = target - z @ theta
        used, sd = keep, _robust_sd(residual)
        keep = np.abs(residual) <= max(OUTSIDE_SD * sd, 1e-12 * np.abs(target).max())
        if 2 * np.count_nonzero(keep) < len(keep):
            break
    variance = float(np.mean(residual[used] ** 2)) * used.sum() / max(used.sum() - z.shape[1], 1)
    return theta / scale, variance * inverse / np.outer(scale, scale), used


def _wald(theta: Array, cov: Array) -> float:
    value = float(theta @ np.linalg.pinv(cov, hermitian=True) @ theta) / len(theta)
    return value if np.isfinite(value) and value > 0 else 0.0


def _robust_sd(residual: Array) -> float:
    return float(1.4826 * np.median(np.abs(residual - np.median(residual))))


# ----------------------------------------- the choice: one that rests, one that integrates, or one beside a slow drift
FREE_RUN_ROWS, FREE_RUN_WINDOWS = 400, 8  # rows of a free run that is compared, and how many there are at least
DRIFT_KNOTS = (32, 8)  # of lines in time that take up a drift
KNOT_SETTLINGS = 4  # between two knots at least: shorter lines take up the answers too
AS_GOOD_ERROR = 1.1  # error over another model's
INTEGRATOR_UNEXPLAINED = 0.8  # of the motion of y: an integrator that leaves more is none
STRONG_INPUT = 4.0  # inputs with an answer
# relative change of a gain, and ratio of two settling times: by a drift
DRIFT_GAIN_CHANGE, DRIFT_SETTLING_RATIO = 0.1, 1.3


def believed(y: Array, u: Sequence[Array], run: NDArray[np.int64]) -> Linear | None:
    """The quick model of y (n,) from inputs u, (n,) each, for gain and settling; None where there is none.

    Noise in y pulls a pole at 1 below 1. So a model with the pole at 1 is taken where the plain one does not settle
    and its free run is no better. A drift, a load or a gain that fades pulls the poles towards 1. So no pole at 1 is
    taken where a model beside lines in time settles and its free run is better: an integrator does not settle beside
    them either. And a model beside lines is taken where it settles well within one line, and in less time or to
    another gain than the plain one; with less certainty where only it settles.
    """
    plain = fit_arx(y, u, run)
    if plain is None:
        return None
    error = free_run_error(plain, y, u, run)
    level = fit_arx(y, u, run, integrates=True)
    ramps = [i for i in range(len(u)) if level is not None and level.ramps(i)]
    settles = any(plain.settling(i) for i in ramps)
    besides = [model for knots in DRIFT_KNOTS if (model := fit_arx(y, u, run, slow=knots)) is not None]
    rival = None
    if level is not None and ramps and not settles:
        of_level = free_run_error(level, y, u, run)
        rival = next((m for m in besides if all(m.settling(i) for i in ramps)), None)
        if rival is not None and free_run_error(rival, y, u, run) >= of_level:
            rival = None
        if rival is None and of_level <= min(AS_GOOD_ERROR * error, INTEGRATOR_UNEXPLAINED * _motion(y, run)):
            return replace(level, sure=True)
    for beside in besides:
        if not _within_lines(beside, len(plain.rows) / beside.slow):
            continue
        if not _differ(plain, beside):
            return replace(plain, sure=True)
        if free_run_error(beside, y, u, run) <= AS_GOOD_ERROR * error:
            return replace(beside, sure=True)
    return plain if rival is None else rival


def _within_lines(model: Linear, length: float) -> bool:
    """Whether every answer settles well within ``length`` rows."""
    settling = [model.settling(i) for i, strength in model.strength.items() if strength > STRONG_INPUT]
    return bool(settling) and all(0 < rows * KNOT_SETTLINGS <= length for rows in settling)


def _differ(one: Linear, other: Linear) -> bool:
    """Whether two models disagree on a gain or a settling time."""
    for i, strength in other.strength.items():
        if strength > STRONG_INPUT:
            a, b = (m.settling(i) for m in (one, other))
            gains = [float(m.step_response(i)[-1]) for m in (one, other)]
            if not a or a > DRIFT_SETTLING_RATIO * b or abs(gains[0] - gains[1]) > DRIFT_GAIN_CHANGE * abs(gains[1]):
                return True
    return False


def free_run(model: Linear, u: Sequence[Array], run: NDArray[np.int64]) -> Array:
    """Answer (n,) of the model to the inputs alone from rest at the start of each run (n,); NaN until lags are full."""
    from scipy.signal import lfilter  # half a second to load, here and elsewhere in this room, for who screens alone

    back = model.blocks[-1][1]
    out = np.full(len(run), np.nan)
    edges = np.r_[0, np.flatnonzero(np.diff(run)) + 1, len(run)]
    for start, end in pairwise(edges):
        if end - start <= back + 2:
            continue
        k = np.arange(back - 1, end - start - 1)
        drive = np.zeros(len(k))
        for i, weights in enumerate(model.b):
            drive += answer_of(u[i][start:end] - model.centre[i], k, model.blocks, weights)
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable model
            out[start + back : end] = lfilter([1.0], np.r_[1.0, -model.a], drive)
    return out


def free_run_error(model: Linear, y: Array, u: Sequence[Array], run: NDArray[np.int64]) -> float:
    """Standard deviation of y (n,) about the free run within windows, each about its own mean; inf if it explodes."""
    return _motion(y - free_run(model, u, run), run)


def _motion(rest: Array, run: NDArray[np.int64]) -> float:
    """Standard deviation of what is left (n,) within windows, each about its own mean, NaN left out."""
    ok = np.flatnonzero(~np.isnan(rest))
    length = max(min(FREE_RUN_ROWS, len(ok) // FREE_RUN_WINDOWS), 2)
    m = len(ok) // length
    if not m:
        return float("inf")
    rows = ok[: m * length].reshape(m, length)
    rows = rows[run[rows[:, 0]] == run[rows[:, -1]]]
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.sqrt(np.mean(np.var(rest[rows], axis=1)))) if len(rows) else float("inf")
    return error if np.isfinite(error) else float("inf")
