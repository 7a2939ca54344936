"""Record: sampled experiments of one plant, simulated or measured; Parquet and CSV both ways."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.plants.simulator import Array, Signals
from loopwright.pipeline.records.record_file import Table, column_name, read_table, write_table
from loopwright.serving.manifest import Signal

STEP_TOLERANCE = 1e-3  # of the period: what a logger's rounded time stamps may stray
MV_TOLERANCE = 1e-9  # of a signal's span
FED_BACK = "fed_back"  # name in a Parquet file's metadata
FRESH = " fresh"  # end of the name of a column that says which rows have a new reading of a PV


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Rows of one or more runs. Row k: the PVs measured at sample k, the MVs held over [k, k+1).

    Values are in the units of their signals. The MV of a run's last row acts after the data end. ``fresh`` says in
    which rows a PV has a new reading: an analyser has one now and then, and what stands in ``pv`` between is none.
    """

    period_s: float  # [s] sampling period, the same in every run
    pv_signals: tuple[Signal, ...]  # process variables, controlled ones first
    mv_signals: tuple[Signal, ...]  # manipulated variables
    dv_signals: tuple[Signal, ...]  # measured disturbances
    run: NDArray[np.int64]  # (N,) number of the run that a row belongs to; rows of one run are contiguous
    time_s: Array  # (N,) [s] since the start of the row's run
    pv: Array  # (N, n_pv)
    mv: Array  # (N, n_mv)
    dv: Array  # (N, n_dv)
    fed_back: bool = False  # its readings show that an MV follows a PV, which rows averaged from them may hide
    fresh: NDArray[np.bool_] | None = None  # (N, n_pv) rows with a new reading; None: all are

    def __post_init__(self) -> None:
        n = len(self.run)
        wanted = {name: (n, len(getattr(self, f"{name}_signals"))) for name in ("pv", "mv", "dv")}
        for name, shape in {**wanted, "time_s": (n,)}.items():
            found = getattr(self, name).shape
            if found != shape:
                raise RecordError(f"record: {name} has shape {found}; {n} rows and its signals need {shape}")
        if self.fresh is not None and self.fresh.shape != wanted["pv"]:
            raise RecordError(
                f"record: fresh has shape {self.fresh.shape}; {n} rows and its signals need {wanted['pv']}"
            )
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
        if self.fresh is not None:
            sha.update(np.ascontiguousarray(self.fresh, dtype="<i8").tobytes())
        return sha.hexdigest()

    def at(self, rows: NDArray[np.int64] | slice, run: NDArray[np.int64] | None = None) -> Self:
        """Some rows, with the runs that they had, or those of ``run``."""
        taken = {name: getattr(self, name)[rows] for name in ("time_s", "pv", "mv", "dv")}
        fresh = None if self.fresh is None else self.fresh[rows]
        return replace(self, run=self.run[rows] if run is None else run, fresh=fresh, **taken)

    @property
    def seldom(self) -> dict[int, NDArray[np.bool_]]:
        """PV -> the rows (N,) with a new reading, of the PVs that have none in some rows."""
        found = {} if self.fresh is None else dict(enumerate(self.fresh.T))
        return {i: of for i, of in found.items() if not of.all()}

    def write(self, path: Path) -> None:
        """Write the record as ``.parquet`` or ``.csv``; no half-written file is left under that name."""
        columns: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {"run": self.run, "time_s": self.time_s}
        columns |= dict(zip(self.columns, (*self.pv.T, *self.mv.T, *self.dv.T), strict=True))
        columns |= {self.pv_signals[i].name + FRESH: of.astype(np.float64) for i, of in self.seldom.items()}
        signals = {"pv": self.pv_signals, "mv": self.mv_signals, "dv": self.dv_signals}
        described = {kind: [s.to_dict() for s in group] for kind, group in signals.items()}
        told = {FED_BACK: True} if self.fed_back else {}
        write_table(path, columns, {"period_s": self.period_s, **described, **told})

    @classmethod
    def read(cls, path: Path, signals: Signals) -> Self:
        """The record in a Parquet or CSV file, checked against the plant's signals and period.

        Columns: ``time_s``, one ``NAME [unit]`` a signal, and ``run`` where the file holds more
        than one run; others are ignored, but for ``NAME fresh``: 1 where a PV has a new reading. Time may start
        anywhere; in the record each run starts at 0.

        Raises RecordError, naming file, column and row, for a missing column, another unit, a cell that is not a
        finite number, time that is not uniform or not at ``period_s``, a run in pieces, a PV mostly outside its
        range, an MV outside its own or one that never changes.
        """
        table = read_table(Path(path))
        runs = table.numbers("run") if "run" in table.header else np.zeros(table.rows)
        check_runs(table, runs)
        time_s = table.numbers("time_s")
        pv, mv, dv = (
            np.column_stack([np.empty((table.rows, 0)), *(table.numbers(table.find(s)) for s in group)])
            for group in (signals.pv, signals.mv, signals.dv)
        )
        check_time(table, runs, time_s, signals.period_s)
        for signal, values in zip(signals.pv, pv.T, strict=True):
            check_pv(table, signal, values)
        for signal, values in zip(signals.mv, mv.T, strict=True):
            check_mv(table, signal, values)
        # ``of`` puts times on the exact grid, so that a file's rounded time stamps do not change the digest.
        found = cls.of(signals, pv, mv, run=runs.astype(np.int64), dv=dv)
        names = {s.name + FRESH: i for i, s in enumerate(signals.pv) if s.name + FRESH in table.header}
        fresh = np.ones(pv.shape, dtype=np.bool_)
        for name, i in names.items():
            fresh[:, i] = table.numbers(name) > 0
        return replace(found, fed_back=bool(table.told.get(FED_BACK)), fresh=fresh if names else None)


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


MOST_FEW_LEVELS = 3  # levels at most of an input that counts as one of few levels
SAME_LEVEL = 1e-3  # of the span: values of one level
LEVEL_ROWS = 0.99  # of the rows at the levels; a mean over a period in which the input was moved lies between two


def levels_of(values: Array) -> tuple[float, ...]:
    """The two or three values at which ``values`` (n,) stand in nearly all rows, ascending; empty where they are more.

    Empty too where all are one.
    """
    span = float(np.ptp(values)) if values.size else 0.0
    if span <= 0:
        return ()
    place, count = np.unique(np.round((values - values.min()) / (SAME_LEVEL * span)), return_counts=True)
    first = np.argsort(-count, kind="stable")[:MOST_FEW_LEVELS]
    for n in range(2, len(first) + 1):
        if count[first[:n]].sum() >= LEVEL_ROWS * len(values):
            return tuple(float(values.min() + SAME_LEVEL * span * p) for p in np.sort(place[first[:n]]))
    return ()


def only_between(name: str, levels: Sequence[float], unit: str = "") -> str:
    """Range that an input of so few levels leaves unseen."""
    values = f"{', '.join(f'{v:.4g}' for v in levels[:-1])} and {levels[-1]:.4g} {unit}".rstrip(" -")
    return f"{name} moves between {len(levels)} values only ({values}): a curve between them cannot be seen"
