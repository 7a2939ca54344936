"""Tables on disk, named columns in Parquet or CSV, and the set points that lie in a file beside a record."""

from __future__ import annotations

import csv
import difflib
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.files import draft_of
from loopwright.pipeline.metrics import Array
from loopwright.serving.manifest import Signal

METADATA_KEY = b"loopwright.record"
COLUMN = re.compile(r"^\s*(?P<name>.*?)\s*\[(?P<unit>.*)\]\s*$")


def column_name(signal: Signal) -> str:
    """``NAME [unit]``, the header of a signal's column."""
    return f"{signal.name} [{signal.unit}]"


def split_column(column: str) -> tuple[str, str]:
    """(name, unit) of a header; the unit is empty where none is written."""
    match = COLUMN.match(column)
    return (match["name"], match["unit"].strip()) if match else (column.strip(), "")


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The columns of one file as read, before anything is known to be a number."""

    path: Path
    header: tuple[str, ...]
    cells: tuple[NDArray[Any], ...]  # one array of shape (rows,) a column
    first_row: int  # the number by which a person knows the first row
    told: Mapping[str, Any] = field(default_factory=dict)  # what ``write_table`` was told besides the columns

    @property
    def rows(self) -> int:
        """Number of rows of data."""
        return len(self.cells[0]) if self.cells else 0

    def at(self, column: str, row: int | np.int64 | None = None) -> str:
        """File, column and row as a person sees it: the line of a CSV (the header is line 1), a Parquet row from 0."""
        where = f"{self.path}: column {column!r}"
        if row is None:
            return where
        return f"{where}, {'line' if self.first_row else 'row'} {int(row) + self.first_row}"

    def find(self, signal: Signal) -> str:
        """The header of the signal's column; RecordError for a missing column or another unit."""
        columns = {split_column(h): h for h in reversed(self.header)}
        header = columns.get((signal.name, signal.unit))
        if header is not None:
            return header
        for (name, unit), column in columns.items():
            if name == signal.name:
                stated = f"the unit {unit!r}" if unit else "no unit"
                raise RecordError(
                    f"{self.at(column)} has {stated}; {signal.unit!r} is wanted: "
                    f"convert the values and head the column {column_name(signal)!r}"
                )
        raise self._missing(column_name(signal))

    def numbers(self, column: str) -> NDArray[np.float64]:
        """One column as float64, shape (rows,); RecordError for the first cell that is not a finite number."""
        if column not in self.header:
            raise self._missing(column)
        cells = self.cells[self.header.index(column)]
        if cells.dtype.kind in "mM":
            raise RecordError(f"{self.at(column)} holds dates; plain numbers are wanted (time in seconds)")
        try:
            values = np.asarray(cells.astype(np.float64))
        except (ValueError, TypeError):
            values = np.array([_number(c) for c in cells])
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            cell = cells[bad[0]]
            fault = "is empty" if cell is None or str(cell).strip() in {"", "None"} else f"holds {str(cell)!r}"
            raise RecordError(f"{self.at(column, bad[0])} {fault}; a finite number is wanted in every row")
        return values

    def _missing(self, column: str) -> RecordError:
        near = difflib.get_close_matches(column, self.header, n=1, cutoff=0.6)
        nearest = f"; the nearest is {near[0]!r}" if near else ""
        return RecordError(
            f"{self.path}: column {column!r} is missing{nearest}; the file has {', '.join(map(repr, self.header))}"
        )


def read_table(path: Path) -> Table:
    """The table in a ``.parquet`` or ``.csv`` file; RecordError where it cannot be read or is empty."""
    reader = _reader(path)
    try:
        table = reader(path)
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file") from None
    except (OSError, ValueError, csv.Error, pa.ArrowException) as error:
        raise RecordError(f"{path} cannot be read as {path.suffix[1:]}: {str(error).splitlines()[0]}") from error
    if not table.rows:
        raise RecordError(f"{path}: the file has no rows of data")
    twice = [h for i, h in enumerate(table.header) if h in table.header[:i]]
    if twice:
        raise RecordError(f"{table.at(twice[0])} stands twice in the header; rename or remove one of them")
    return table


def write_table(path: Path, columns: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any]) -> None:
    """Write columns by the suffix of ``path``, whole or not at all."""
    is_csv = _reader(path) is _read_csv
    with draft_of(path) as draft:
        if is_csv:
            import pandas as pd  # here, because stages read Parquet and importing pandas takes long

            pd.DataFrame(dict(columns)).to_csv(draft, index=False, lineterminator="\n")
        else:
            table = pa.table(dict(columns)).replace_schema_metadata({METADATA_KEY: json.dumps(metadata).encode()})
            pq.write_table(table, draft)


def _reader(path: Path) -> Callable[[Path], Table]:
    """The reader of the file's format; RecordError for another suffix than .parquet and .csv."""
    readers = {".parquet": _read_parquet, ".csv": _read_csv}
    if path.suffix.lower() not in readers:
        raise RecordError(
            f"{path}: records are kept as .parquet or .csv, not as {path.suffix or 'a file without suffix'!r}"
        )
    return readers[path.suffix.lower()]


def _read_parquet(path: Path) -> Table:
    table = pq.read_table(path)
    cells = tuple(table.column(i).to_numpy() for i in range(table.num_columns))
    told = json.loads((table.schema.metadata or {}).get(METADATA_KEY, b"{}"))
    return Table(path, tuple(table.column_names), cells, first_row=0, told=told)


def _read_csv(path: Path) -> Table:
    import pandas as pd  # here, as above

    with path.open(encoding="utf-8-sig", newline="") as file:
        head = file.readline()
    # A spreadsheet in a country with the decimal comma separates cells by semicolons.
    separator = max(",;\t", key=head.count)
    frame = pd.read_csv(
        path,
        sep=separator,
        header=None,
        dtype=str,
        keep_default_na=False,
        skip_blank_lines=False,  # so that rows keep the numbers of their lines
        encoding="utf-8-sig",
    )
    header = tuple(str(h).strip() for h in frame.iloc[0])
    body = frame.iloc[1:]
    filled = np.flatnonzero((body.fillna("") != "").any(axis=1).to_numpy())
    body = body.iloc[: int(filled[-1]) + 1 if filled.size else 0]  # blank lines at the end are none
    if separator == ";":
        body = body.apply(lambda column: column.str.replace(",", "."))
    cells = tuple(body.iloc[:, i].fillna("").to_numpy(dtype=object) for i in range(body.shape[1]))
    return Table(path, header, cells, first_row=2)


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        return math.nan


SET_POINTS = "set_points.npz"
"""Beside the record of an own plant: what stage `screen` found of its loops."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSetPoints:
    """Set points (n, n_sp) of PVs in the rows of a record, in their units; NaN where a loop was not in automatic."""

    pvs: tuple[str, ...]
    values: Array

    def write(self, record: Path) -> None:
        """Write the file beside the record; none where no set point is known."""
        if self.pvs:
            with draft_of(record.with_name(SET_POINTS)) as draft, draft.open("wb") as file:
                np.savez_compressed(file, pvs=np.array(self.pvs), values=self.values)

    @classmethod
    def beside(cls, record: Path) -> Self | None:
        """The set points beside a record; None where there are none."""
        path = record.with_name(SET_POINTS)
        if not path.is_file():
            return None
        with np.load(path, allow_pickle=False) as file:
            return cls(tuple(map(str, file["pvs"])), np.asarray(file["values"], dtype=np.float64))

    def of(self, cvs: Sequence[str]) -> Array | None:
        """The set points (n, n_cv) of these PVs; None where one of them has none."""
        if not set(cvs) <= set(self.pvs):
            return None
        return self.values[:, [self.pvs.index(cv) for cv in cvs]]


def stretches(known: NDArray[np.bool_], run: NDArray[np.int64], least: int) -> list[slice]:
    """Stretches of rows (n,) of one run that are all ``known`` (n,), with at least so many rows."""
    edges = np.flatnonzero(np.diff(np.where(known, run, -1), prepend=-2, append=-2))
    pairs = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    return [slice(a, b) for a, b in pairs if known[a] and b - a >= least]
