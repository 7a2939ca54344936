"""The table of an Excel workbook (.xlsx): the first sheet that holds one, its dates and numbers as they are stored."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.dialect import SAMPLE_LINES, names_of
from loopwright.pipeline.historian.table_head import Head, head_of_table

BLOCK = 1 << 15  # rows


@dataclass(frozen=True, slots=True)
class Sheet:
    """Where the table of a workbook stands, its columns, and its first rows."""

    path: Path
    name: str
    header: tuple[str, ...]
    units: tuple[str, ...]
    first: int  # index of the first row of values
    rows: tuple[tuple[Any, ...], ...]
    others: tuple[str, ...]  # sheets that were not read

    def blocks(self, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
        """The rows of some columns, as Arrow batches: numbers, times, or texts where a column mixes them."""
        place = [self.header.index(c) for c in columns]
        with _opened(self.path) as book:
            cells: list[list[Any]] = [[] for _ in place]
            for i, row in enumerate(book[self.name].iter_rows(values_only=True)):
                if i < self.first or all(c is None for c in row):
                    continue
                for own, j in zip(cells, place, strict=True):
                    own.append(row[j] if j < len(row) else None)
                if cells and len(cells[0]) == BLOCK:
                    yield pa.record_batch([column_of(c) for c in cells], names=list(columns))
                    cells = [[] for _ in place]
            if cells and cells[0]:
                yield pa.record_batch([column_of(c) for c in cells], names=list(columns))


def sheet_of(path: Path) -> Sheet:
    """The first sheet with a table; RecordError where none has one."""
    with _opened(path) as book:
        found, others, why = None, list[str](), ""
        for sheet in book.worksheets:
            first = [row for row, _ in zip(sheet.iter_rows(values_only=True), range(SAMPLE_LINES), strict=False)]
            head = head_of_table(_texts(first))
            if isinstance(head, Head) and found is None:
                found = sheet.title, first, head
            elif isinstance(head, Head):
                others.append(sheet.title)
            else:
                why = why or head
        names = ", ".join(sheet.title for sheet in book.worksheets)
    if found is None:
        raise RecordError(
            f"{path}: no table was found in the sheets {names}; "
            f"{why or 'a header of names and rows of times and numbers are wanted'}"
        )
    title, first, head = found
    width = len(head.header)
    rows = tuple((*row, *[None] * width)[:width] for row in first[head.first :] if any(c is not None for c in row))
    return Sheet(path, title, names_of(path, head.header), head.units, head.first, rows, tuple(others))


def column_of(cells: Sequence[Any]) -> pa.Array:
    """Cells of one column as an Arrow array: float64 or microseconds where all are such, texts otherwise."""
    known = [c for c in cells if c is not None]
    if all(isinstance(c, int | float) and not isinstance(c, bool) for c in known):
        return pa.array(cells, pa.float64())
    if all(isinstance(c, datetime) for c in known) and any(c.time() != time(0) for c in known):
        return pa.array([None if c is None else c.replace(tzinfo=None) for c in cells], pa.timestamp("us"))
    return pa.array([text_of(c) for c in cells], pa.string())


def text_of(cell: Any) -> str:
    """A cell as a text export writes it: a day without its midnight, an hour or a duration as 06:00:00."""
    if cell is None:
        return ""
    if isinstance(cell, datetime):
        return cell.date().isoformat() if cell.time() == time(0) else cell.isoformat(" ")
    if isinstance(cell, timedelta):
        seconds = cell.total_seconds()
        return f"{int(seconds // 3600):02d}:{int(seconds % 3600 // 60):02d}:{seconds % 60:09.6f}"
    if isinstance(cell, float):
        return repr(cell)
    return cell.isoformat() if isinstance(cell, date | time) else str(cell).strip()


def _texts(rows: Sequence[Sequence[Any]]) -> list[list[str]]:
    """Rows of texts of one width, the empty columns at the right end left out."""
    texts = [[text_of(c) for c in row] for row in rows]
    width = max((j + 1 for row in texts for j, c in enumerate(row) if c), default=0)
    return [(row + [""] * width)[:width] for row in texts]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import openpyxl  # here, because only workbooks need it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # styles and extensions that do not concern the values
        try:
            book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        except Exception as error:  # a broken workbook raises whatever its parts are broken by
            raise RecordError(
                f"{path} cannot be read as a workbook: {str(error).splitlines()[0]}; save it again"
            ) from None
        try:
            yield book
        finally:
            book.close()
