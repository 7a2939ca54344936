"""Figures of a response to a step: its first answer, its settling, its late motion, and the lag that resembles it.

A response y (..., n) is the change of an output, the time on the last axis. An index k counts from the first value that
is given. Where that value stands one period after the step, and not at the step, k + 1 periods have passed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# ------------------------------------------------------------------------------------------------ first answer
# of the fastest change in a period, from which an output has answered, of step responses without noise; of its end, for
# an inverse response. A lag that begins slowly, as the second of two, has not answered yet. Used by: the responses near
# a plant's start (tuning of PIDs, suitability of laws), the first answers of an identified model (its law, its report,
# its controllers' manifests and so their monitors), those of a plant in equations in manifests
ANSWERED_CHANGE = 0.1
# periods from where an input acts on, in which the fastest change is sought: as far as predictive control looks ahead.
# A slow pole that a record leaves open would make a later one. Used by: all of these first answers
ANSWER_PERIODS = 60
# of the largest value of a response: all that is no rounding of simulated differences. Used by: the first answers near
# a plant's start
RESPONSE_ROUNDING = 1e-9
# of the largest value of an impulse response that a high-order ARX estimated, for its errors are seen too. Used by: the
# dead time that a linear candidate is offered, which its held-out error takes or refuses
VISIBLE_CHANGE = 1 / 6
# of the largest move in a period, of a linearized plant: all that is no error of a difference. Used by: the lags that
# resemble a plant, whose dead time must be a true one
CV_ANSWERED = 1e-6
# of a response's whole change, and not of a change in a period: so much of the answer has come. Used by: whether the
# horizon of a predictive law reaches the first answer
BEGUN = 0.01
# of a controlled variable's range, a level too: all that is no rounding. Used by: whether an MV moves a variable of a
# plant in equations at all
SEEN_CV_MOVE = 1e-6


def first_beyond(size: Array, least: ArrayLike) -> NDArray[np.int64]:
    """Index of the first value above a limit; n where none is.

        k = min { k : size(k) > least }

    Sizes (..., n), limits (...,) in their unit. Returns indices (...,).
    """
    above = size > np.asarray(least, dtype=np.float64)[..., None]
    return np.where(above.any(axis=-1), above.argmax(axis=-1), size.shape[-1])


def first_change(change: Array, share: float) -> NDArray[np.int64]:
    """Index of the first change in a period that is more than a share of the fastest; n where nothing moves.

        k = min { k : |h(k)| > share max |h| }

    ``change`` h (..., n) is an impulse response, or the differences of a step response. Returns indices (...,).
    """
    size = np.abs(change)
    return first_beyond(size, share * size.max(axis=-1))


def answers_after(y: Array, share: float = ANSWERED_CHANGE) -> NDArray[np.int64]:
    """Periods (...,) from the step to the first answer: one without a dead time, n + 1 where nothing moves.

        k = min { k >= 1 : |y(k) - y(k-1)| > share max_j |y(j) - y(j-1)| },   y(0) = 0

    The first of y (..., n) stands one period after the step. The dead time is one period less.
    """
    return first_change(np.diff(y, prepend=0.0), share) + 1


def first_answer_within(y: Array, least: float, periods: int = ANSWER_PERIODS) -> int | None:
    """Periods from the step to the first answer of one response y (n,); None where no value is beyond ``least``.

        k = b + answers_after(y(b+1), ..., y(b + periods)),   b = min { k : |y(k+1)| > least }

    ``least`` in the unit of y is all that is rounding. The fastest change is that of some ``periods`` from the first
    one on: however long the dead time and the response, the answer is the same.
    """
    begins = int(first_beyond(np.abs(y), least)) if len(y) else 0
    return begins + int(answers_after(y[begins : begins + periods])) if begins < len(y) else None


# ------------------------------------------------------------------------------------------------ settling time
# of a response's largest value: the usual 5 %, of responses without noise. Used by: the responses near a plant's start,
# the holds of an own plant's tests, the settling in the first step test of a simulator
SETTLED_BAND = 0.05
# of the end, of responses that were estimated from a record, whose noise hides more than 5 %. Used by: the ARX model
# and the impulse response of the screening
SETTLED_IN_RECORD = 0.1
# of the change from the first value to the end, of an identified model's responses, which come from a record too. Used
# by: the horizon of a predictive law
SETTLED_IN_HORIZON = 0.1
# of the largest value, of answers in blocks of lags, which are the least exact of all. Used by: how long the blocks of
# rows must be beside which a drift is sought
SETTLED_BESIDE_DRIFT = 0.15


def settled_index(distance: Array, band: ArrayLike) -> NDArray[np.int64]:
    """Index of the first value from which on all lie within a band; n where the last one lies outside.

        k = min { k : distance(j) <= band  for all j >= k }

    Distances (..., n) from where it settles, the band (...,) or of each value (..., n). Returns indices (...,).
    """
    limit = np.asarray(band, dtype=np.float64)
    outside = distance > (limit if limit.ndim == distance.ndim else limit[..., None])
    n = distance.shape[-1]
    return np.where(outside, np.arange(1, n + 1), 0).max(axis=-1, initial=0)


def settling_index(y: Array, band: ArrayLike) -> NDArray[np.int64]:
    """Index of the first value from which on a response y (..., n) stays within a band of its end.

        k = min { k : |y(j) - y(n-1)| <= band  for all j >= k }

    The band in the unit of y, (...,) or of each value (..., n). Returns indices (...,), 0 where it never leaves it.
    """
    return settled_index(np.abs(y - y[..., -1:]), band)


# ------------------------------------------------------------------------------------------------ late motion
# of a response's largest change, as the farthest that it is from its end over its last fifth: it has settled, and its
# last value is its gain. Used by: the responses near a plant's start
STILL_RESPONSE = 0.01
# of the largest change of all responses, from the last fifth to the end: they are long enough to be drawn. Used by: the
# responses in the report of an identified model
STILL_CURVE = 0.02
# of the change, as the span over the last fifth of the longest run: more does not settle. A shorter run ends where it
# is no more than this part of SETTLED_BAND. Used by: the first step test of a simulator
STILL_MOVES = 0.1
# of its last value, that an answer gains in its last fifth: it goes on; a ramp gains a fifth. Used by: the uncertainty
# of an identified model
GOES_ON = 0.1
# of the CV's visited range, over the last quarter of RESTING periods: more does not settle. Set points lie in that
# range. Used by: the tests of an own plant
UNSETTLED_CV = 0.05
# of a difference, over RESTING periods at its late rate: more does not settle, and its gain is a rate. Used by: the
# local gains of an own plant
NEVER_SETTLES = 0.2
# of the set point's range, over the last fifth of a run: not at rest. Used by: the set points of tuning loops
NOT_AT_REST = 0.01
# of its slope in the middle third, that a response keeps over its last third: it goes on for ever, as an integrator's,
# which keeps it all. Used by: the horizon of a predictive law, the settling that the screening sees
SLOPE_KEPT = 0.9
# relative difference of the slopes over the last two fifths: the same, so that no longer run is needed. Used by: the
# responses near a plant's start
EVEN = 0.05
# of a response's largest change, that its last slope makes over all of it: less is a creeping rest, and no integrator.
# Used by: the responses near a plant's start
RAMP_SLOPE = 0.5


def late_change(y: Array, periods: int) -> Array:
    """Change (...,) of a response y (..., n) over its last periods, in its unit: y(n-1) - y(n-1 - periods)."""
    return np.asarray(y[..., -1] - y[..., -1 - periods])


def late_slope(y: Array, periods: int) -> Array:
    """Mean slope (...,) of a response y (..., n) over its last periods, in its unit a period.

        (y(n-1) - y(n-1 - periods)) / periods

    It is the gain of an integrator, whose response to a unit step goes on at this slope.
    """
    return late_change(y, periods) / periods


def late_distance(y: Array, periods: int) -> Array:
    """Largest distance (...,) of a response y (..., n) from its end over its last periods, in its unit."""
    return np.asarray(np.abs(y[..., y.shape[-1] - 1 - periods :] - y[..., -1:]).max(axis=-1))


def slope_thirds(slope: Array) -> tuple[Array, Array, Array]:
    """Medians (...,) of slopes (..., n) over the first, the middle and the last third of a response.

    A response that settles loses its slope; one that integrates keeps SLOPE_KEPT of it from the middle third to the
    last.
    """
    begun, middle, end = (np.median(part, axis=-1) for part in np.array_split(slope, 3, axis=-1))
    return begun, middle, end


# ------------------------------------------------------------------------------------------------ the lag alike
TWO_POINTS = (0.283, 0.632)  # shares 1 - exp(-1/3) and 1 - 1/e of a lag's end, at theta + tau / 3 and theta + tau


def reached(rising: Array, share: float) -> float:
    """Samples, between two where it lies there, until a response (n,) is at ``share`` > 0 for the first time.

    It is 0 at the step, and its first value stands one sample later. One that never gets there gives n.
    """
    k = int((rising >= share).argmax())
    if not rising[k] >= share:
        return float(len(rising))
    before = float(rising[k - 1]) if k else 0.0
    return k + (share - before) / (float(rising[k]) - before)


def two_point_lag(rising: Array, period_s: float) -> tuple[float, float]:
    """Time constant and dead time [s] of the lag that passes 28 % and 63 % of its end where a response (n,) does.

        tau = 1.5 (t63 - t28),   theta = t63 - tau

    ``rising`` is the response over its end, one period a sample from one period after the step on. The time constant is
    no less than half a period, the dead time no less than 0.

    Source: Smith and Corripio, Principles and Practice of Automatic Process Control, section 7-2.3.
    """
    t28, t63 = (period_s * reached(rising, share) for share in TWO_POINTS)
    tau = max(1.5 * (t63 - t28), period_s / 2)
    return tau, max(0.0, t63 - tau)


def ramp_delay(periods: float, value: float, slope: float) -> float:
    """Periods by which a ramp comes later than one that begins at the step: dead time and lags together.

        theta = t - y(t) / slope

    ``value`` y(t) is its value after ``periods`` t, on the line that it ends on; ``slope`` not 0, in its unit a period.
    """
    return periods - value / slope


def starts_inverse(rising: Array, share: float = ANSWERED_CHANGE) -> bool:
    """Whether a response (n,), its sign such that it ends above 0, first goes below it by a share of its end.

    min_k y(k) < -share |y(n-1)|
    """
    return bool(rising.min() < -share * abs(rising[-1]))
