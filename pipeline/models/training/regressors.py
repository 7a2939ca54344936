"""A record split in time, and training pairs taken from one; no pair reaches over the end of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import ParamsError, RecordError
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

SAME_MV_VALUE = 1e-9  # of an MV's span: what still counts as the same value
CUT_SHIFT = 0.1  # of the record's rows: how far the cut may move to come between two runs


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Inputs and targets of a static model, in engineering units.

    A pair at row k has seen the rows ``k - back`` to ``k + ahead`` of its record.
    """

    x: Array  # (N, n_in)
    y: Array  # (N, n_out)
    row: NDArray[np.int64]  # (N,) ascending
    back: int = 0
    ahead: int = 1

    def __len__(self) -> int:
        return len(self.row)

    def take(self, index: NDArray[np.int64]) -> Self:
        """The pairs at these positions."""
        return type(self)(self.x[index], self.y[index], self.row[index], self.back, self.ahead)

    def split(self, fraction: float, how: Literal["time", "random"] = "time", seed: int = 0) -> tuple[Self, Self]:
        """(training, validation), the first with ``fraction`` of the pairs.

        "time" keeps whole stretches together: the last pairs validate, and no training pair has
        seen a row that a validation pair starts from. "random" draws, by ``seed``; neighbours in
        time then stand on both sides, so its validation error flatters where samples correlate.

        Raises ParamsError for a fraction outside (0, 1) or an unknown way, RecordError where one
        side stays empty.
        """
        n = _training_rows(fraction, len(self))
        if how == "time":
            first = self.row[n] if n < len(self) else np.iinfo(np.int64).max
            before = self.row[:n] + self.ahead <= first - self.back
            parts = np.arange(n)[before], np.arange(n, len(self))
        elif how == "random":
            order = np.random.default_rng(seed).permutation(len(self))
            parts = np.sort(order[:n]), np.sort(order[n:])
        else:
            raise ParamsError(f"the split is {how!r}; it must be 'time' or 'random'")
        if not (parts[0].size and parts[1].size):
            raise RecordError(
                f"{len(self)} pairs split at {fraction:g} leave {parts[0].size} for training and {parts[1].size} "
                "for validation; both need some: record more samples"
            )
        return self.take(parts[0]), self.take(parts[1])


def inverse_pairs(record: Record, horizon: int = 1, cv: int = 0) -> Pairs:
    """Pairs of an inverse model: x = [pv(k), pv_cv(k + h)], y = mv(k).

    Only rows k whose MVs were held over k .. k + h - 1. Shapes (N, n_pv + 1), (N, n_mv).

    Raises RecordError where the record has no such row.

    Source: [inverse_rbf, eq. 10] (h = 1).
    """
    k = _held(record, horizon)
    target = record.pv[k + horizon, cv]
    return Pairs(np.column_stack([record.pv[k], target]), record.mv[k], k, ahead=horizon)


def forward_pairs(record: Record, horizon: int = 1, target: int = 0) -> Pairs:
    """Pairs of a forward model: x = [pv(k), mv(k)], y = pv_target(k + h).

    Only rows k whose MVs were held over k .. k + h - 1. Shapes (N, n_pv + n_mv), (N, 1).

    Raises RecordError where the record has no such row.
    """
    k = _held(record, horizon)
    y = record.pv[k + horizon, target][:, None]
    return Pairs(np.hstack([record.pv[k], record.mv[k]]), y, k, ahead=horizon)


def nnarx_pairs(record: Record, n_y: int, n_u: int, target: int = 0, delay: int = 1) -> Pairs:
    """Pairs of a one-step predictor with lags (NNARX), for one PV y and every MV u.

    x = [y(k), .., y(k - n_y + 1), u(k + 1 - d), .., u(k + 2 - d - n_u)], y = y(k + 1), with the
    lags of the first MV before those of the next. Shapes (N, n_y + n_mv n_u), (N, 1). With the
    delay d = 1 the newest u is u(k), which acts over [k, k+1).

    Raises ParamsError for lags below 1, RecordError where no run is long enough.
    """
    if min(n_y, n_u, delay) < 1:
        raise ParamsError(f"NNARX lags are n_y={n_y}, n_u={n_u}, delay={delay}; each must be at least 1")
    back = max(n_y - 1, n_u + delay - 2)
    k = record.starts(back + 1) + back
    y = record.pv[:, target]
    past_y = [y[k - i] for i in range(n_y)]
    past_u = [u[k + 1 - delay - i] for u in record.mv.T for i in range(n_u)]
    return Pairs(np.column_stack([*past_y, *past_u]), y[k + 1][:, None], k, back=back)


def _held(record: Record, horizon: int) -> NDArray[np.int64]:
    """Rows k from which the MVs stay the same for ``horizon`` periods inside one run."""
    if horizon < 1:
        raise ParamsError(f"the horizon is {horizon} periods; it must be at least 1")
    k = record.starts(horizon)
    slack = np.array([SAME_MV_VALUE * (s.high - s.low) for s in record.mv_signals])
    for i in range(1, horizon):
        k = k[(np.abs(record.mv[k + i] - record.mv[k]) <= slack).all(axis=1)]
    if not k.size:
        raise RecordError(
            f"record: no MV is held for {horizon} samples on end, which pairs over a horizon of {horizon} need; "
            f"excite with a hold of at least {horizon} or take a shorter horizon"
        )
    return k


def _training_rows(fraction: float, n: int) -> int:
    """How many of n rows train; raises ParamsError for a fraction outside (0, 1)."""
    if not 0.0 < fraction < 1.0:
        raise ParamsError(f"the training fraction is {fraction}; it must lie between 0 and 1")
    return round(fraction * n)


def split_in_time(record: Record, fraction: float) -> tuple[Record, Record]:
    """(training, validation): the first ``fraction`` of the rows, and the rest.

    Where runs are short (batches, restarts) the cut moves to the nearest boundary between two of
    them, so that each run is whole on one side; a long run is cut inside, its times go on. No window
    of one part reaches into the other.

    Raises ParamsError for a fraction outside (0, 1), RecordError where one side would stay empty.
    """
    n, cut = len(record), _training_rows(fraction, len(record))
    starts = np.flatnonzero(record.run[1:] != record.run[:-1]) + 1
    if starts.size:
        nearest = int(starts[np.argmin(np.abs(starts - cut))])
        if abs(nearest - cut) <= CUT_SHIFT * n:
            cut = nearest
    if not 0 < cut < n:
        raise RecordError(
            f"record: {n} rows split at {fraction:g} leave {cut} for training and {n - cut} for validation; "
            "both need some: record more samples"
        )
    return rows_of(record, slice(0, cut)), rows_of(record, slice(cut, n))


def rows_of(record: Record, rows: slice) -> Record:
    """Some neighbouring rows of a record, with the runs and times that they had."""
    return record.at(rows)


def longest_run(record: Record, most: int) -> Record:
    """The longest run, or its first ``most`` rows."""
    _, start, length = np.unique(record.run, return_index=True, return_counts=True)
    i = int(np.argmax(length))
    return rows_of(record, slice(int(start[i]), int(start[i] + min(length[i], most))))
