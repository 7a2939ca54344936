"""How good a closed loop is, in numbers.

A test is a sequence of holds: the set point stays for ``hold`` samples, then moves. ``hold = 0``
means that it never moves, so the whole test is one hold. At sample k the process variable is
measured, the error r(k) - y(k) is counted, and only then the move acts: set point and process
variable of the same sample belong together. All arrays are float64; the functions of one loop
take shape ``(n,)``, ``closed_loop_metrics`` also ``(n, loops)``.

A set point may also move within a hold, as the recipe of a batch does. Every figure is one of the
errors alone, so it keeps its meaning: a step is then the error at the hold's first sample, its
overshoot how far the process variable runs past the moving set point, and its settling when it
has caught up with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.metrics import errors, ise, mae, mv_travel, sse

Array = NDArray[np.float64]

LAST = 5
"""Samples at the end of a hold whose mean error is the steady-state error."""


SMALLEST_STEP = 0.02
"""Fraction of the CV's range below which a move of the set point is no step to overshoot."""


STEP_BAND = 0.02
"""Settled: within this fraction of the step ..."""


RANGE_BAND = 0.002
"""... or within this fraction of the CV's range, whichever is wider (a disturbance test has no step)."""


FAR = 0.02
"""Fraction of the CV's range beyond which a saturated loop has not arrived."""


def holds(n: int, hold: int) -> list[slice]:
    """The holds of a test of ``n`` samples; the last one may be shorter."""
    if hold < 0:
        raise ValueError(f"a hold of {hold} samples; it must be >= 0 (0: the set point never moves)")
    size = hold or n
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def sse_late(sp: ArrayLike, pv: ArrayLike, late_from: int) -> float:
    """Sum of squared errors from sample ``late_from`` on, once the start that no controller can hasten is over.

    Raises ValueError where the test has no such sample: a sum over nothing would look perfect.
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


def steady_errors(sp: ArrayLike, pv: ArrayLike, hold: int, last: int = LAST) -> Array:
    """Steady-state error of each hold, shape (holds,): |mean of its last ``last`` errors|.

    The mean comes before the absolute value, so that measurement noise averages out instead of
    adding up. A loop that rings around its set point therefore shows in MAE, not here.
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

    over the hold, with y(0) the process variable when the set point moved: the step that the loop
    sees, also after a hold whose set point was not reached. Steps smaller than ``SMALLEST_STEP``
    of ``span`` (the CV's range) are left out: any fraction of nearly nothing is large.
    """
    r, error = np.asarray(sp, dtype=np.float64), errors(sp, pv)
    found = []
    for part in holds(r.size, hold):
        step = error[part][0]
        if abs(step) >= SMALLEST_STEP * span:
            beyond = -np.sign(step) * error[part]
            found.append(max(0.0, float(np.max(beyond))) / abs(step))
    return np.array(found)


def settling_samples(sp: ArrayLike, pv: ArrayLike, hold: int, span: float = 1.0) -> Array:
    """Samples until the error of each hold enters its band for good, shape (holds,).

    The band is the wider of ``STEP_BAND`` of the step and ``RANGE_BAND`` of ``span``. A hold that
    does not settle counts with its whole length.
    """
    error = errors(sp, pv)
    found = []
    for part in holds(error.size, hold):
        e = np.abs(error[part])
        outside = np.nonzero(e > max(STEP_BAND * e[0], RANGE_BAND * span))[0]
        found.append(float(outside[-1] + 1) if outside.size else 0.0)
    return np.array(found)


def locked_up(
    sp: ArrayLike,
    pv: ArrayLike,
    mv: ArrayLike,
    hold: int,
    *,
    low: float,
    high: float,
    span: float,
) -> bool:
    """Whether the loop is stuck in some hold: saturated, far from its set point, and not moving on.

    That is, for the whole second half of a hold the MV sits at one end of [low, high] while
    |r - y| is more than ``FAR`` of ``span``, the CV's range. A slow plant, or a batch that heats up,
    may rightly saturate for long, but it arrives within half a hold (of a recipe: half the batch)
    or gets closer than that; an inverse model asked beyond its data sits there for ever. Shapes (n,).
    """
    e = np.abs(errors(sp, pv))
    u = np.asarray(mv, dtype=np.float64).reshape(e.shape)
    near = 1e-6 * (high - low)
    for part in holds(e.size, hold):
        half = slice(part.start + (part.stop - part.start) // 2, part.stop)
        stuck = bool(np.all(u[half] <= low + near) or np.all(u[half] >= high - near))
        if stuck and bool(np.all(e[half] > FAR * span)):
            return True
    return False


def closed_loop_metrics(
    sp: ArrayLike,
    pv: ArrayLike,
    mv: ArrayLike,
    hold: int,
    period_s: float,
    span: float = 1.0,
    late_from: int = 0,
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
        Manipulated variables, shape (n,) or (n, n_mv).
    hold
        Samples per set point; 0 where it never moves.
    period_s
        Sampling period [s].
    span
        The CV's range, for what counts as a step and as settled.
    late_from
        Sample from which ``sse_late`` counts; 0: there is no such figure.

    Returns
    -------
    dict
        ``mae`` [CV], ``sse`` [CV^2], ``ise`` [CV^2 s], ``masse`` and ``max_asse`` [CV],
        ``overshoot`` (mean over the steps, fraction of the step; 0 without steps), ``settling``
        [s] (median over the holds), ``mv_travel`` [MV], and ``sse_late`` [CV^2] where asked for.
        Several loops: the mean over them, the largest ``max_asse``.

    Raises
    ------
    ValueError
        For shapes that do not match, values that are not finite, or a ``late_from`` beyond the test.

    """
    r = np.asarray(sp, dtype=np.float64)
    y = np.asarray(pv, dtype=np.float64)
    u = np.asarray(mv, dtype=np.float64)
    r = r.reshape(len(r), -1)
    y = y.reshape(len(y), -1)[:, : r.shape[1]]
    for name, values in (("sp", r), ("pv", y), ("mv", u)):
        if len(values) != len(r) or not np.all(np.isfinite(values)):
            raise ValueError(f"{name} has {len(values)} samples, or some not finite; give {len(r)} finite ones")
    loops = []
    for a, b in zip(r.T, y.T, strict=True):
        over = overshoots(a, b, hold, span)
        loops.append(
            (
                mae(a, b),
                sse(a, b),
                ise(a, b, period_s),
                masse(a, b, hold),
                max_asse(a, b, hold),
                float(np.mean(over)) if over.size else 0.0,
                period_s * float(np.median(settling_samples(a, b, hold, span))),
            )
        )
    table = np.array(loops)
    names = ("mae", "sse", "ise", "masse", "max_asse", "overshoot", "settling")
    found = dict(zip(names, map(float, table.mean(axis=0)), strict=True))
    found["max_asse"] = float(table[:, names.index("max_asse")].max())
    found["mv_travel"] = mv_travel(u)
    if late_from:
        found["sse_late"] = float(np.mean([sse_late(a, b, late_from) for a, b in zip(r.T, y.T, strict=True)]))
    return found
