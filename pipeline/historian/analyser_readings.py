"""Readings of an analyser: how late they are, and values in the rows between, from which a fit may begin.

An analyser has a number every so many rows, of a sample that it took some rows before. Only the rows of new numbers say
anything. The lateness is a dead time of this output alone: the model is identified on its readings moved back by it,
and the finished model hands them over as late as they come.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.config.known import Known
from loopwright.pipeline.historian.cleaning.findings import Finding, counted
from loopwright.pipeline.metrics import Array
from loopwright.pipeline.records.record import Record

LAG_POLES = (0.3, 0.5, 0.65, 0.75, 0.82, 0.87, 0.91, 0.94, 0.96, 0.975, 0.985)
"""Poles of the lags by which an analyser's readings are explained by the inputs, a few of them."""

MOST_POLES = 3
"""Poles together at most: more of them imitate a dead time, so that no lateness is seen."""

MOST_LATE = 60
"""Most rows by which an answer of an analyser is looked for: as far as a predictive law usually looks ahead."""

LATE_NATS = 2.0
"""Nats within which a lateness explains the readings as well: the least of these is taken, since the model's own lags
can stand for a lateness that is too short, and nothing for one that is too long."""

READINGS_A_LAG = 4
"""New readings for each coefficient of the lags."""

RIDGE = 1e-6
"""Share of the columns' mean square on the diagonal: lags of neighbouring poles are nearly alike."""


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A record whose analysers' readings stand in the rows whose sample they are, and by how many rows they came late.

    ``record`` has values in every row: between two readings that of the lags, off by as much as at the last one. Its
    ``fresh`` says which rows are readings. ``late`` (n_y,) is 0 of other outputs.
    """

    record: Record
    late: tuple[int, ...]

    @classmethod
    def of(cls, record: Record, n_y: int) -> Aligned:
        """The record aligned in its first ``n_y`` outputs; as it is where every row of them is a reading."""
        if record.fresh is None or record.fresh[:, :n_y].all():
            return cls(record, (0,) * n_y)
        pv, fresh, late = record.pv.copy(), record.fresh.copy(), [0] * n_y
        runs = _bounds(record.run)
        bank = _Bank.of(record, runs)
        for j in np.flatnonzero(~record.fresh[:, :n_y].all(axis=0)).tolist():
            found = bank.explain(record.pv[:, j], record.fresh[:, j])
            late[j] = found.late
            pv[:, j], fresh[:, j] = found.filled(record.pv[:, j], record.fresh[:, j], runs)
        return cls(replace(record, pv=pv, fresh=fresh), tuple(late))


def of_samples(known: Sequence[Known], late: Mapping[str, int], period_s: float) -> tuple[Known, ...]:
    """The statements on PVs whose readings come ``late`` rows, of their samples: a dead time without the lateness."""

    def earlier(one: Known) -> Known:
        by = late.get(one.pv, 0) * period_s
        ends = None if one.dead_s is None else (max(one.dead_s[0] - by, 0.0), max(one.dead_s[1] - by, 0.0))
        return replace(one, dead_s=ends) if by else one

    return tuple(map(earlier, known))


def in_place(record: Record, found: Aligned) -> Record:
    """The record with values of an analyser in the rows between its readings, in the rows in which it hands them over.

    They are those of ``found``, as late as the readings are: for a first look, which asks for a number in each row.
    """
    pv = found.record.pv.copy()
    for first, end in _bounds(record.run):
        for j, late in enumerate(found.late):
            if late:
                pv[first + late : end, j] = found.record.pv[first : end - late, j]
                pv[first : first + late, j] = pv[min(first + late, end - 1), j]
    return record if found.record is record else replace(record, pv=pv)


def of_lateness(found: Aligned, tags: Mapping[str, str]) -> list[Finding]:
    """A finding for each analyser on how late its readings are; ``tags`` are those of the PVs' names."""
    findings = []
    for i in found.record.seldom:
        late, signal = found.late[i], found.record.pv_signals[i]
        words = "no lateness is seen in its new readings, though slow answers can hide one"
        if late:
            words = (
                f"its new readings come {counted(late, 'row')} ({late * found.record.period_s:g} s) or more after what "
                "they measure, by the inputs' moves; slow answers can hide some rows"
            )
        findings.append(Finding("analyser", tags[signal.name], words))
    return findings


def _bounds(run: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First row of each run and the row after its last one."""
    edges = np.r_[0, np.flatnonzero(run[1:] != run[:-1]) + 1, len(run)]
    return [(int(i), int(j)) for i, j in pairwise(edges)]


@dataclass(frozen=True, slots=True, eq=False)
class LagsExplained:
    """The lateness [rows] of an output, and what the inputs explain of it (n,) at the rows of the samples."""

    late: int
    expected: Array

    def filled(
        self, y: Array, fresh: NDArray[np.bool_], runs: list[tuple[int, int]]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Values (n,) and whether each is a reading, at the rows of the samples; of readings ``y`` at ``fresh`` rows.

        A row between two readings has what is expected of it, off by as much as at the last reading before.
        """
        values, kept = np.empty(len(y)), np.zeros(len(y), dtype=np.bool_)
        for first, end in runs:
            at = np.flatnonzero(fresh[first:end]) - self.late
            read = y[first:end][at[at >= 0] + self.late]
            at = at[at >= 0]
            expected = self.expected[first:end]
            if not at.size:
                values[first:end] = expected
                continue
            off = read - expected[at]
            last = np.searchsorted(at, np.arange(end - first), "right") - 1
            values[first:end] = expected + off[np.maximum(last, 0)]
            kept[first + at] = True
        return values, kept


@dataclass(frozen=True, slots=True, eq=False)
class _Bank:
    """Lags (n, poles n_v) of the inputs, each row from the rows before it."""

    columns: Array
    runs: list[tuple[int, int]]
    n_v: int

    @classmethod
    def of(cls, record: Record, runs: list[tuple[int, int]]) -> _Bank:
        from scipy.signal import lfilter  # half a second to load

        v = np.hstack([record.mv, record.dv])
        v = (v - v.mean(axis=0)) / np.maximum(v.std(axis=0), 1e-300)
        found = np.empty((len(LAG_POLES), *v.shape))
        for first, end in runs:
            part = v[first:end]
            for i, pole in enumerate(LAG_POLES):
                filtered, _ = lfilter([1 - pole], [1.0, -pole], part, axis=0, zi=pole * part[:1])
                found[i, first] = part[0]
                found[i, first + 1 : end] = filtered[:-1]
        return cls(np.concatenate(list(found), axis=1), runs, v.shape[1])

    def explain(self, y: Array, fresh: NDArray[np.bool_]) -> LagsExplained:
        """The lateness that explains the readings ``y`` (n,) at ``fresh`` rows, and what is expected of every row.

            y(k) = c + sum_jp b_jp f_jp(k - late),   f_jp(k + 1) = p f_jp(k) + (1 - p) v_j(k)

        Least squares with errors that remember those of the reading before, as a load lets them.
        """
        inside = np.zeros(len(y), dtype=np.bool_)
        for first, end in self.runs:
            inside[first + MOST_LATE : end] = True
        rows = np.flatnonzero(fresh & inside)
        choices = [of for of in _choices() if len(rows) >= READINGS_A_LAG * (len(of) * self.n_v + 1)]
        if not choices:
            return LagsExplained(0, np.interp(np.arange(len(y)), np.flatnonzero(fresh), y[fresh]))
        most = self.chosen(max(choices, key=len))[rows]
        memory = _memory(y[rows] - _of(_fit(most, y[rows], 0.0), most))
        costs = np.array([self._costs(rows, late, y[rows], memory, choices) for late in range(MOST_LATE + 1)])
        least = costs.min(axis=1)
        late = int((least <= least.min() + LATE_NATS).argmax())
        columns = self.chosen(choices[int(costs[late].argmin())])
        return LagsExplained(late, _of(_fit(columns[rows - late], y[rows], memory), columns))

    def chosen(self, poles: Sequence[int]) -> Array:
        """The columns (n, poles n_v) of some poles."""
        return np.concatenate([self.columns[:, p * self.n_v : (p + 1) * self.n_v] for p in poles], axis=1)

    def _costs(
        self, rows: NDArray[np.int64], late: int, y: Array, memory: float, choices: Sequence[Sequence[int]]
    ) -> Array:
        """n/2 log(squares left) and half a log(n) for each coefficient (choices,), of readings so late."""
        x = np.hstack([self.columns[rows - late], np.ones((len(rows), 1))])
        x, target = x[1:] - memory * x[:-1], y[1:] - memory * y[:-1]
        gram, right, square = x.T @ x, x.T @ target, float(target @ target)
        found = np.empty(len(choices))
        for i, poles in enumerate(choices):
            of = np.r_[[p * self.n_v + v for p in poles for v in range(self.n_v)], x.shape[1] - 1].astype(np.int64)
            own = gram[np.ix_(of, of)]
            own[np.diag_indices(len(of) - 1)] += RIDGE * float(np.trace(own[:-1, :-1])) / max(len(of) - 1, 1)
            left = max(square - float(right[of] @ np.linalg.solve(own, right[of])), 1e-12 * square)
            found[i] = 0.5 * len(target) * np.log(left) + 0.5 * len(of) * np.log(len(target))
        return found


def _choices() -> list[tuple[int, ...]]:
    """Places of some of the LAG_POLES, at most ``MOST_POLES`` together."""
    return [of for n in range(1, MOST_POLES + 1) for of in combinations(range(len(LAG_POLES)), n)]


def _of(fitted: tuple[float, Array], columns: Array) -> Array:
    return np.asarray(fitted[0] + columns @ fitted[1])


def _memory(left: Array) -> float:
    """Correlation, 0 to .95, of an error (n,) with that of the reading before."""
    left = left - left.mean()
    return float(np.clip(left[1:] @ left[:-1] / max(float(left @ left), 1e-300), 0.0, 0.95))


def _fit(columns: Array, y: Array, memory: float) -> tuple[float, Array]:
    """(constant, weights) of y (n,) on columns (n, p), each less ``memory`` times the reading before."""
    x = np.hstack([columns, np.ones((len(y), 1))])
    x, target = x[1:] - memory * x[:-1], y[1:] - memory * y[:-1]
    gram = x.T @ x
    gram[:-1, :-1] += RIDGE * float(np.mean(np.diag(gram)[:-1])) * np.eye(columns.shape[1])
    theta = np.linalg.solve(gram, x.T @ target)
    return float(theta[-1]), theta[:-1]
