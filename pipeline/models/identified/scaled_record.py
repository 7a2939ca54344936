"""A record as identification needs it: scaled, its inputs shifted by dead times, cut into stretches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.dynamics import Stretch
from loopwright.pipeline.models.training.objectives import check_finite
from loopwright.pipeline.models.training.regressors import split_in_time
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.records.record import Record

HELD_OUT = 0.2
"""Share of the rows that a fold holds out: the last ones in the first fold, the first ones in the second."""

SHORTEST_STRETCH = 12
"""Rows of a stretch below which it is left out: its initial state alone would explain it."""


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """Centres and scales of the outputs (n_y,) and of the inputs [mv, dv] (n_v,), in their units.

    Outputs to mean 0 and deviation 1, MVs to -1 .. 1 over their range, measured disturbances to mean 0, deviation 1/2.
    """

    y_center: Array
    y_scale: Array
    v_center: Array
    v_scale: Array

    @classmethod
    def of(cls, record: Record, n_y: int) -> Self:
        """The scales of a record's first ``n_y`` PVs and of its inputs; ModelError where one never changes."""
        y, mv, dv = record.pv[:, :n_y], record.mv, record.dv
        signals = (*record.pv_signals[:n_y], *record.mv_signals, *record.dv_signals)
        still = [s.name for s, column in zip(signals, np.hstack([y, mv, dv]).T, strict=True) if np.ptp(column) == 0]
        if still:
            raise ModelError(
                f"{', '.join(still)} never change in the record, so that nothing can be learnt of them; "
                "record moves of every input, or leave the signal out"
            )
        low, high = (np.array([getattr(s, end) for s in record.mv_signals]) for end in ("low", "high"))
        return cls(
            y.mean(axis=0),
            y.std(axis=0),
            np.concatenate([(low + high) / 2, dv.mean(axis=0)]),
            np.concatenate([(high - low) / 2, 2 * dv.std(axis=0)]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class ScaledRecord:
    """Scaled rows: outputs y (N, n_y) and inputs v (N, n_v), and the run (N,) that each row belongs to.

    ``fresh`` (N, n_y) says which outputs are new readings; None: all are.
    """

    y: Array
    v: Array
    run: NDArray[np.int64]
    fresh: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, record: Record, scales: Scales) -> Self:
        """The record in scaled numbers; ModelError for a value that is not finite."""
        n_y = len(scales.y_scale)
        y, v = record.pv[:, :n_y], np.hstack([record.mv, record.dv])
        check_finite("the rows to identify from", y, v)
        fresh = None if record.fresh is None or record.fresh[:, :n_y].all() else record.fresh[:, :n_y]
        return cls((y - scales.y_center) / scales.y_scale, (v - scales.v_center) / scales.v_scale, record.run, fresh)

    def __len__(self) -> int:
        return len(self.y)

    @property
    def readings(self) -> int:
        """Number of new readings of all outputs."""
        return self.y.size if self.fresh is None else int(np.count_nonzero(self.fresh))

    def read(self, i: int) -> NDArray[np.bool_] | None:
        """The rows (N,) with a new reading of output i; None: all."""
        return None if self.fresh is None or self.fresh[:, i].all() else self.fresh[:, i]

    def delayed(self, delays: Sequence[int]) -> Self:
        """The same rows with input j of ``delays[j]`` rows before, or after where that is negative.

        A run's first and last inputs stand for those before and after it.
        """
        if not any(delays):
            return self
        v = self.v.copy()
        for first, last in self.bounds():
            for j, d in enumerate(delays):
                at = np.clip(np.arange(first, last) - d, first, last - 1)
                v[first:last, j] = self.v[at, j]
        return replace(self, v=v)

    def bounds(self) -> list[tuple[int, int]]:
        """First row of each run and the row after its last one."""
        change = np.flatnonzero(self.run[1:] != self.run[:-1]) + 1
        edges = [0, *change.tolist(), len(self.run)]
        return list(pairwise(edges))

    def rows(self, rows: slice) -> Self:
        """Some neighbouring rows."""
        fresh = None if self.fresh is None else self.fresh[rows]
        return replace(self, y=self.y[rows], v=self.v[rows], run=self.run[rows], fresh=fresh)

    def stretches(self) -> list[Stretch]:
        """The runs that are long enough; ModelError where none is."""
        fresh = self.fresh
        found = [
            Stretch(self.y[i:j], self.v[i:j], None if fresh is None else fresh[i:j])
            for i, j in self.bounds()
            if j - i >= SHORTEST_STRETCH
        ]
        if not found:
            longest = max(j - i for i, j in self.bounds())
            raise ModelError(
                f"the longest run has {longest} rows; identification needs {SHORTEST_STRETCH}: record longer runs"
            )
        return found


@dataclass(frozen=True, slots=True)
class Fold:
    """Rows to train on and rows held out."""

    train: slice
    held: slice


def folds(record: Record) -> tuple[Fold, Fold]:
    """The record cut in time twice: the last fifth held out, then the first. RecordError where one side stays empty."""
    n = len(record)
    late = len(split_in_time(record, 1 - HELD_OUT)[0])
    early = len(split_in_time(record, HELD_OUT)[0])
    return Fold(slice(0, late), slice(late, n)), Fold(slice(early, n), slice(0, early))


def informative(record: Record, most: int, block: int = 500) -> Record:
    """The record, or of a longer one ``most`` rows: the blocks in which the inputs move most, in their order.

    A block's score is the sum of squared moves of all inputs, each over its own mean; gaps between blocks become
    ends of runs.
    """
    n = len(record)
    if n <= most:
        return record
    block = min(block, most // 5)
    moves = np.diff(np.hstack([record.mv, record.dv]), axis=0, prepend=np.nan) ** 2
    moves[0] = 0.0
    moves[1:][record.run[1:] != record.run[:-1]] = 0.0
    score = (moves / np.maximum(moves.mean(axis=0), 1e-300)).sum(axis=1)
    blocks = np.add.reduceat(score, np.arange(0, n, block))
    best = np.sort(np.argsort(-blocks, kind="stable")[: most // block])
    rows = np.concatenate([np.arange(i * block, min((i + 1) * block, n)) for i in best])
    cut = np.r_[True, (np.diff(rows) > 1) | (np.diff(record.run[rows]) != 0)]
    return record.at(rows, np.cumsum(cut, dtype=np.int64) - 1)


# ------------------------------------------------------- the row on whose outputs an MV acts: the next one, or its own
INNOVATION_LAGS = 12
"""Lags of the ARX whose innovations are looked at."""

REACTION_ROWS = 10
"""Rows after an innovation in which a controller's reaction to it would show."""

REACTION_SDS = 5.0
"""Standard deviations from zero beyond which a correlation counts."""


def may_act_in_its_row(data: ScaledRecord, n_mv: int) -> bool:
    """Whether an MV goes with what the rows before do not explain of an output in its row, and nothing says feedback.

    An operator or a controller that reacts to y(k) moves u(k) too, which looks the same; but then what neither the
    past nor u(k) explains of y(k) goes with the later moves, u(k+1) - u(k) and after. Both parts of y(k) are residuals
    of least-squares ARX models.
    """
    ends = [
        np.arange(i + INNOVATION_LAGS, j - REACTION_ROWS)
        for i, j in data.bounds()
        if j - i > INNOVATION_LAGS + REACTION_ROWS
    ]
    rows = np.concatenate([*ends, np.zeros(0, dtype=np.int64)])
    z, mv = np.hstack([data.y, data.v]), data.v[:, :n_mv]
    past = np.column_stack([*(z[rows - lag] for lag in range(1, INNOVATION_LAGS + 1)), np.ones(len(rows))])
    if len(rows) < 3 * past.shape[1]:
        return False
    bound = REACTION_SDS / np.sqrt(len(rows))
    surprise, own = _residual(past, data.y[rows]), _residual(past, mv[rows])
    if not np.any(_correlations(own, surprise) > bound):
        return False
    unexplained = _residual(np.column_stack([past, mv[rows]]), data.y[rows])
    moves = np.diff(mv, axis=0, prepend=mv[:1])
    return not any(np.any(_correlations(moves[rows + j], unexplained) > bound) for j in range(1, REACTION_ROWS + 1))


def _residual(columns: Array, values: Array) -> Array:
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0])


def _correlations(moves: Array, e: Array) -> Array:
    """Sizes of the correlation coefficients (n_mv, n_y) of moves (n, n_mv) with e (n, n_y); 0 where either is still."""
    size = np.linalg.norm(moves, axis=0)[:, None] * np.linalg.norm(e, axis=0)
    return np.asarray(np.abs(moves.T @ e) / np.where(size > 0, size, np.inf))
