"""Figures of a closed loop.

A test is a sequence of holds: the set point stays for ``hold`` samples and then moves. ``hold = 0``
means that it never moves; the whole test is then one hold. The error of sample k is r(k) - y(k), and
the MV of sample k acts after it. All arrays are float64. The functions of one loop take shape
``(n,)``; ``closed_loop_metrics`` also takes ``(n, loops)``.

A set point may also move within a hold, as in a batch recipe. The figures depend on the errors alone,
so they keep their meaning. The step is then the error at the first sample of the hold, the overshoot
is the distance beyond the moving set point, and the loop settles when it reaches the set point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopwright.pipeline.dynamics.step_response import settled_index
from loopwright.pipeline.evaluation.metric import METRICS, TRAVEL
from loopwright.pipeline.metrics import errors, ise, mv_travel

Array = NDArray[np.float64]

HOLD_END_SAMPLES = 5  # samples at the end of a hold whose mean error is the steady-state error
SMALLEST_STEP = 0.02  # of the CV's range: a smaller move of the set point has no overshoot
STEP_BAND = 0.02  # settled: within this fraction of the step ...
RANGE_BAND = 0.002  # ... or of the CV's range, whichever is wider (a disturbance test has no step)
UNREACHED_ERROR = 0.02  # of what set points move a CV by: a larger error means that the loop has not reached one
# of ``span``, the CV's range or its set points', changes of side: it swings to the end
SWING_SIZE, SWING_CROSSINGS = 0.01, 3
LEFT = 0.25  # of the CV's range: farther beyond its ends a loop has left it


def holds(n: int, hold: int) -> list[slice]:
    """The holds of a test of ``n`` samples; the last one may be shorter."""
    if hold < 0:
        raise ValueError(f"a hold of {hold} samples; it must be >= 0 (0: the set point never moves)")
    size = hold or n
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def sse_late(sp: ArrayLike, pv: ArrayLike, late_from: int) -> float:
    """Sum of squared errors from sample ``late_from`` on, after the start that no controller can speed up.

    Raises ValueError if the test has no such sample, because an empty sum would look perfect.
    """
    error = errors(sp, pv)
    if not 0 <= late_from < error.size:
        raise ValueError(f"late_from is sample {late_from} of a test of {error.size}; give one of 0..{error.size - 1}")
    return float(np.sum(error[late_from:] ** 2))


def itae(sp: ArrayLike, pv: ArrayLike, hold: int, period_s: float) -> float:
    """Integral of time-weighted absolute error, h sum_k t(k) |r(k) - y(k)|, in CV s^2.

    t(k) is the time since the set point moved, so each hold starts again at 0.
    """
    error = np.abs(errors(sp, pv))
    k = np.arange(error.size)
    return float(np.sum(period_s**2 * (k % hold if hold else k) * error))


def steady_errors(sp: ArrayLike, pv: ArrayLike, hold: int, last: int = HOLD_END_SAMPLES) -> Array:
    """Steady-state error of each hold, shape (holds,): |mean of its last ``last`` errors|.

    The mean comes before the absolute value, so measurement noise averages out. An oscillation around
    the set point averages out too; it shows in the MAE.
    """
    error = errors(sp, pv)
    return np.array([abs(float(np.mean(error[part][-last:]))) for part in holds(error.size, hold)])


def masse(sp: ArrayLike, pv: ArrayLike, hold: int) -> float:
    """Mean absolute steady-state error over the holds (MASSE of the paper's Table 4)."""
    return float(np.mean(steady_errors(sp, pv, hold)))


def max_asse(sp: ArrayLike, pv: ArrayLike, hold: int) -> float:
    """Largest absolute steady-state error over the holds (MaxASSE of the paper's Table 4)."""
    return float(np.max(steady_errors(sp, pv, hold)))


def overshoots(sp: ArrayLike, pv: ArrayLike, hold: int, span: float = 1.0) -> Array:
    """Overshoot of each step as a fraction of it, shape (steps,).

        max(0, max_k s (y(k) - r)) / |r - y(0)|,   s = sign(r - y(0))

    over the hold. y(0) is the process variable when the set point moves, so the definition also
    holds after a hold whose set point was not reached. Steps smaller than ``SMALLEST_STEP`` of
    ``span`` (the CV's range) do not count, because their fractions are very large.
    """
    error = errors(sp, pv)
    steps = [part for part in holds(error.size, hold) if abs(error[part][0]) >= SMALLEST_STEP * span]
    return np.array([max(0.0, np.max(-np.sign(e[0]) * e)) / abs(e[0]) for e in (error[part] for part in steps)])


def settling_samples(sp: ArrayLike, pv: ArrayLike, hold: int, span: float = 1.0) -> Array:
    """Samples until the error of each hold stays in its band, shape (holds,).

    The band is the wider of ``STEP_BAND`` of the step and ``RANGE_BAND`` of ``span``. A hold that
    does not settle counts with its whole length.
    """
    error = errors(sp, pv)
    settled = []
    for part in holds(error.size, hold):
        e = np.abs(error[part])
        settled.append(float(settled_index(e, max(STEP_BAND * e[0], RANGE_BAND * span))))
    return np.array(settled)


def lock_ups(
    sp: ArrayLike, pv: ArrayLike, mv: ArrayLike, hold: int, *, low: ArrayLike, high: ArrayLike, span: ArrayLike
) -> list[slice]:
    """The holds in which the loop locks up: it stays saturated and far from a set point.

    In the whole second half of such a hold one MV is at one end of [low, high], and |r - y| of one CV is more
    than ``UNREACHED_ERROR`` of its ``span``, by which set points move it. A slow plant or the heating of a batch may
    saturate for a long time, but the error is smaller after half a hold (half a batch for a recipe). An inverse model
    outside its applicability domain can stay saturated for ever. Shapes (n,), or (n, n_cv) and (n, n_mv) with ranges
    (n_mv,) and spans (n_cv,).
    """
    e = np.abs(errors(sp, pv))
    e = e.reshape(len(e), -1)
    u = np.asarray(mv, dtype=np.float64).reshape(len(e), -1)
    bottom, top, wide = (np.asarray(values, dtype=np.float64) for values in (low, high, span))
    near = 1e-6 * (top - bottom)
    found = []
    for part in holds(len(e), hold):
        half = slice(part.start + (part.stop - part.start) // 2, part.stop)
        stuck = np.all(u[half] <= bottom + near, axis=0) | np.all(u[half] >= top - near, axis=0)
        if stuck.any() and np.all(e[half] > UNREACHED_ERROR * wide, axis=0).any():
            found.append(part)
    return found


def left_limits(pv: ArrayLike, hold: int, *, low: ArrayLike, high: ArrayLike) -> bool:
    """Whether a CV is beyond its range [low, high] (n_cv,) by more than ``LEFT`` of it in the second half of a hold.

    Without holds, as under loads and where a record is replayed, at any time.

    A loop that swings or drifts so far need not be saturated, so that no lock-up tells of it. In the first half a loop
    may overshoot there: on a linear model of twice the gain a step of the set point leads beyond a transmitter's end,
    and back. pv (n, n_cv), without noise. One that is not finite has left.
    """
    y, bottom, top = (np.asarray(values, dtype=np.float64) for values in (pv, low, high))
    room = LEFT * (top - bottom)
    inside = (y >= bottom - room) & (y <= top + room)
    late = (slice((part.start + part.stop) // 2 if hold else 0, part.stop) for part in holds(len(y), hold))
    return not all(np.all(np.asarray(inside)[part]) for part in late)


def last_half(*courses: Array) -> slice:
    """The last half of the samples since any of these last moved: set points, loads, disturbances (n,) or (n, k)."""
    n = len(courses[0])
    moved = [np.flatnonzero(np.diff(course.reshape(n, -1), axis=0).any(axis=1)) for course in courses]
    start = max((int(of[-1]) + 1 for of in moved if len(of)), default=0)
    return slice((start + n) // 2, n)


def swings(sp: Array, cv: Array, span: Array, share: float = SWING_SIZE, *, whole: bool = False) -> NDArray[np.bool_]:
    """The controlled variables (n, n_cv) that still swing about their set points as the course ends.

    Over the last half of the last hold, or over the ``whole`` course, the error goes from one side to the
    other at least SWING_CROSSINGS times, each time beyond a ``share`` of ``span`` (n_cv,).
    """
    error = (cv - sp)[slice(None) if whole else last_half(sp)] / span
    found = np.zeros(error.shape[1], dtype=bool)
    for i, course in enumerate(error.T):
        sides = np.sign(course[np.abs(course) > share])
        found[i] = np.count_nonzero(np.diff(sides)) >= SWING_CROSSINGS
    return found


def closed_loop_metrics(
    sp: ArrayLike, pv: ArrayLike, mv: ArrayLike, hold: int, period_s: float, span: ArrayLike = 1.0, late_from: int = 0
) -> dict[str, float]:
    """The figures of one closed-loop test, ready for JSON.

    Parameters
    ----------
    sp
        Set points, shape (n,) or (n, loops), in the CV's unit.
    pv
        Controlled variables without measurement noise, the same shape; further columns (other
        measured states) are ignored.
    mv
        Manipulated variables, shape (n,) or (n, n_mv); of different units as shares of their ranges, because their
        travel is summed.
    hold
        Samples per set point; 0 where it never moves.
    period_s
        Sampling period [s].
    span
        The CV's range, or one of each; it scales the smallest step and the settling band.
    late_from
        Sample from which ``sse_late`` counts; 0: there is no such figure.

    Returns
    -------
    dict
        Every metric with ``of``, among them ``mae`` [CV] and ``sse`` [CV^2]; ``ise`` [CV^2 s],
        ``masse`` and ``max_asse`` [CV], ``overshoot`` (mean over the steps, fraction of the step;
        0 without steps), ``settling`` [s] (median over the holds), ``mv_travel`` [MV], and
        ``sse_late`` [CV^2] where asked for. Several loops: the mean, or the largest (``Metric.together``).

    Raises
    ------
    ValueError
        For shapes that do not match, values that are not finite, or a ``late_from`` beyond the test.

    """
    r, y, u = (np.asarray(values, dtype=np.float64) for values in (sp, pv, mv))
    r = r.reshape(len(r), -1)
    y = y.reshape(len(y), -1)[:, : r.shape[1]]
    for name, values in (("sp", r), ("pv", y), ("mv", u)):
        if len(values) != len(r) or not np.all(np.isfinite(values)):
            raise ValueError(f"{name} has {len(values)} samples, or some not finite; give {len(r)} finite ones")
    pairs = list(zip(r.T, y.T, strict=True))
    spans = np.broadcast_to(np.asarray(span, dtype=np.float64), (len(pairs),)).tolist()
    over = [overshoots(a, b, hold, s) for (a, b), s in zip(pairs, spans, strict=True)]
    loops = {
        **{m.name: [m.of(a, b) for a, b in pairs] for m in METRICS.values() if m.of},
        "ise": [ise(a, b, period_s) for a, b in pairs],
        "masse": [masse(a, b, hold) for a, b in pairs],
        "max_asse": [max_asse(a, b, hold) for a, b in pairs],
        "overshoot": [float(np.mean(steps)) if steps.size else 0.0 for steps in over],
        "settling": [
            period_s * float(np.median(settling_samples(a, b, hold, s))) for (a, b), s in zip(pairs, spans, strict=True)
        ],
    }
    figures = {name: float(np.max(v) if METRICS[name].together == "max" else np.mean(v)) for name, v in loops.items()}
    figures[TRAVEL] = mv_travel(u)
    if late_from:
        figures["sse_late"] = float(np.mean([sse_late(a, b, late_from) for a, b in pairs]))
    return figures
