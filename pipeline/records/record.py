"""Record: sampled experiments of one plant, simulated or measured; Parquet and CSV both ways."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RecordError
from pipeline.plants.signals import Signals
from pipeline.plants.simulator import Array
from pipeline.records.record_file import Table, column_name, read_table, write_table
from serving.manifest import Signal

STEP_TOLERANCE = 1e-3  # of the period: what a logger's rounded time stamps may stray
MV_TOLERANCE = 1e-9  # of a signal's span


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Rows of one or more runs. Row k: the PVs measured at sample k, the MVs held over [k, k+1).

    Attributes
    ----------
    period_s : float
        Sampling period [s], the same in every run.
    pv_signals, mv_signals, dv_signals : tuple of Signal
        Process variables (controlled ones first), manipulated variables, measured disturbances.
    run : array, shape (N,)
        Number of the run that a row belongs to; rows of one run are contiguous.
    time_s : array, shape (N,)
        Time since the start of the row's run [s].
    pv, mv, dv : array, shapes (N, n_pv), (N, n_mv), (N, n_dv)
        Values in the units of their signals. The MV of a run's last row acts after the data end.
    """

    period_s: float
    pv_signals: tuple[Signal, ...]
    mv_signals: tuple[Signal, ...]
    dv_signals: tuple[Signal, ...]
    run: NDArray[np.int64]
    time_s: Array
    pv: Array
    mv: Array
    dv: Array

    def __post_init__(self) -> None:
        n = len(self.run)
        for name, values, signals in (
            ("pv", self.pv, self.pv_signals),
            ("mv", self.mv, self.mv_signals),
            ("dv", self.dv, self.dv_signals),
        ):
            if values.shape != (n, len(signals)):
                raise RecordError(
                    f"record: {name} has shape {values.shape}; {n} rows and its signals need {(n, len(signals))}"
                )
        if self.time_s.shape != (n,):
            raise RecordError(f"record: time_s has shape {self.time_s.shape}; {n} rows need {(n,)}")
        broken = broken_run(self.run)
        if broken is not None:
            raise RecordError(
                f"record: run {self.run[broken]} goes on at row {broken} after another run; keep its rows together"
            )

    @classmethod
    def of(
        cls, signals: Signals, pv: Array, mv: Array, *, run: NDArray[np.int64] | None = None, dv: Array | None = None
    ) -> Self:
        """The record of experiments, sampled at the signals' period; one run unless ``run`` tells them apart.

        ``dv`` (n, n_dv), or (n_dv,) where they never changed; only needed where the plant has measured disturbances.
        """
        n = len(pv)
        run = np.zeros(n, dtype=np.int64) if run is None else np.asarray(run, dtype=np.int64)
        dv = np.zeros(0) if dv is None else dv
        dv = np.tile(dv, (n, 1)) if dv.ndim == 1 else dv
        time_s = position_in_run(run).astype(np.float64) * signals.period_s
        return cls(signals.period_s, signals.pv, signals.mv, signals.dv, run, time_s, pv, mv, dv)

    @classmethod
    def joined(cls, records: Sequence[Record]) -> Self:
        """One record with the runs of all, numbered anew. Raises RecordError where signals or periods differ."""
        if not records:
            raise RecordError("record: no records to join")
        first = records[0]
        runs, offset = [], 0
        for i, r in enumerate(records):
            if r.columns != first.columns or r.period_s != first.period_s:
                raise RecordError(
                    f"record: number {i} has other signals or another period than number 0; join records of one plant"
                )
            numbers = np.unique(r.run, return_inverse=True)[1] + offset
            offset = int(numbers.max(initial=offset - 1)) + 1
            runs.append(numbers.astype(np.int64))
        time_s, pv, mv, dv = (
            np.concatenate([getattr(r, name) for r in records]) for name in ("time_s", "pv", "mv", "dv")
        )
        signals = first.pv_signals, first.mv_signals, first.dv_signals
        return cls(first.period_s, *signals, np.concatenate(runs), time_s, pv, mv, dv)

    def __len__(self) -> int:
        return len(self.run)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the value columns in a file, ``NAME [unit]``: PVs, MVs, DVs."""
        return tuple(column_name(s) for s in (*self.pv_signals, *self.mv_signals, *self.dv_signals))

    def starts(self, length: int) -> NDArray[np.int64]:
        """Rows k for which k .. k + length lie in one run, shape (n,), ascending.

        Raises RecordError where no run is that long.
        """
        k = np.arange(max(len(self) - length, 0), dtype=np.int64)
        k = k[self.run[k] == self.run[k + length]]
        if not k.size:
            longest = int(position_in_run(self.run).max(initial=-1)) + 1
            raise RecordError(
                f"record: the longest run has {longest} rows, too short for the lags: they span {length + 1} rows; "
                "record longer runs or ask for fewer lags"
            )
        return k

    def digest(self) -> str:
        """sha256 of the content, the same in whatever file format the record is kept."""
        sha = hashlib.sha256(json.dumps([self.period_s, *self.columns]).encode())
        sha.update(np.ascontiguousarray(self.run, dtype="<i8").tobytes())
        for values in (self.time_s, self.pv, self.mv, self.dv):
            sha.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
        return sha.hexdigest()

    def write(self, path: Path) -> None:
        """Write the record as ``.parquet`` or ``.csv``; no half-written file is left under that name."""
        columns: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {"run": self.run, "time_s": self.time_s}
        columns |= dict(zip(self.columns, np.hstack([self.pv, self.mv, self.dv]).T, strict=True))
        signals = {"pv": self.pv_signals, "mv": self.mv_signals, "dv": self.dv_signals}
        write_table(
            path, columns, {"period_s": self.period_s} | {k: [s.to_dict() for s in v] for k, v in signals.items()}
        )

    @classmethod
    def read(
        cls,
        path: Path,
        *,
        pv: tuple[Signal, ...],
        mv: tuple[Signal, ...],
        dv: tuple[Signal, ...] = (),
        period_s: float,
    ) -> Self:
        """The record in a Parquet or CSV file, checked against the plant's signals and period.

        Columns: ``time_s``, one ``NAME [unit]`` a signal, and ``run`` where the file holds more
        than one run; others are ignored. Time may start anywhere; in the record each run starts at 0.

        Raises
        ------
        RecordError
            Naming file, column and row: a missing column, another unit, a cell that is not a
            finite number, time that is not uniform or not at ``period_s``, a run in pieces, a PV
            mostly outside its range, an MV outside its own or one that never changes.
        """
        table = read_table(Path(path))
        runs = table.numbers("run") if "run" in table.header else np.zeros(table.rows)
        check_runs(table, runs)
        time_s = table.numbers("time_s")
        values = {s: table.numbers(table.find(s)) for s in (*pv, *mv, *dv)}
        check_time(table, runs, time_s, period_s)
        for signal in pv:
            check_pv(table, signal, values[signal])
        for signal in mv:
            check_mv(table, signal, values[signal])

        def block(signals: tuple[Signal, ...]) -> Array:
            return np.column_stack([np.empty((table.rows, 0)), *(values[s] for s in signals)])

        run = runs.astype(np.int64)
        # On the exact grid, so that a file's rounded time stamps do not change the digest.
        grid = position_in_run(run).astype(np.float64) * period_s
        return cls(period_s, pv, mv, dv, run, grid, block(pv), block(mv), block(dv))


def position_in_run(run: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of rows before each row in its run, shape (N,)."""
    n = len(run)
    first = np.r_[True, run[1:] != run[:-1]] if n else np.zeros(0, dtype=bool)
    return np.arange(n) - np.maximum.accumulate(np.where(first, np.arange(n), 0))


def broken_run(run: NDArray[np.int64] | Array) -> int | None:
    """First row of a run that has had rows before another run; None where every run is in one piece."""
    first = np.flatnonzero(np.r_[True, run[1:] != run[:-1]]) if len(run) else np.zeros(0, dtype=np.int64)
    _, once = np.unique(run[first], return_index=True)
    again = np.setdiff1d(np.arange(len(first)), once)
    return int(first[again[0]]) if again.size else None


def check_runs(table: Table, run: Array) -> None:
    """Run numbers are whole and each run's rows are together, or RecordError."""
    odd = np.flatnonzero(run != np.round(run))
    if odd.size:
        raise RecordError(
            f"{table.at('run', odd[0])}: {run[odd[0]]:g} is not a run number; number the runs 0, 1, 2, ..."
        )
    broken = broken_run(run)
    if broken is not None:
        raise RecordError(
            f"{table.at('run', broken)}: run {run[broken]:g} goes on here after another run; "
            "sort the file by run and time, or give the new experiment a number of its own"
        )


def check_time(table: Table, run: Array, time_s: Array, period_s: float) -> None:
    """Time goes on by the period within every run, or RecordError."""
    step = np.diff(time_s)
    inside = run[1:] == run[:-1]
    bad = np.flatnonzero(inside & ~(np.abs(step - period_s) <= STEP_TOLERANCE * period_s))
    if not bad.size:
        return
    usual = float(np.median(step[inside]))
    if abs(usual - period_s) > STEP_TOLERANCE * period_s:
        advice = f"the file is sampled every {usual:.6g} s: resample it or change the plant's period"
    else:
        advice = "fill the gap or, if another experiment starts here, tell the two apart in a column 'run'"
    row = int(bad[0])
    raise RecordError(
        f"{table.at('time_s', row + 1)}: time steps by {step[row]:.6g} s where {period_s:g} s is wanted; {advice}"
    )


def check_pv(table: Table, signal: Signal, pv: Array) -> None:
    """Most of the PV lies in its range, or RecordError: a few values may not, a wrong unit moves all of them."""
    outside = np.flatnonzero((pv < signal.low) | (pv > signal.high))
    if 2 * outside.size > pv.size:
        raise RecordError(
            f"{table.at(table.find(signal), outside[0])}: {pv[outside[0]]:.6g}, like most of its column, is outside "
            f"the PV's range {signal.low:g} to {signal.high:g} {signal.unit}; "
            "check the unit, or widen the plant's signal"
        )


def check_mv(table: Table, signal: Signal, mv: Array) -> None:
    """The MV stays in its range, or at its allowed values, and moves, or RecordError."""
    column = table.find(signal)
    slack = MV_TOLERANCE * (signal.high - signal.low)
    outside = np.flatnonzero((mv < signal.low - slack) | (mv > signal.high + slack))
    if outside.size:
        raise RecordError(
            f"{table.at(column, outside[0])}: {mv[outside[0]]:.6g} is outside the MV's range "
            f"{signal.low:g} to {signal.high:g} {signal.unit}; correct the cell or widen the plant's signal"
        )
    if signal.values is not None:
        near = np.min(np.abs(mv[:, None] - np.array(signal.values)), axis=1)
        strange = np.flatnonzero(near > slack)
        if strange.size:
            raise RecordError(
                f"{table.at(column, strange[0])}: {mv[strange[0]]:.6g} is none of the values {list(signal.values)} "
                f"that {signal.name} may have; correct the cell"
            )
    if mv.size and float(np.ptp(mv)) <= slack:
        raise RecordError(
            f"{table.at(column)}: the MV {signal.name} is {mv[0]:g} {signal.unit} in every row, "
            "and an MV that never changes identifies nothing; excite it"
        )
