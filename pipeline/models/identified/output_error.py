"""Output-error fit: Levenberg-Marquardt on the free run, with exact sensitivities and the initial states free."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.linalg import lapack

from loopwright.pipeline.models.identified.dynamics import EXPLODED_STATE, Dynamics, Stretch, propagate
from loopwright.pipeline.models.identified.fresh_errors import rms, sum_of_squares
from loopwright.pipeline.plants.simulator import Array

# ------------------------------------------ sensitivities of free runs, summed to the equations of a Gauss-Newton step
SENSITIVITY_ROWS = 256  # rows whose sensitivities are held at a time


@dataclass(slots=True, eq=False)
class Equations:
    """Sums of a Gauss-Newton step: those of the parameters, and of each stretch's own initial state.

    With J = dy_hat/dtheta and X = dy_hat/dx0: H = J'J, g = J'r, and of each stretch (J'X, X'X, X'r).
    """

    h: Array  # (P, P)
    g: Array  # (P,)
    of_starts: list[tuple[Array, Array, Array]] = field(default_factory=list)
    of_blocks: list[Array] = field(default_factory=list)  # (J'r, X'r) of each SENSITIVITY_ROWS rows

    def solve(self, damping: float, start_damping: float) -> tuple[Array, list[Array]]:
        """The step of the parameters (P,) and of each initial state (n_x,).

        (H + mu I) is reduced by the initial states, of which each touches its own stretch only. The sums are finite,
        see ``sensitivity_sums``: looking at each again takes as long as solving.
        """
        h, g = self.h + damping * np.eye(len(self.h)), self.g.copy()
        solved = []
        for cross, own, right in self.of_starts:
            # LAPACK itself: with a hundred short runs, scipy's checks take longer than the sums that they look at.
            factor, failed = lapack.dpotrf(own + start_damping * np.eye(len(own)), clean=False)
            if failed:
                raise linalg.LinAlgError("the sums of an initial state are not positive definite")
            mean = lapack.dpotrs(factor, right)[0]
            if not len(g):
                solved.append((cross.T, mean))
                continue
            back = lapack.dpotrs(factor, cross.T)[0]
            solved.append((back, mean))
            h = h - cross @ back
            g = g - cross @ mean
        step = g
        if len(g):  # scipy's own solver warns of sums that are nearly singular, which the damping of a next step mends
            factor, failed = lapack.dpotrf(h, clean=False)
            if failed:
                raise linalg.LinAlgError("the sums of the parameters are not positive definite")
            step = lapack.dpotrs(factor, g)[0]
        return step, [mean - back @ step for back, mean in solved]


def sensitivity_sums(
    model: Dynamics, starts: Sequence[Array], data: Sequence[Stretch], free: NDArray[np.bool_], correction: float
) -> Equations | None:
    """The Gauss-Newton sums of the free runs over ``data`` from ``starts``; None where one explodes.

    The sensitivities S = dx/dtheta follow the recursion

        S(k+1) = dF/dx S'(k) + dF/dtheta(x'(k), v(k)),   S' = S but for the outputs: (1 - correction) S[:n_y]

    and those of the initial state the same without the last term; with a filter's gain L, S' = S - L S[:n_y] + dL e.
    """
    n_free, n_x = int(free.sum()), model.n_x
    sums = Equations(np.zeros((n_free, n_free)), np.zeros(n_free))
    columns = np.concatenate([free, np.ones(n_x, dtype=bool)])
    # Another layout in memory would be compiled anew, which takes seconds.
    a, w1, w2 = (np.ascontiguousarray(matrix) for matrix in (model.a, model.w1, model.w2))
    gain, free_run = np.ascontiguousarray(model.filter_gain), model.runner(correction)
    for start, stretch in zip(starts, data, strict=True):
        run = free_run(start, stretch)
        if run is None:
            return None
        predicted, from_states = run
        n_y, all_seen = stretch.y.shape[1], stretch.seen
        own = np.zeros((n_free + n_x, n_free + n_x))
        blocks: list[Array] = []
        width = (len(free) if n_free else 0) + n_x
        s = np.zeros((n_x, width))
        s[:, -n_x:] = np.eye(n_x)
        for first in range(0, len(stretch), SENSITIVITY_ROWS):
            rows = slice(first, first + SENSITIVITY_ROWS)
            z = np.concatenate([from_states[rows], stretch.v[rows]], axis=1)
            history = np.empty((len(z), n_y, width))
            t = np.tanh(z @ model.w1.T + model.b1)
            missed, seen = stretch.y[rows] - predicted[rows, :n_y], all_seen[rows]
            if stretch.fresh is not None:
                missed[~seen] = 0.0
            propagate(a, w1, w2, z, t, 1 - correction, gain, missed, seen, n_free > 0, s, history)
            if stretch.fresh is not None:
                history[~seen] = 0.0
            jac = history.reshape(-1, width)
            if 0 < n_free < len(free):
                jac = jac[:, columns]
            with np.errstate(over="ignore", invalid="ignore"):
                own += jac.T @ jac
                blocks.append(jac.T @ missed.ravel())
        if not np.all(np.isfinite(own)):
            return None
        right = np.sum(blocks, axis=0) if len(blocks) > 1 else blocks[0]
        sums.h += own[:n_free, :n_free]
        sums.g += right[:n_free]
        sums.of_blocks.extend(blocks)
        sums.of_starts.append((own[:n_free, n_free:], own[n_free:, n_free:], right[n_free:]))
    return sums


# ------------------------------------------------------------------------------------------------------------- the fit
DAMPING_GROWTH = 1e10  # of the damping, after which no step is looked for


# ---------------------------------------------------------------------- errors of free runs
def residuals(
    model: Dynamics, starts: Sequence[Array], data: Sequence[Stretch], correction: float = 0.0
) -> list[Array] | None:
    """Residuals y - y_hat (n, n_y) of each stretch, NaN where nothing is read; None where a free run explodes."""
    found, free_run = [], model.runner(correction)
    for start, stretch in zip(starts, data, strict=True):
        run = free_run(start, stretch)
        if run is None:
            return None
        found.append(stretch.errors(run[0][:, : stretch.y.shape[1]]))
    return found


def squares(model: Dynamics, starts: Sequence[Array], data: Sequence[Stretch], correction: float = 0.0) -> float:
    """Sum of squared residuals over all stretches; infinite where a free run explodes."""
    found = residuals(model, starts, data, correction)
    return np.inf if found is None else sum_of_squares(found)


def fit_starts(
    model: Dynamics,
    data: Sequence[Stretch],
    correction: float = 0.0,
    starts: Sequence[Array] | None = None,
    iterations: int = 10,
) -> list[Array]:
    """The initial state (n_x,) of each stretch that fits its free run best, by damped Gauss-Newton.

    It starts from ``starts``; or from the first outputs with the hidden states at zero, or where they settle under
    the first inputs, whichever fits better.
    """
    nothing = np.zeros(len(model.vector()), dtype=bool)
    found = []
    tried = _guesses(model, data) if starts is None else [[x] for x in starts]
    for stretch, guesses in zip(data, tried, strict=True):
        errors = [squares(model, [x], [stretch], correction) for x in guesses]
        best, x0 = min(errors), guesses[int(np.argmin(errors))]
        for _ in range(iterations if np.isfinite(best) else 0):
            sums = sensitivity_sums(model, [x0], [stretch], nothing, correction)
            if sums is None:
                break
            weight = 1e-7 * float(np.trace(sums.of_starts[0][1])) + 1e-9
            step = sums.solve(0.0, weight)[1][0]
            trial = x0 + step
            error = squares(model, [trial], [stretch], correction)
            if not error < best:
                trial = x0 + 0.3 * step
                error = squares(model, [trial], [stretch], correction)
            if not error < best:
                break
            settled, best, x0 = error > best * (1 - 1e-5), error, trial
            if settled:
                break
        found.append(x0)
    return found


def _guesses(model: Dynamics, data: Sequence[Stretch], periods: int = 100) -> list[list[Array]]:
    """Initial states (n_x,) of each stretch with its first outputs: hidden states zero, and settled under its input."""
    n_y = data[0].y.shape[1]
    first = np.array([s.y[0] for s in data])
    zero = np.hstack([first, np.zeros((len(data), model.n_x - n_y))])
    # A product for each stretch, side by side: one of all would round them otherwise.
    x, v = zero[:, None, :], np.array([s.v[0] for s in data])[:, None, :]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(periods):
            x = model.advance(x, v)
    settled = np.hstack([first, x[:, 0, n_y:]])
    kept = np.all(np.abs(settled) < EXPLODED_STATE, axis=1)
    return [[a, b] if within else [a] for a, b, within in zip(zero, settled, kept, strict=True)]


def free_run_error(
    model: Dynamics, data: Sequence[Stretch], correction: float = 0.0, starts: Sequence[Array] | None = None
) -> tuple[Array, list[Array]]:
    """(rms of each output's residual (n_y,), initial states) over ``data``, the initial states fitted to it.

    From ``starts`` that fitted a model nearby one step is enough.
    """
    starts = fit_starts(model, data, correction, starts, iterations=10 if starts is None else 1)
    found = residuals(model, starts, data, correction)
    if found is None:
        return np.full(data[0].y.shape[1], np.inf), starts
    return rms(np.concatenate(found)), starts


def overall(errors: Array) -> float:
    """One figure of the outputs' scaled errors (n_y,): their root mean square."""
    return float(np.sqrt(np.mean(errors**2)))


# ---------------------------------------------------------------------- the fit
@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A fitted model, the initial states of its training stretches, and its errors (scaled, over all outputs).

    ``against`` are the pairs of output and input whose gain contradicts what is known of them, see ``Knowledge``.
    ``wild`` is a network that does not settle where the plant does, in a round that goes on.
    """

    model: Dynamics
    starts: list[Array]
    trained: float
    held_out: float
    work: int  # iterations that led here
    against: frozenset[int] = frozenset()
    wild: bool = False


@dataclass(frozen=True, kw_only=True)
class OutputErrorFit:
    """Levenberg-Marquardt for min over theta, x0 of mean (y - y_hat)^2 + ridge |theta_ridged|^2.

    The ridge weight is ``ridge`` times the variance of the present residual over the number of residuals, and acts on
    W1 and W2 alone. Damping follows Nielsen's rule. Held-out rows are judged by free runs with the correction
    ``judged``. ``patience`` iterations without a better held-out error end the fit; the best model is kept.

    Source: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for non-linear least squares problems, 2nd ed.,
    DTU 2004, algorithm 3.16; L. Ljung, System identification, 2nd ed., 1999, section 10.3 (output error).
    """

    iterations: int = 30
    correction: float = 0.0
    judged: float = 0.0
    ridge: float = 0.0
    patience: int = 10
    tolerance: float = 1e-4  # relative gain of an iteration below which three in a row end the fit

    def fit(
        self,
        model: Dynamics,
        data: Sequence[Stretch],
        held: Sequence[Stretch] = (),
        *,
        free: NDArray[np.bool_] | None = None,
        starts: Sequence[Array] | None = None,
        judge: Callable[[Dynamics], float] | None = None,
    ) -> Fitted:
        """The fitted model. ``free`` (P,) masks the parameters that may change; ``held`` rows choose the iterate.

        ``judge`` gives the error of a model over them; None: of its free runs.
        """
        free = model.free() if free is None else free
        starts = fit_starts(model, data, self.correction) if starts is None else list(starts)
        judge = self._judge(held) if judge is None else judge
        n = sum(s.count for s in data)
        loss = squares(model, starts, data, self.correction)
        best = Fitted(model, starts, float(np.sqrt(loss / n)), judge(model), 0)
        mu, grow, since, flat, work = -1.0, 2.0, 0, 0, 0
        for iteration in range(1, self.iterations + 1):
            work = iteration
            sums = sensitivity_sums(model, starts, data, free, self.correction)
            if sums is None:
                break
            weights = self._ridge(model, free, loss, n)
            if mu < 0:
                mu = 1e-3 * _scale(sums)
            moved = self._step(model, starts, data, free, sums, weights, loss, mu, grow)
            if moved is None:
                break
            after, mu, grow, model, starts = moved
            flat = flat + 1 if loss - after < self.tolerance * loss else 0
            loss = after
            error = judge(model)
            since = 0 if error < best.held_out else since + 1
            if error < best.held_out or not held:
                best = Fitted(model, starts, float(np.sqrt(loss / n)), error, work)
            if flat >= 3 or (held and since >= self.patience):
                break
        return replace(best, work=work)

    def _judge(self, held: Sequence[Stretch]) -> Callable[[Dynamics], float]:
        memory: list[list[Array] | None] = [None]

        def error(model: Dynamics) -> float:
            if not held:
                return np.inf
            errors, starts = free_run_error(model, held, self.judged, memory[0])
            if np.all(np.isfinite(errors)):
                memory[0] = starts
            return overall(errors)

        return error

    def _ridge(self, model: Dynamics, free: NDArray[np.bool_], loss: float, n: int) -> Array:
        """Weight (P free,) of each parameter's square beside the sum of squared residuals."""
        return self.ridge * loss / n * model.mask(w1=True, w2=True)[free].astype(np.float64)

    def _step(
        self,
        model: Dynamics,
        starts: list[Array],
        data: Sequence[Stretch],
        free: NDArray[np.bool_],
        sums: Equations,
        weights: Array,
        loss: float,
        mu: float,
        grow: float,
    ) -> tuple[float, float, float, Dynamics, list[Array]] | None:
        """One step that lowers the objective: (loss, mu, growth, model, initial states); None where there is none."""
        theta = model.vector()
        now = theta[free]
        gradient = sums.g - weights * now
        total, ceiling = loss + float(weights @ now**2), DAMPING_GROWTH * _scale(sums)
        ridged = Equations(sums.h + np.diag(weights), gradient, sums.of_starts)
        while mu < ceiling:
            try:
                step, moves = ridged.solve(mu, 1e-3 * mu + 1e-9)
            except linalg.LinAlgError:
                mu, grow = mu * grow, grow * 2
                continue
            trial = theta.copy()
            trial[free] += step
            candidate = model.with_vector(trial)
            begun = [x + move for x, move in zip(starts, moves, strict=True)]
            after = squares(candidate, begun, data, self.correction)
            gain = total - after - float(weights @ trial[free] ** 2)
            right = sum(float(move @ s[2]) for move, s in zip(moves, sums.of_starts, strict=True))
            promised = float(step @ (mu * step + gradient)) + right
            if gain > 0:
                ratio = gain / max(promised, 1e-300)
                return after, mu * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 2.0, candidate, begun
            mu, grow = mu * grow, grow * 2
        return None


def _scale(sums: Equations) -> float:
    diagonal = np.concatenate([np.diag(sums.h), *(np.diag(s[1]) for s in sums.of_starts)])
    return float(diagonal.max())
