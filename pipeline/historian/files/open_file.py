"""One file of an export, opened: its columns, its first rows, and its blocks; a text, or a workbook of Excel."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.dialect import (
    SAMPLE_LINES,
    Dialect,
    Sign,
    decimal_sign,
    is_utf8,
    kind_of,
    names_of,
    sniff,
    whole_files_sign,
)
from loopwright.pipeline.historian.files.export import Note
from loopwright.pipeline.historian.files.headers import split_header
from loopwright.pipeline.historian.files.layout import Layout, layout_of
from loopwright.pipeline.historian.files.quality import MOST_QUALITIES
from loopwright.pipeline.historian.files.table_head import Head, head_of_table

# ------------------------------------------------------------- the table of a workbook: the first sheet that holds one
WORKBOOK_BLOCK = 1 << 15  # rows


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
                if cells and len(cells[0]) == WORKBOOK_BLOCK:
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


# ------------------------------------------------------------------------------------------------------------ any file
BLOCK_BYTES = 1 << 24  # bytes of a text that are parsed at once
BLOCK_ROWS = 1 << 17  # rows that are read at once
SPREAD_CELLS = 1_000  # cells of a block
PARQUET = {".parquet", ".pq"}


class EncodingError(RecordError):
    """A text that is no UTF-8, which its first part did not show; it is to be opened in ``encoding``."""

    encoding = "cp1252"


@dataclass(slots=True)
class Opened:
    """One file: its columns, its first rows, and its blocks of chosen columns."""

    path: Path
    header: tuple[str, ...]
    sample: Mapping[str, Sequence[Any]]
    units: Mapping[str, str]
    sign: Sign  # of decimals, by the first rows
    separator: str  # of cells, "" where they are typed
    all_blocks: Callable[[Sequence[str]], Iterator[Any]]
    unreadable: Counter[str]  # "rows": lines of another length than the header's
    notes: tuple[Note, ...] = ()

    encoding: str = ""  # of a text

    def blocks(self, names: Sequence[str]) -> Iterator[Any]:
        """The rows of some columns, as Arrow batches; RecordError where they cannot be read, EncodingError too."""
        try:
            yield from self.all_blocks(names)
        except (pa.ArrowException, OSError, UnicodeError, EOFError) as error:
            if self.encoding.startswith("utf-8") and not is_utf8(self.path):
                raise EncodingError(f"{self.path} is no UTF-8") from None
            raise RecordError(
                f"{self.path} cannot be read: {str(error).splitlines()[0]}; export the file again"
            ) from None

    def layout(self, time_column: str = "", time_format: str = "") -> Layout:
        """The role of each column; ``time_column`` and ``time_format`` are those that a person gave, "" for none."""
        return layout_of(self.path, self.header, self.sample, time_column, time_format, self.units,
                         self.spread, self.counted)  # fmt: skip

    def spread(self, column: str) -> list[Any]:
        """Cells from all over a column."""
        cells = list[Any]()
        for block in self.blocks([column]):
            own = block.column(0)
            cells += own.take(pa.array(range(0, len(own), max(1, len(own) // SPREAD_CELLS)))).to_pylist()
        self.unreadable.clear()
        return cells

    def counted(self, column: str) -> Counter[str]:
        """Each text of a column, and how often it stands there; of one with very many, those of the first blocks."""
        found = Counter[str]()
        for block in self.blocks([column]):
            for row in pc.value_counts(block.column(0)).to_pylist():
                found["" if row["values"] is None else str(row["values"]).strip()] += row["counts"]
            if len(found) > MOST_QUALITIES:
                break
        self.unreadable.clear()
        return found

    def pairs(self, one: str, other: str) -> set[tuple[str, str]]:
        """The different pairs of texts in two columns."""
        found = set[tuple[str, str]]()
        for block in self.blocks([one, other]):
            texts = ([text_of(c) for c in block.column(n).to_pylist()] for n in (one, other))
            found |= set(zip(*texts, strict=True))
        self.unreadable.clear()
        return found

    def decimal(self) -> tuple[str, list[Note]]:
        """The decimal sign, by the whole file where the first rows do not tell it; and a note where nothing does."""

        def blocks(names: Sequence[str]) -> Iterator[Mapping[str, list[str]]]:
            for block in self.blocks(names):
                some = pa.array(range(0, len(block), max(1, len(block) // SPREAD_CELLS)))
                yield {n: [text_of(c) for c in block.column(n).take(some).to_pylist()] for n in names}

        sign = whole_files_sign(self.sign, blocks, self.separator, str(self.path))
        self.unreadable.clear()
        if not sign.unclear or (sign.decimal == "." and self.separator != ";"):
            return sign.decimal, []
        words = f"numbers such as {sign.example} are read with three decimals; export thousands without a sign"
        return sign.decimal, [Note(sign.unclear[0], words)]


def opened(path: Path, encoding: str = "") -> Opened:
    """The file's header and first rows; RecordError where it cannot be read as a table.

    ``encoding`` is that of a text; "" finds it in the first part.
    """
    if path.is_dir():
        raise RecordError(f"{path} is a folder; give the files in it, as in {path}/*.csv")
    if not path.exists():
        raise RecordError(f"{path}: no such file; give the path of an export")
    try:
        kind = kind_of(path)
        if kind == "parquet" or path.suffix.lower() in PARQUET:
            return _parquet(path)
        return _workbook(path) if kind == "workbook" else _text(path, sniff(path, kind, encoding), kind)
    except (pa.ArrowException, OSError, UnicodeError, LookupError, EOFError) as error:
        raise RecordError(f"{path} cannot be read: {str(error).splitlines()[0]}; export the file again") from None


def _parquet(path: Path) -> Opened:
    file = pq.ParquetFile(path)
    header = tuple(file.schema_arrow.names)
    if not header:
        raise RecordError(f"{path}: the file has no columns")
    first = next(file.iter_batches(batch_size=200), None)
    sample = {n: first.column(i).to_pylist() if first is not None else [] for i, n in enumerate(header)}

    def blocks(names: Sequence[str]) -> Iterator[Any]:
        return pq.ParquetFile(path).iter_batches(batch_size=BLOCK_ROWS, columns=list(names))

    return Opened(path, header, sample, {n: split_header(n)[1] for n in header}, _sign_of_texts(sample, path),
                  "", blocks, Counter())  # fmt: skip


def _workbook(path: Path) -> Opened:
    sheet = sheet_of(path)
    used = [n for i, n in enumerate(sheet.header) if any(row[i] is not None for row in sheet.rows)]
    sample = {n: [text_of(row[i]) for row in sheet.rows] for i, n in enumerate(sheet.header)}
    units = {n: unit or split_header(n)[1] for n, unit in zip(sheet.header, sheet.units, strict=True)}
    left = f"; the sheets {', '.join(sheet.others)} were not read" if sheet.others else ""
    notes = (Note(str(path), f"the sheet {sheet.name!r} was read{left}"),) if left else ()
    sign = _sign_of_texts({n: [row[i] for row in sheet.rows] for i, n in enumerate(sheet.header)}, path)
    return Opened(path, tuple(used), sample, units, sign, "", sheet.blocks, Counter(), notes)


def _sign_of_texts(sample: Mapping[str, Sequence[Any]], path: Path) -> Sign:
    """The decimal sign of numbers that stand as texts in a file of typed cells."""
    return decimal_sign({n: [c for c in cells if isinstance(c, str)] for n, cells in sample.items()}, "", str(path))


def _text(path: Path, dialect: Dialect, kind: str) -> Opened:
    used = tuple(n for n in dialect.header if n not in dialect.unused)
    sample = {n: [row[i] for row in dialect.rows] for i, n in enumerate(dialect.header)}
    unreadable: Counter[str] = Counter()

    def skip(_row: Any) -> str:
        unreadable["rows"] += 1
        return "skip"

    def blocks(names: Sequence[str]) -> Iterator[Any]:
        stream = pa.input_stream(str(path), compression="gzip" if kind == "gzip" else None)
        encoding = "utf8" if dialect.encoding in {"utf-8", "utf-8-sig"} else dialect.encoding
        yield from pa_csv.open_csv(
            stream,
            read_options=pa_csv.ReadOptions(
                block_size=BLOCK_BYTES,
                column_names=list(dialect.header),
                skip_rows=dialect.first_line,
                encoding=encoding,
                use_threads=False,
            ),
            parse_options=pa_csv.ParseOptions(delimiter=dialect.separator, invalid_row_handler=skip),
            convert_options=pa_csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()), include_columns=list(names), strings_can_be_null=False
            ),
        )

    units = {n: unit or split_header(n)[1] for n, unit in zip(dialect.header, dialect.units, strict=True)}
    return Opened(path, used, sample, units, dialect.sign, dialect.separator, blocks, unreadable,
                  encoding=dialect.encoding)  # fmt: skip
