"""Measured disturbances beside the noise of their readings: which is noise, and the levels that a fit takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.models.identified.scaled_record import INNOVATION_LAGS, ScaledRecord
from loopwright.pipeline.plants.noise import levels, noise_and_change, running_levels
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

LATEST_DV_ANSWER = 60
"""Most rows by which the answer to a measured disturbance is looked for."""

POLES = (0.3, 0.5, 0.7, 0.8, 0.9, 0.96)
"""Poles of the lag by which an output answers, one of them; more at a time rebuild a signal from its level."""

BY_CHANCE = 1.0
"""Nats by which a signal or its level may explain the outputs better than the other one does by chance."""

ROWS_A_NUMBER = 3
"""Rows for each number of a regression."""


@dataclass(frozen=True, slots=True, eq=False)
class Disturbances:
    """Standard deviations (n_dv,) of the noise of readings and of their own change a period, scaled, and ``sure``.

    Noise turns back a row later, and so does a quick motion of the disturbance itself. The outputs tell the two apart.
    An ARX explains more of them by the levels where it is noise, and by the readings where the plant feels their quick
    motion: ``noise`` is then 0. Where they tell neither, ``noise`` is what it seems, and a fit takes the readings. It
    takes the levels of those that are ``sure`` (n_dv,). Later readings of one that follows the outputs would tell of
    these: such a signal is no disturbance.
    """

    noise: Array
    change: Array
    sure: NDArray[np.bool_]

    @classmethod
    def of(cls, data: ScaledRecord, told_by: ScaledRecord, n_mv: int) -> Self:
        """The disturbances of a record; the rows ``told_by`` tell noise from motion, as long records need no more."""
        noise, change = noise_and_change([data.v[i:j, n_mv:] for i, j in data.bounds()])
        sure = np.zeros(len(noise), dtype=bool)
        for j in np.flatnonzero(noise > 0).tolist():
            alone = cls(noise, change, np.arange(len(noise)) == j)
            nats = _gained(told_by, alone.smoothed(told_by), n_mv + j)
            sure[j] = nats > BY_CHANCE
            if nats < -BY_CHANCE:
                moves = np.concatenate([np.diff(data.v[i:k, n_mv + j]) for i, k in data.bounds()])
                change[j], noise[j] = np.sqrt((moves**2).mean()), 0.0
        return cls(noise, change, sure)

    def smoothed(self, data: ScaledRecord) -> ScaledRecord:
        """The rows with the levels in the readings' place, by all rows of a run: for fits."""
        return self._put(data, levels)

    def followed(self, data: ScaledRecord) -> ScaledRecord:
        """The rows with the levels that a running loop has, by earlier rows alone: to judge what inputs foresee."""
        return self._put(data, running_levels)

    def _put(self, data: ScaledRecord, level: Callable[[Array, Array, Array], Array]) -> ScaledRecord:
        if not self.sure.any():
            return data
        v, n_mv = data.v.copy(), data.v.shape[1] - len(self.noise)
        noise = np.where(self.sure, self.noise, 0.0)
        for first, last in data.bounds():
            v[first:last, n_mv:] = level(v[first:last, n_mv:], noise, self.change)
        return replace(data, v=v)


def with_levels(record: Record, n_y: int) -> Record:
    """The record with the levels of its measured disturbances, where its first ``n_y`` PVs tell of noise.

    A PV that never moves tells nothing, and a measured disturbance that never moves has no noise.
    """
    n_mv, scale = record.mv.shape[1], np.maximum(record.dv.std(axis=0), 1e-300)
    y = record.pv[:, :n_y]
    y = (y - y.mean(axis=0)) / np.maximum(y.std(axis=0), 1e-300)
    data = ScaledRecord(y, np.hstack([record.mv, record.dv / scale]), record.run)
    found = Disturbances.of(data, data, n_mv).smoothed(data)
    return record if found is data else replace(record, dv=found.v[:, n_mv:] * scale)


def _gained(data: ScaledRecord, smoothed: ScaledRecord, j: int) -> float:
    """Nats n/2 log(power / power') by which the level of input j explains the outputs better than its readings do.

    The powers are those of the residuals of an ARX with two columns of the input, a row and a lag from it, of the best
    dead time and pole. 0 where rows are too few, or the best dead time is the latest that is looked at: the answer may
    be later.
    """
    bounds = data.bounds()
    latest = int(min(LATEST_DV_ANSWER, np.median([k - i for i, k in bounds]) // 3))
    first = INNOVATION_LAGS + latest
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(i + first, k) for i, k in bounds)])
    rest = np.delete(np.hstack([data.y, data.v]), data.y.shape[1] + j, axis=1)
    past = np.column_stack([*(rest[rows - lag] for lag in range(1, INNOVATION_LAGS + 1)), np.ones(len(rows))])
    if latest < 1 or len(rows) < ROWS_A_NUMBER * past.shape[1]:
        return 0.0
    explained, _ = np.linalg.qr(past)
    y = _without(explained, data.y[rows])
    (as_read, late), (as_level, later) = (_best(explained, y, of, rows, j, latest) for of in (data, smoothed))
    return 0.0 if LATEST_DV_ANSWER in (late, later) else len(rows) / 2 * (as_read - as_level)


def _best(
    explained: Array, y: Array, data: ScaledRecord, rows: NDArray[np.int64], j: int, latest: int
) -> tuple[float, int]:
    """(least sum of log powers of y (n, n_y) that input j leaves, its dead time), over all dead times and poles."""
    from scipy.signal import lfilter  # half a second to load

    runs, found = [data.v[i:k, j] for i, k in data.bounds()], []

    def late(pole: float) -> Array:
        lag = np.concatenate([lfilter([1.0], [1.0, -pole], run) for run in runs])
        return _without(explained, np.column_stack([lag[rows - d] for d in range(latest + 1)]))

    total, own = (y**2).sum(axis=0), late(0.0)
    for pole in POLES:
        lag = late(pole)
        a, b, c = ((left * right).sum(axis=0)[:, None] for left, right in ((own, own), (own, lag), (lag, lag)))
        with_own, with_lag = own.T @ y, lag.T @ y  # (latest + 1, n_y)
        size = np.maximum(a * c - b**2, 1e-12 * a * c + 1e-300)
        share = (c * with_own**2 - 2 * b * with_own * with_lag + a * with_lag**2) / size
        powers = np.log(np.maximum(total - share, 1e-12 * total + 1e-300) / len(rows)).sum(axis=1)
        found.append((float(powers.min()), int(powers.argmin())))
    return min(found)


def _without(explained: Array, values: Array) -> Array:
    """The part of values (n, m) that goes with none of the orthonormal columns ``explained`` (n, k)."""
    return np.asarray(values - explained @ (explained.T @ values))
