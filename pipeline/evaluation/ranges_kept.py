"""Figures of a loop that operators steer by more than set points: ranges kept, who gave way, rests, profit, travel.

Arrays are float64 in engineering units. Series of one signal have shape ``(n,)``, of several ``(n, signals)``; the
ends of a range are numbers, or one a sample where operators moved them. Sample k of a process variable is measured
before the MV of sample k acts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SECONDS_AN_HOUR = 3_600.0  # s in an hour: profit is told by the hour
AT_A_LIMIT = 1e-6  # of the width between an MV's ends, within which it stands at one: the solver's last digits


def beyond(y: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """How far a variable is outside its range at each sample, max(low - y, 0) + max(y - high, 0), in its unit.

    Raises ValueError where an end is not finite, or the low end is above the high one.
    """
    values, bottom, top = (np.asarray(of, dtype=np.float64) for of in (y, low, high))
    if not (np.isfinite(bottom).all() and np.isfinite(top).all() and np.all(bottom <= top)):
        raise ValueError("a range has an end that is not finite, or a low end above its high one; give low <= high")
    return np.asarray(np.maximum(bottom - values, 0) + np.maximum(values - top, 0), dtype=np.float64)


def share_outside(y: ArrayLike, low: ArrayLike, high: ArrayLike, by: float = 0.0) -> float:
    """Share of the samples, 0 to 1, at which a variable is outside its range by more than ``by`` [its unit].

    ``by`` is what noise or a solver's last digits may hide. Raises ValueError for a bad range or an empty series.
    """
    return float(np.mean(_filled(beyond(y, low, high)) > by))


def mean_beyond(y: ArrayLike, low: ArrayLike, high: ArrayLike) -> float:
    """Mean distance outside the range over all samples, those inside too, in the variable's unit."""
    return float(np.mean(_filled(beyond(y, low, high))))


def most_beyond(y: ArrayLike, low: ArrayLike, high: ArrayLike) -> float:
    """Largest distance outside the range, in the variable's unit; 0 for one that was never outside."""
    return float(np.max(_filled(beyond(y, low, high))))


def profit(y: ArrayLike, u: ArrayLike, y_cost: ArrayLike, u_cost: ArrayLike, period_s: float) -> float:
    """Mean profit per hour, -(3600/h) mean_k (c_y' y(k) + c_u' u(k)), with h = ``period_s``, in the costs' currency.

    y (n, n_y), u (n, n_u); costs per unit and period, (n_y,) and (n_u,), or (n, .) where operators changed them.
    A negative cost is a price that a unit brings. Raises ValueError for a period that is not above 0.
    """
    if not period_s > 0:
        raise ValueError(f"the period is {period_s:g} s; it must be above 0")
    return -SECONDS_AN_HOUR / period_s * float(np.mean(_filled(cost_of(y, y_cost) + cost_of(u, u_cost))))


def cost_of(values: ArrayLike, cost: ArrayLike) -> Array:
    """The cost of each period, sum_i c_i x_i(k), shape (n,), of values (n, signals) and costs (signals,) or (n, .)."""
    x = np.asarray(values, dtype=np.float64)
    found = np.sum(x.reshape(len(x), -1) * np.asarray(cost, dtype=np.float64), axis=1)
    return np.asarray(found, dtype=np.float64)


def gain_share(made: float, before: float, best: float) -> float | None:
    """Share of the profit that could be gained, (made - before) / (best - before); 1 is the optimum.

    All three per hour: what the loop made, what the plant made where it stood, and the optimum. A share of the profit
    itself would depend on where its zero lies, which costs alone do not say. None where nothing was to be gained.
    """
    room = best - before
    return (made - before) / room if room > 1e-9 * max(abs(best), abs(before), 1e-300) else None


def mv_travel_from(mv: ArrayLike, mv0: ArrayLike) -> Array:
    """Travel of each MV in its own unit, sum_k |u(k) - u(k-1)|, with u(-1) = ``mv0``, so that the first move counts.

    mv (n, n_mv), mv0 (n_mv,); shape (n_mv,).
    """
    u = np.asarray(mv, dtype=np.float64)
    u = u.reshape(len(u), -1)
    start = np.broadcast_to(np.asarray(mv0, dtype=np.float64), (u.shape[1],))
    return np.asarray(np.sum(np.abs(np.diff(u, axis=0, prepend=start[None])), axis=0), dtype=np.float64)


def share_clamped(
    mv: ArrayLike, low: ArrayLike, high: ArrayLike, engineered: tuple[float, float] = (-math.inf, math.inf)
) -> float:
    """Share of the samples, 0 to 1, at which an MV (n,) stands at one of its operators' limits.

    An end that is also one of the ``engineered`` range is no operator's, and does not count.
    """
    u, bottom, top = (np.asarray(of, dtype=np.float64) for of in (mv, low, high))
    near = AT_A_LIMIT * np.maximum(top - bottom, np.finfo(np.float64).tiny)
    at_low, at_high = (u <= bottom + near) & (bottom > engineered[0]), (u >= top - near) & (top < engineered[1])
    return float(np.mean(_filled(np.asarray(at_low | at_high, dtype=np.float64))))


def rest_miss(mv: ArrayLike, rest: float, last: int) -> float:
    """Distance of an MV from its resting value at the end, mean |u(k) - rest| of the ``last`` samples, in its unit.

    Raises ValueError where ``last`` is no number of samples of the series.
    """
    u = np.asarray(mv, dtype=np.float64)
    if not 0 < last <= len(u):
        raise ValueError(f"the last {last} samples of {len(u)}; give 1 to {len(u)}")
    return float(np.mean(np.abs(u[-last:] - rest)))


def borne_by_last(violations: Mapping[str, float], ranks: Mapping[str, float]) -> float | None:
    """Share of all violations, 0 to 1, that the ranges of the last rank bear: 1 where every range before it is kept.

    ``violations`` are scaled, as shares of the variables' own ranges, and non-negative; ``ranks`` as operators
    gave them, 1 kept first. None where nothing is violated, or all violated ranges and kept ones have one rank.
    """
    if len({ranks[name] for name in violations}) < 2:
        return None
    total = math.fsum(violations.values())
    last = max(ranks[name] for name in violations)
    borne = math.fsum(v for name, v in violations.items() if ranks[name] == last)
    return borne / total if total > 0 else None


def stretches_outside(y: ArrayLike, low: ArrayLike, high: ArrayLike, by: float = 0.0) -> Sequence[slice]:
    """The stretches of samples during which a variable (n,) is outside its range by more than ``by``, in order."""
    out = np.concatenate([[False], beyond(y, low, high) > by, [False]])
    edges = np.flatnonzero(np.diff(out.astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _filled(values: Array) -> Array:
    if not values.size:
        raise ValueError("the series has no sample; give at least one")
    return values
