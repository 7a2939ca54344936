"""Uncertainty that a record leaves of its model: gain, speed, dead time, colour of the noise, and models as likely."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.dynamics.step_response import GOES_ON, late_change, reached
from loopwright.pipeline.historian.settling import MOST_PERIODS
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.fresh_errors import changes_of, deviation_of, sum_of_squares
from loopwright.pipeline.models.identified.output_error import residuals, sensitivity_sums
from loopwright.pipeline.plants.simulator import Array

TIME_CONSTANT_RISES = (0.1, 0.63)
"""Shares of its last value between which the time of a step response is its time constant; the first ends dead time."""

OFTEN = 0.1
"""Share of the members whose answers go on, above which all are taken so."""

SD_QUANTILES, SD_MEMBERS = (0.159, 0.841), 8
"""Quantiles one standard deviation from the median of a normal sample, and members from which they are told."""

MOST_COLOUR = 0.95
"""Largest colour of the noise: a slower one is a disturbance."""

LEFT_OUT = 0.05
"""Share of the models' weight left out at either end of their answers: one poor model of many vetoes nothing."""


class ParameterSpread(NamedTuple):
    """Standard deviations over models that are as likely as the fitted one, see ``spread``."""

    gain: Array  # (n_mv,) relative, of the answer that each MV moves most
    pace: Array  # (1,) relative, of the time constant
    dead: Array  # (1,) of the dead time [periods]


def doubt_of(curves: Array, n_mv: int) -> ParameterSpread:
    """From the models' scaled step responses (members, n_v, length, n_y), the MVs' first.

    For each MV the output counts that it moves most. Speed and dead time are those of the MV that is least certain,
    as all inputs of a plant share its dynamics. Answers that go on are taken over the rows that a predictive
    law looks ahead at most: a pole near 1 is never certain, and what it makes of hundreds of rows hides how well the
    first ones are known.
    """
    gain, pace, dead = np.zeros(n_mv), np.zeros(n_mv), np.zeros(n_mv)
    for j in range(n_mv):
        found = _strongest(curves[:, j])
        late = late_change(found, max(found.shape[1] // 5, 1) - 1)
        if np.mean(np.abs(late) > GOES_ON * np.abs(found[:, -1])) > OFTEN:
            found = _strongest(curves[:, j, :MOST_PERIODS])  # another output may be moved most by then
        middle = float(np.median(found[:, -1]))
        if len(found) < 2 or middle == 0.0:
            continue
        gain[j] = spread(found[:, -1]) / abs(middle)
        rises = np.array(
            [[reached(one / one[-1] if one[-1] else one, share) for share in TIME_CONSTANT_RISES] for one in found]
        )
        taken = rises[:, 1] - rises[:, 0]
        pace[j], dead[j] = spread(taken) / max(float(np.median(taken)), 1.0), spread(rises[:, 0])
    return ParameterSpread(gain, np.array([pace.max()]), np.array([dead.max()]))


def _strongest(curves: Array) -> Array:
    """Curves (members, length) of the output moved most at its end, from those of all (members, length, n_y)."""
    return np.asarray(curves[..., int(np.abs(np.median(curves[:, -1], axis=0)).argmax())])


def spread(values: Array) -> float:
    """Standard deviation of values (n,), or half of the middle 68 % where that is less.

    A few members far from all others say little: a drawn pole beyond 1 alone makes a gain of any size.
    """
    whole = float(values.std(ddof=1))
    if len(values) < SD_MEMBERS:
        return whole
    low, high = np.quantile(values, SD_QUANTILES)
    return min(whole, 0.5 * float(high - low))


def colour_of(residuals: Sequence[Array]) -> Array:
    """Colour phi (n_y,) of the measurement noise e from free-run residuals (n, n_y) of each stretch.

        e(k) = phi e(k-1) + w(k),   corr(e(k) - e(k-1), e(k-1) - e(k-2)) = -(1 - phi)/2

    The differences hide what a model misses slowly. Their standard deviation is that of the noise times
    sqrt(2 (1 - phi)); phi is no larger than the residual's own standard deviation allows.
    """
    changes = changes_of(residuals)
    power = np.sum([np.nansum(c**2, axis=0) for c in changes], axis=0)
    lagged = np.sum([np.nansum(c[1:] * c[:-1], axis=0) for c in changes], axis=0)
    white = deviation_of(changes) ** 2 / 2
    most = 1 - white / np.maximum(deviation_of(residuals) ** 2, 1e-300)
    found = np.where(power > 0, 1 + 2 * lagged / np.maximum(power, 1e-300), 0.0)
    return np.clip(found, 0.0, np.clip(most, 0.0, MOST_COLOUR))


# --------------------------------------------------------- models as likely as a fitted one, drawn from its covariance
UNSEEN_EIGENVALUE = 1e-7
"""Eigenvalue of J'J, relative to the largest, below which a direction of the parameters changes no output."""

UNLIKELY_ERROR = 1.3
"""Free-run error over that of the fitted model above which a drawn one is no more as likely."""


Model = TypeVar("Model", bound=Dynamics)


def drawn(
    model: Model,
    starts: Sequence[Array],
    data: Sequence[Stretch],
    count: int,
    correction: float = 0.0,
    seed: int = 0,
) -> list[Model]:
    """At most ``count`` models drawn about ``model``, which is fitted to ``data`` from ``starts``.

        theta* = theta + (J'J)^+ sum_b xi_b (J_b' r_b - mean),   xi_b ~ N(0, 1)

    over blocks b of neighbouring rows: the sandwich covariance, in which the colour of the residual r counts. Draws
    whose free run explodes or errs much more are left out; where all do, the draw is halved, at most four times.

    Source: H. White, Maximum likelihood estimation of misspecified models, Econometrica 50 (1982) 1, eq. 3.2.
    """
    free = model.free()
    sums = sensitivity_sums(model, starts, data, free, correction)
    found = residuals(model, starts, data, correction)
    if sums is None or found is None or len(sums.of_blocks) < 3:
        return []
    n = len(sums.g)
    h, blocks = sums.h.copy(), np.array([b[:n] for b in sums.of_blocks])
    for cross, own, _ in sums.of_starts:
        h -= cross @ np.linalg.solve(own + 1e-9 * np.eye(len(own)), cross.T)
    values, vectors = np.linalg.eigh((h + h.T) / 2)
    kept = values > UNSEEN_EIGENVALUE * values[-1]
    spread = (vectors[:, kept] / values[kept]) @ (vectors[:, kept].T @ (blocks - blocks.mean(axis=0)).T)
    limit = UNLIKELY_ERROR**2 * sum_of_squares(found)
    rng = np.random.default_rng(seed)
    models = []
    for _ in range(count):
        step = spread @ rng.normal(size=len(blocks))
        for _ in range(5):
            theta = model.vector()
            theta[free] += step
            candidate = model.with_vector(theta)
            runs = residuals(candidate, starts, data, correction)
            if runs is not None and sum_of_squares(runs) < limit:
                models.append(candidate)
                break
            step = step / 2
    return models


def weighted_interval(values: Array, weights: Array) -> tuple[Array, Array, Array]:
    """(low, middle, high) of values (members, ...) with weights (members,), ``LEFT_OUT`` of the weight at either end.

    Weights that are all alike leave the least and the largest of few values, and their median.
    """
    order = np.argsort(values, axis=0, kind="stable")
    ranked, share = np.take_along_axis(values, order, axis=0), np.cumsum(weights[order], axis=0) / weights.sum()

    def first(beyond: NDArray[np.bool_]) -> Array:
        at = np.where(beyond.any(axis=0), beyond.argmax(axis=0), len(values) - 1)
        return np.asarray(np.take_along_axis(ranked, at[None], axis=0)[0])

    near = 1e-9  # of rounding
    low, high = (first(share > end) for end in (LEFT_OUT + near, 1 - LEFT_OUT - near))
    middle = 0.5 * (first(share > 0.5 - near) + first(share > 0.5 + near))
    return low, middle, high
