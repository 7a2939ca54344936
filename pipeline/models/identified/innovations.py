"""A model with its noise: the innovations form, with a load at each output and a filter's gain, by prediction errors.

A free run is misled where loads wander or a controller acts: the load is most of its error, and under feedback the
controller, read backwards, explains it best. The errors of one-step predictions are not, if the model of the noise can
be right.

Source: L. Ljung, System identification, 2nd ed., 1999, sections 4.3 (innovations form), 8.5 and 13.4 (feedback).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.fresh_errors import covariance_of, rms
from loopwright.pipeline.models.identified.output_error import Fitted, OutputErrorFit, fit_starts, residuals
from loopwright.pipeline.plants.simulator import Array

LOADS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
"""Variances of a load's change a row, over that of the measurement, from which a fit may begin."""

STATE_ERRORS = (0.03, 1.0)
"""Variances of the states' errors, over that of the measurement."""

BURN_IN = 0.1  # share of a stretch in which the filter forgets its start, within LEAST_BURN_IN to MOST_BURN_IN rows
LEAST_BURN_IN, MOST_BURN_IN = 20, 300
"""Rows at the beginning of a stretch that do not count while the filter forgets its start: a share, and its ends."""

PREDICTED_AHEAD = 30
"""Rows that figures of a model with its noise are predicted ahead, at most: about as far as a controller looks."""

ALIKE_OUTPUTS = 1e-6
"""Share of the innovations' variance that two outputs do not have in common."""

LEAST_NOISE_SHARE = 0.01
"""Share of an innovation's variance that is at least measurement noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Innovations(Dynamics):
    """The state equation with loads and the gain of its filter.

        x' = x + L e,   e = y - x[:n_y],   x+ = F(x', v)

    The last n_y states are loads: random walks d that are added to the outputs' own rows of the plant's equation.
    """

    gain: Array  # (n_x, n_y) L

    @property
    def filter_gain(self) -> Array:
        """L."""
        return self.gain

    @property
    def n_loads(self) -> int:
        """Number of loads."""
        return int(self.gain.shape[1])

    @property
    def plant(self) -> Dynamics:
        """The plant without its loads."""
        n = self.n_x - self.n_loads
        w1 = np.concatenate([self.w1[:, :n], self.w1[:, self.n_x :]], axis=1)
        return Dynamics(self.a[:n, :n], self.b[:n], self.c[:n], w1, self.b1, self.w2[:n])

    def free(self) -> NDArray[np.bool_]:
        """Mask (P,) of what a fit changes: all but how the loads go on and where they act."""
        of_plant = np.arange(self.n_x) < self.n_x - self.n_loads
        of_input = np.concatenate([of_plant, np.ones(self.n_v, dtype=np.bool_)])
        column = of_plant[:, None]
        return self.mask(a=column & of_plant, b=column, c=of_plant, w1=of_input[None, :], b1=True, w2=column, gain=True)

    def rescaled(self, size: Array) -> Innovations:
        """The model of the outputs and the loads over ``size`` (n_y,)."""
        n_y = len(size)
        unit = np.ones(self.n_x)
        unit[:n_y], unit[self.n_x - n_y :] = size, size
        w1 = self.w1.copy()
        w1[:, : self.n_x] *= unit
        return Innovations(
            self.a * unit / unit[:, None],
            self.b / unit[:, None],
            self.c / unit,
            w1,
            self.b1,
            self.w2 / unit[:, None],
            self.gain * size / unit[:, None],
        )


def with_loads(plant: Dynamics, n_y: int) -> Innovations:
    """The plant with a load at each of its ``n_y`` outputs, and no gain yet."""
    n, n_x = plant.n_x, plant.n_x + n_y
    a = np.eye(n_x)
    a[:n, :n] = plant.a
    a[:n_y, n:] = np.eye(n_y)
    w1 = np.concatenate([plant.w1[:, :n], np.zeros((plant.n_hidden, n_y)), plant.w1[:, n:]], axis=1)
    none = np.zeros((n_y, 1))
    return Innovations(
        a,
        np.concatenate([plant.b, none * np.zeros(plant.n_v)]),
        np.concatenate([plant.c, np.zeros(n_y)]),
        w1,
        plant.b1,
        np.concatenate([plant.w2, none * np.zeros(plant.n_hidden)]),
        np.zeros((n_x, n_y)),
    )


def filter_gain(a: Array, n_y: int, errors: float, loads: float) -> Array | None:
    """Stationary gain L (n_x, n_y) of the Kalman filter of x+ = A x + w, y = x[:n_y] + e; None without one.

    e has variance 1, w ``errors`` in the states of the plant and ``loads`` in its last n_y states, the loads.
    """
    q = np.full(len(a), errors)
    q[len(a) - n_y :] = loads
    c = np.eye(n_y, len(a))
    try:
        p = linalg.solve_discrete_are(a.T, c.T, np.diag(q), np.eye(n_y))
    except (linalg.LinAlgError, ValueError):
        return None
    return np.asarray(p[:, :n_y] @ np.linalg.inv(p[:n_y, :n_y] + np.eye(n_y)))


def forgetting(model: Innovations, covariance: Array) -> Innovations:
    """The model whose filter forgets its start; as it is where it does, where it has units, or where none is found.

    A free gain L may leave the filter, A - A L C, a pole z beyond 1, where a slow state of the plant and a load are
    hard to tell apart: from fitted starts it foresees thousands of rows, and then runs away. Another gain L' has the
    same spectrum with 1/z in its place, by the stabilizing solution P of

        P = A P A' + A L R (A L)' - A L' S (A L')',   S = C P C' + R,   L' S = P C' + L R

    with R the ``covariance`` (n_y, n_y) of the innovations.

    Source: B. D. O. Anderson, J. B. Moore, Optimal filtering, 1979, section 9.3 (innovations representations).
    """
    n_y, a, gain = model.gain.shape[1], model.a, model.gain
    r = covariance + ALIKE_OUTPUTS * np.trace(covariance) * np.eye(n_y)  # outputs may be copies of each other
    c = np.eye(n_y, model.n_x)
    if model.n_hidden or np.abs(np.linalg.eigvals(a - a @ gain @ c)).max() < 1:
        return model
    drive = a @ gain
    try:
        p = linalg.solve_discrete_are(a.T, c.T, drive @ r @ drive.T, r, s=drive @ r)
        found = replace(model, gain=(p[:, :n_y] + gain @ r) @ np.linalg.inv(p[:n_y, :n_y] + r))
    except (linalg.LinAlgError, ValueError):
        return model
    return found if np.abs(np.linalg.eigvals(a - a @ found.gain @ c)).max() < 1 else model


def innovations(model: Dynamics, data: Sequence[Stretch]) -> Array | None:
    """One-step errors (n, n_y) over rows that count, NaN where nothing is read; None where the filter explodes.

    The filter starts from the first outputs with all else at zero, and ``BURN_IN`` of each stretch, 20 to 300 rows,
    goes by before its errors count; of a stretch that is no longer the second half does.
    """
    found = []
    n_y = data[0].y.shape[1]
    for stretch in data:
        run = _filtered(model, stretch)
        if run is None:
            return None
        found.append(stretch.errors(run[:, :n_y])[_begins(stretch) :])
    return np.concatenate(found)


def ahead(model: Innovations, stretch: Stretch, rows: int = PREDICTED_AHEAD) -> tuple[Array, Array]:
    """(measured, predicted) (n, n_y) over the rows that count, predicted 1 to ``rows`` rows ahead in turn.

    Measured is NaN where an output is no new reading. Every ``rows`` rows a run without correction begins from the
    filter's state. Not finite where one explodes.
    """
    n_y, begins = stretch.y.shape[1], _begins(stretch)
    states, free = _filtered(model, stretch), replace(model, gain=np.zeros_like(model.gain))
    predicted = np.full((len(stretch), n_y), np.nan)
    for first in range(begins, len(stretch) if states is not None else 0, rows):
        part = slice(first, first + rows)
        run = None if states is None else free.free_run(states[first], Stretch(stretch.y[part], stretch.v[part]))
        if run is not None:
            predicted[part] = run[0][:, :n_y]
    return stretch.errors(np.zeros_like(stretch.y))[begins:], predicted[begins:]


def load_moves(model: Innovations, data: Sequence[Stretch]) -> Array:
    """Changes (n, n_y) of the loads from row to row, as the filter sees them, over all rows that count.

    No change stands for the step from one stretch to the next. Empty where the filter explodes.
    """
    found = [np.empty((0, model.n_loads))]
    for stretch in data:
        states = _filtered(model, stretch)
        if states is None:
            return found[0]
        found.append(np.diff(states[_begins(stretch) :, model.n_x - model.n_loads :], axis=0))
    return np.concatenate(found)


def _filtered(model: Dynamics, stretch: Stretch) -> Array | None:
    """States (n, n_x) foreseen by the filter from the first outputs, all else at zero; None where it explodes."""
    run = model.free_run(np.r_[stretch.y[0], np.zeros(model.n_x - stretch.y.shape[1])], stretch)
    return None if run is None else run[0]


def _begins(stretch: Stretch) -> int:
    """The first row that counts."""
    return min(int(np.clip(BURN_IN * len(stretch), LEAST_BURN_IN, MOST_BURN_IN)), len(stretch) // 2)


def typical(errors: Array | None) -> float:
    """Geometric mean over the outputs of the rms of errors (n, n_y): their log variances count by their readings."""
    if errors is None:
        return np.inf
    sizes, count = np.log(np.maximum(rms(errors), 1e-12)), np.isfinite(errors).sum(axis=0)
    # An output counts by its readings, as in the log-likelihood.
    return float(np.exp(np.mean(sizes) if count.min() == count.max() else np.average(sizes, weights=count)))


def begun(plant: Dynamics, data: Sequence[Stretch]) -> Innovations:
    """The plant with the loads and the gain that foresee the rows best, of a small grid.

    ModelError where the filter explodes with all of them.
    """
    n_y = data[0].y.shape[1]
    model = with_loads(plant, n_y)
    best, least = None, np.inf
    for errors in STATE_ERRORS:
        for loads in LOADS:
            gain = filter_gain(model.a, n_y, errors, loads)
            if gain is None:
                continue
            trial = replace(model, gain=gain)
            size = typical(innovations(trial, data))
            if size < least:
                best, least = trial, size
    if best is None:
        raise ModelError("no filter of the model follows the record; record more samples or calmer operation")
    return best


# ---------------------------------------------------------------------- the fit
@dataclass(frozen=True, kw_only=True)
class PredictionError:
    """Levenberg-Marquardt on one-step errors, each output's over its own deviation, so that slow ones count as fast.

    Held-out rows choose the iterate by ``typical``, in the units of the data.
    """

    iterations: int
    ridge: float = 0.0
    patience: int = 8

    def fit(
        self, model: Innovations, data: Sequence[Stretch], held: Sequence[Stretch] = (), *, gain_alone: bool = False
    ) -> Fitted:
        """The fitted model; with ``gain_alone`` nothing but the filter's gain changes.

        ModelError where the filter explodes over the data.
        """
        errors = innovations(model, data)
        if errors is None:
            raise ModelError("the filter of the model explodes over its own training rows; record more samples")
        size = np.maximum(rms(errors), 1e-9)
        near, whole = model.rescaled(size), float(np.exp(np.mean(np.log(size))))
        train, late = ([replace(s, y=s.y / size) for s in of] for of in (data, held))

        def judge(trial: Dynamics) -> float:
            return whole * typical(innovations(trial, late)) if late else np.inf

        free = near.mask(gain=True) if gain_alone else near.free()
        fitter = OutputErrorFit(iterations=self.iterations, ridge=self.ridge, patience=self.patience)
        found = fitter.fit(near, train, late, free=free, judge=judge)
        if not isinstance(found.model, Innovations):  # the type of what went in
            raise TypeError(type(found.model).__name__)
        unit = np.ones(model.n_x)
        unit[: len(size)] = unit[model.n_x - len(size) :] = size
        left = np.concatenate(residuals(found.model, found.starts, train) or [errors / size])
        inner, starts, held_out = forgetting(found.model, covariance_of(left)), found.starts, found.held_out
        if inner is not found.model:
            starts, held_out = fit_starts(inner, train), judge(inner)
        model, starts = _about_mean_loads(inner.rescaled(1 / size), [x * unit for x in starts], data)
        return replace(found, model=model, starts=starts, trained=typical(innovations(model, data)), held_out=held_out)


def _about_mean_loads(
    model: Innovations, starts: Sequence[Array], data: Sequence[Stretch]
) -> tuple[Innovations, list[Array]]:
    """The same model with the mean of its loads in the plant's own constant, so that the plant rests as the record."""
    n, n_y = model.n_x - model.n_loads, model.n_loads
    runs = [model.free_run(x, part) for x, part in zip(starts, data, strict=True)]
    if any(run is None for run in runs):
        return model, list(starts)
    mean = np.concatenate([run[1][:, n:] for run in runs if run is not None]).mean(axis=0)
    c, shift = model.c.copy(), np.concatenate([np.zeros(n), mean])
    c[:n_y] += mean
    return replace(model, c=c), [x - shift for x in starts]


def noise_of_filter(model: Innovations, errors: Array) -> Array:
    """Standard deviation (n_y,) of the measurement noise from one-step errors e (n, n_y).

    The filter's gain at the outputs is L = P (P + R)^-1 and the variance of e is P + R; so R = (I - L) cov(e).
    """
    n_y = errors.shape[1]
    covariance = covariance_of(errors)
    left = (np.eye(n_y) - model.gain[:n_y]) @ covariance
    # A filter that believes the measurement wholly still leaves the digits of the transmitter.
    return np.asarray(np.sqrt(np.maximum(np.diag(left), LEAST_NOISE_SHARE * np.diag(covariance))))
