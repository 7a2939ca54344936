"""Rests of a record: stretches in which MVs and disturbances stay until the PVs have settled, and their levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.plants.noise import noise_and_change
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

RESTING_TAIL = 0.5  # of the settling time, that a rest goes on once the PVs have settled: its levels are means over it
LEAST_TAIL_ROWS = 8  # rows of the tail at least: a mean over fewer holds the noise of a reading
STILL_PARTS = 4  # parts of a stretch, whose means are compared: a controller under noise moves its MV in every row
# of a signal's visited range, that these means differ from the tail's. A mean that is off by it moves the PV by about
# as much of the PV's range, which no reading shows
STILL_INPUT, STILL_PV = 0.01, 0.01
STILL_ROWS = 0.1  # of an input's visited range, that a row differs from the tail's mean: more is a move
STILL_NOISES = 2.0  # standard errors by which two means of a PV at rest differ by its noise, in 19 of 20 rests
VISITED_SIGNAL = (0.01, 0.99)  # quantiles of a record between which a signal's visited range lies
MOST_RESTS = 40  # that are kept, spread over the record: as many say what a law does there


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRest:
    """Levels of a plant at rest, as means over the ``rows`` of the record from ``first`` on."""

    first: int
    rows: int
    pv: Array  # (n_pv,)
    mv: Array  # (n_mv,)
    dv: Array  # (n_dv,)


def rests_of(record: Record, settling: int, integrating: Sequence[int] = ()) -> tuple[RecordedRest, ...]:
    """Rests of a record, in their order, apart from each other; none where the plant never comes to rest.

    A rest ends a stretch of the settling time and a tail. Each MV and each disturbance stays over all of it, in its
    rows and in the means of its parts; the halves of each PV's tail have the same mean, within what noise explains:

        |mean_j(u) - mean_tail(u)| <= STILL_INPUT range(u),     |u(k) - mean_tail(u)| <= STILL_ROWS range(u),
        |mean_1(y) - mean_2(y)| <= STILL_PV range(y) + STILL_NOISES 2 sd / sqrt(n)

    So an open-loop record rests at the end of each long hold. A record in closed loop rests where its set point stays
    and no load moves. A PV that integrates has to stay over the whole stretch: its slope says that the MVs balance it.

    Parameters
    ----------
    record
        Rows of one or more runs; no rest reaches over two of them.
    settling
        Periods in which the PVs settle after a move of an MV.
    integrating
        Places of the PVs that do not settle under constant MVs.
    """
    tail = max(LEAST_TAIL_ROWS, round(RESTING_TAIL * settling))
    whole = settling + tail
    n = len(record) - whole + 1
    if n < 1:
        return ()
    good = record.run[:n] == record.run[whole - 1 :]
    for u in (*record.mv.T, *record.dv.T):
        good &= _stays(u, whole, tail)
    cuts = np.flatnonzero(np.diff(record.run)) + 1
    noise, _ = noise_and_change(np.split(record.pv, cuts))
    sd = noise if noise.size else np.zeros(record.pv.shape[1])
    for j, y in enumerate(record.pv.T):
        good &= _settled_pv(y, whole, whole if j in integrating else tail, float(sd[j]))
    firsts = _apart(good, whole) + whole - tail
    kept = firsts[np.unique(np.linspace(0, len(firsts) - 1, min(len(firsts), MOST_RESTS)).round().astype(int))]
    return tuple(
        RecordedRest(first, tail, *(v[first : first + tail].mean(axis=0) for v in (record.pv, record.mv, record.dv)))
        for first in kept.tolist()
    )


def _stays(u: Array, whole: int, tail: int) -> NDArray[np.bool_]:
    """Stretches (n,) of ``whole`` rows over which an input (N,) stays at the mean of its ``tail``."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d  # a tenth of a second to load

    n, span = len(u) - whole + 1, _visited_range(u)
    level = _means(u, tail)[whole - tail :]
    edges = np.linspace(0, whole, STILL_PARTS + 1).round().astype(int)
    good = np.ones(n, dtype=bool)
    for a, b in pairwise(edges.tolist()):
        good &= np.abs(_means(u, b - a)[a : a + n] - level) <= STILL_INPUT * span
    middle = slice(whole // 2, whole // 2 + n)  # where a filter over ``whole`` rows has its middle
    high, low = maximum_filter1d(u, whole)[middle], minimum_filter1d(u, whole)[middle]
    return good & (high - level <= STILL_ROWS * span) & (level - low <= STILL_ROWS * span)


def _settled_pv(y: Array, whole: int, over: int, sd: float) -> NDArray[np.bool_]:
    """Stretches (n,) over whose last rows ``over`` both halves of a PV (N,) have the same mean."""
    half, n = over // 2, len(y) - whole + 1
    means = _means(y, half)
    first, second = (means[at : at + n] for at in (whole - 2 * half, whole - half))
    allowed = STILL_PV * _visited_range(y) + STILL_NOISES * sd * np.sqrt(2 / half)
    return np.asarray(np.abs(first - second) <= allowed)


def _visited_range(values: Array) -> float:
    low, high = np.quantile(values, VISITED_SIGNAL)
    return float(high - low) or float(np.ptp(values))


def _means(values: Array, rows: int) -> Array:
    """Means (N - rows + 1,) over so many rows from each on."""
    sums = np.cumsum(np.r_[0.0, values - values[0]])
    return np.asarray((sums[rows:] - sums[:-rows]) / rows + values[0])


def _apart(good: NDArray[np.bool_], rows: int) -> NDArray[np.int64]:
    """First rows of good stretches (n,) of so many rows that do not overlap, the last of each hold before others."""
    found, end = list[int](), len(good) + rows
    for k in np.flatnonzero(good)[::-1].tolist():
        if k + rows <= end:
            found.append(k)
            end = k
    return np.array(found[::-1], dtype=np.int64)
