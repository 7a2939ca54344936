"""Linear starts: regularized high-order ARX, its impulse response, a balanced realization; or an ARX of few lags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.step_response import VISIBLE_CHANGE, first_change
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord
from loopwright.pipeline.plants.simulator import Array

MOST_ARX_LAGS = 50
"""Most lags of the high-order ARX."""

SCALES = 10.0 ** np.arange(-2.0, 6.5, 1.0)
DECAYS = np.array([0.4, 0.6, 0.75, 0.85, 0.92, 0.96, 0.98])
"""Grids of the prior: variance of the first coefficient over that of the residual, and its decay a lag."""

DEFECTIVE = 1e10
"""Condition of the eigenvectors beyond which they do not carry a matrix."""

UNSTABLE_RESPONSE = 1e3
"""Impulse response, scaled, beyond which the ARX counts as unstable."""


@dataclass(frozen=True, slots=True, eq=False)
class HighOrder:
    """y(k+1) = sum_i A_i y(k-i) + B_i v(k-i) + c, with A (n, n_y, n_y) and B (n, n_y, n_v)."""

    a: Array
    b: Array

    def impulse_response(self, length: int) -> Array:
        """Answers h (length, n_y, n_v) of the outputs 1, 2, .. samples after a unit pulse of each input.

        h_i = B_i + sum_{j < i} A_j h_{i-j}.
        """
        n, n_y, n_v = self.b.shape
        h = np.zeros((length, n_y, n_v))
        with np.errstate(over="ignore", invalid="ignore"):
            for i in range(length):
                past = h[max(i - n, 0) : i][::-1]
                h[i] = (self.b[i] if i < n else 0.0) + np.einsum("jab,jbc->ac", self.a[: len(past)], past)
        return h

    def one_step_errors(self, data: ScaledRecord) -> Array:
        """Errors (n, n_y) of its one-step predictions of the rows that have a whole past, about their mean.

        NaN where an output is no new reading.
        """
        n = len(self.a)
        k = np.concatenate([np.arange(i + n - 1, j - 1) for i, j in data.bounds()])
        errors = data.y[k + 1].copy()
        for i in range(n):
            errors -= data.y[k - i] @ self.a[i].T + data.v[k - i] @ self.b[i].T
        if data.fresh is not None:
            errors[~data.fresh[k + 1]] = np.nan
        return np.asarray(errors - np.nanmean(errors, axis=0))


def high_order_arx(data: ScaledRecord, lags: int | None = None) -> HighOrder:
    """The ARX whose coefficients fall off smoothly and exponentially with the lag, each output by itself.

    Prior: coefficients of one regressor have the tuned-correlated kernel lambda rho^max(i, j); lambda and rho, one
    pair for the outputs' lags and one for the inputs', maximize the marginal likelihood on a grid. Raises
    ModelError where the runs are too short for lags.

    Source: T. Chen, H. Ohlsson, L. Ljung, On the estimation of transfer functions, regularizations and Gaussian
    processes, Automatica 48 (2012) 1525, eqs. 29 and 33.
    """
    n = _lags(data) if lags is None else lags
    n_y, n_v = data.y.shape[1], data.v.shape[1]
    z = np.hstack([data.y, data.v])
    z = z - z.mean(axis=0)
    k = np.concatenate([np.arange(i + n - 1, j - 1) for i, j in data.bounds() if j - i > n])
    # Blocks of one regressor's lags, newest first: psi = phi U sums them up, which makes the prior diagonal.
    psi = np.concatenate([np.cumsum(z[k[:, None] - np.arange(n), i], axis=1) for i in range(n_y + n_v)], axis=1)
    gram = psi.T @ psi
    a, b = np.zeros((n, n_y, n_y)), np.zeros((n, n_y, n_v))
    group = np.repeat(np.r_[np.zeros(n_y, dtype=np.int64), np.ones(n_v, dtype=np.int64)], n)
    for o in range(n_y):
        target = z[k + 1, o]
        increments = _most_likely(gram, psi.T @ target, float(target @ target), len(k), n, group)
        # theta = U e: the coefficient of lag i is the sum of the increments from i on.
        theta = np.cumsum(increments.reshape(n_y + n_v, n)[:, ::-1], axis=1)[:, ::-1]
        a[:, o], b[:, o] = theta[:n_y].T, theta[n_y:].T
    return HighOrder(a, b)


def _lags(data: ScaledRecord) -> int:
    """Lags that leave six rows a coefficient, and that most of the rows can spare."""
    lengths = np.array([j - i for i, j in data.bounds()])
    width = data.y.shape[1] + data.v.shape[1]
    for n in range(min(MOST_ARX_LAGS, len(data) // (6 * width)), 2, -1):
        if np.maximum(lengths - n, 0).sum() >= 0.6 * lengths.sum():
            return n
    raise ModelError(
        f"{len(data)} rows in runs of at most {int(lengths.max())} are too few to identify "
        f"{width} signals; record more samples in longer runs"
    )


def _most_likely(gram: Array, right: Array, square: float, rows: int, n: int, group: NDArray[np.int64]) -> Array:
    """Increments (n_coefficients,) of the ARX under the most likely prior, by a coordinate search over the grids."""
    lag = np.tile(np.arange(1, n + 1), len(group) // n)

    def solve(choice: tuple[int, ...]) -> tuple[float, Array]:
        scale = SCALES[[choice[0], choice[2]]][group]
        decay = DECAYS[[choice[1], choice[3]]][group]
        root = np.sqrt(scale * decay**lag * np.where(lag < n, 1 - decay, 1.0))
        factor = np.linalg.cholesky(np.eye(len(root)) + root[:, None] * gram * root)
        half = np.linalg.solve(factor, root * right)
        left = max(square - float(half @ half), 1e-12 * square)
        likelihood = rows * np.log(left / rows) + 2 * np.log(np.diag(factor)).sum()
        return float(likelihood), root * np.linalg.solve(factor.T, half)

    choice: tuple[int, ...] = (3, 3, 3, 3)
    best, found = solve(choice)
    for _ in range(2):
        before = choice
        for place, grid in enumerate((SCALES, DECAYS, SCALES, DECAYS)):
            for value in range(len(grid)):
                trial = (*choice[:place], value, *choice[place + 1 :])
                if trial != choice:
                    likelihood, solution = solve(trial)
                    if likelihood < best:
                        best, found, choice = likelihood, solution, trial
        if choice == before:
            break
    return found


# ---------------------------------------------------------------------- realization
@dataclass(frozen=True, slots=True, eq=False)
class Realizations:
    """The balanced realizations of every order of one impulse response, from one singular value decomposition."""

    left: Array  # (m n_y, r) observability
    singular: Array  # (r,)
    right: Array  # (r, m n_v)
    weight: Array  # (n_v,) deviation of each input
    n_y: int

    @classmethod
    def of(cls, response: Array, weight: Array) -> Realizations:
        """From an impulse response (2m, n_y, n_v), its inputs weighted by their deviations (n_v,).

        Raises ModelError where it grows without limit.
        """
        if not np.all(np.abs(response) < UNSTABLE_RESPONSE):
            raise ModelError("the high-order ARX is unstable; record more samples or calmer operation")
        m = len(response) // 2
        weighted = response * weight
        rows = weighted[np.arange(m)[:, None] + np.arange(m)]  # (m, m, n_y, n_v)
        hankel = rows.transpose(0, 2, 1, 3).reshape(m * response.shape[1], m * response.shape[2])
        left, singular, right = np.linalg.svd(hankel, full_matrices=False)
        return cls(left, singular, right, weight, response.shape[1])

    def order(self, n: int) -> Dynamics:
        """The realization with n states, the outputs first; ModelError where n cannot carry the outputs.

        Ho and Kalman: the shift of the observability matrix gives A. Poles outside the unit circle are put on it.
        """
        root = np.sqrt(self.singular[:n])
        observability, controllability = self.left[:, :n] * root, root[:, None] * self.right[:n]
        shift = np.linalg.lstsq(observability[: -self.n_y], observability[self.n_y :], rcond=None)[0]
        a, b = within_unit_circle(shift.astype(np.float64)), controllability[:, : len(self.weight)] / self.weight
        c = observability[: self.n_y]
        _, spread, rows = np.linalg.svd(c)
        if n < self.n_y or spread[-1] < 1e-6 * spread[0]:
            raise ModelError(f"{n} states cannot carry {self.n_y} outputs")
        to = np.concatenate([c, spread.mean() * rows[self.n_y :]])
        back = np.linalg.inv(to)
        return Dynamics.linear(to @ a @ back, to @ b)


def within_unit_circle(a: Array, largest: float = 1.0) -> Array:
    """A with the poles beyond ``largest`` moved in to it, along their rays; A itself where there is none.

    Without a full set of eigenvectors all poles are moved in proportion.
    """
    poles, vectors = np.linalg.eig(a)
    size = np.abs(poles)
    if np.all(size <= largest):
        return a
    inside = poles * np.where(size > largest, largest / np.maximum(size, 1e-300), 1.0)
    if np.linalg.cond(vectors) > DEFECTIVE:
        return a * (largest / size.max())
    return np.real(vectors @ np.diag(inside) @ np.linalg.inv(vectors))


def dead_times(response: Array, weight: Array) -> list[int]:
    """Samples before an input's first visible answer, less one, for each input of a response (length, n_y, n_v).

    Visible is what exceeds a sixth of the response's largest value at one of the outputs. The estimate only
    offers a candidate: a held-out error decides for it or for none.
    """
    # An output that an input does not move at all says nothing of its dead time.
    first = first_change(np.moveaxis(response * weight, 0, -1), VISIBLE_CHANGE).min(axis=0)
    return [max(int(d) - 1, 0) if d < len(response) else 0 for d in first]


# --------------------------------------------------------------------------------- an ARX of few lags as a state space
def lagged_start(data: ScaledRecord, y_lags: int, v_lags: int) -> Dynamics:
    """The least-squares ARX in companion form.

        y(k+1) = sum_{i < y_lags} A_i y(k-i) + sum_{j < v_lags} B_j v(k-j) + c
        x(k) = [y(k), .., y(k - y_lags + 1), v(k-1), .., v(k - v_lags + 1)]

    With tanh units in its output rows this is an NNARX; a fit with correction 1 trains it one step ahead, and one
    that frees all rows goes on from there. Raises ModelError where the data do not determine the coefficients.
    """
    n_y, n_v = data.y.shape[1], data.v.shape[1]
    back = max(y_lags, v_lags) - 1
    k = np.concatenate([np.arange(i + back, j - 1) for i, j in data.bounds() if j - i > back + 1] or [np.zeros(0, int)])
    past_y = [data.y[k - i] for i in range(y_lags)]
    past_v = [data.v[k - i] for i in range(1, v_lags)]
    phi = np.column_stack([*past_y, *past_v, data.v[k], np.ones(len(k))])
    if len(k) < 2 * phi.shape[1]:
        raise ModelError(f"{len(k)} rows are too few for {phi.shape[1]} coefficients; record more samples")
    theta = np.linalg.lstsq(phi, data.y[k + 1], rcond=1e-10)[0].T  # (n_y, n_x + n_v + 1)
    n_x = y_lags * n_y + (v_lags - 1) * n_v
    a, b, c = np.zeros((n_x, n_x)), np.zeros((n_x, n_v)), np.zeros(n_x)
    a[:n_y], b[:n_y], c[:n_y] = theta[:, :n_x], theta[:, n_x:-1], theta[:, -1]
    older = y_lags * n_y
    a[n_y:older, : older - n_y] = np.eye(older - n_y)
    if v_lags > 1:
        b[older : older + n_v] = np.eye(n_v)
        a[older + n_v :, older : n_x - n_v] = np.eye(n_x - n_v - older)
    return Dynamics.linear(a, b, c)


def output_rows(model: Dynamics, n_y: int) -> NDArray[np.bool_]:
    """Mask (P,) of the parameters of an NNARX in companion form: the output rows, and the whole input side."""
    rows = np.arange(model.n_x) < n_y
    return model.mask(a=rows[:, None], b=rows[:, None], c=rows, w1=True, b1=True, w2=rows[:, None])


def with_units(model: Dynamics, states: Array, v: Array, n_hidden: int, seed: int) -> Dynamics:
    """A linear model with ``n_hidden`` tanh units that do nothing yet: W1 drawn, W2 zero.

    W1 is drawn in the space of [x, v] whitened over visited rows, states (N, n_x) under v (N, n_v); deviations
    below 2 % of the largest count as that, so that directions without data draw no steep units.
    """
    rng = np.random.default_rng(seed)
    z = np.hstack([states, v])
    middle = z.mean(axis=0)
    _, spread, rows = np.linalg.svd(z - middle, full_matrices=False)
    spread = np.maximum(spread, 0.02 * spread[0]) / np.sqrt(len(z))
    n_z = z.shape[1]
    directions = rng.normal(size=(n_hidden, n_z))
    directions *= rng.uniform(0.3, 1.5, (n_hidden, 1)) / np.linalg.norm(directions, axis=1, keepdims=True)
    w1 = (directions / spread) @ rows
    b1 = rng.uniform(-1, 1, n_hidden) - w1 @ middle
    return Dynamics(model.a, model.b, model.c, w1, b1, np.zeros((model.n_x, n_hidden)))
