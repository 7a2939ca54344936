"""Files of an export -> series, in blocks, so that a file much larger than its series can be read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from pipeline.errors import RecordError, nearest
from pipeline.files import sha256
from pipeline.historian.dialect import Dialect, sniff
from pipeline.historian.export import Contents, Export, Series, joined
from pipeline.historian.gathering import Gathered
from pipeline.historian.headers import split_header
from pipeline.historian.layout import Layout, layout_of
from pipeline.historian.sent_again import drop_repeated_rows
from pipeline.historian.times import zone_of

BLOCK_BYTES = 1 << 24
BLOCK_ROWS = 1 << 17
PARQUET = {".parquet", ".pq"}


@dataclass(slots=True)
class Opened:
    """One file: its columns, its first rows, and its blocks of chosen columns."""

    path: Path
    header: tuple[str, ...]
    sample: Mapping[str, Sequence[Any]]
    units: Mapping[str, str]
    decimal: str
    blocks: Callable[[Sequence[str]], Iterator[Any]]
    unreadable: Counter[str]  # "rows": lines of another length than the header's


def opened(path: Path) -> Opened:
    """The file's header and first rows; RecordError where it cannot be read as a table."""
    if path.is_dir():
        raise RecordError(f"{path} is a folder; give the files in it, as in {path}/*.csv")
    if not path.exists():
        raise RecordError(f"{path}: no such file; give the path of an export")
    try:
        return _parquet(path) if path.suffix.lower() in PARQUET else _text(path, sniff(path))
    except (pa.ArrowException, OSError, UnicodeError, LookupError, EOFError) as error:
        raise RecordError(f"{path} cannot be read: {str(error).splitlines()[0]}; export the file again") from None


def read_export(
    paths: Sequence[Path],
    tags: Sequence[str] = (),
    modes: Sequence[str] = (),
    time_column: str = "",
    time_format: str = "",
) -> Export:
    """The series of ``tags`` and ``modes`` (texts allowed) of all files; of every column where none is named.

    Raises RecordError for a file that cannot be read, a tag that none of them has, time that cannot be read.
    """
    if not paths:
        raise RecordError("no file is named; give one or more exports")
    parts: dict[str, list[Series]] = {}
    files, kinds, zones, totals, contents = [], [], list[str](), Counter[str](), list[Contents]()
    known: set[str] = set()
    tags, modes = [bare(t) for t in tags], [bare(t) for t in modes]
    for path in paths:
        source = opened(path)
        layout = layout_of(source.path, source.header, source.sample, time_column, time_format)
        found, counts = _read(source, layout, set(tags) | set(modes), set(modes))
        zones.append(zone_of(layout.clock, source.sample[layout.date or layout.time]))
        drop_repeated_rows(found)
        contents.append(_contents(path, found, counts["rows_read"]))
        for name, series in found.items():
            parts.setdefault(name, []).append(series)
        pa.default_memory_pool().release_unused()
        totals += counts + source.unreadable
        kinds.append(layout.kind)
        files.append((str(path), sha256(path)))
        known |= set(found) if layout.kind == "long" else set(map(bare, layout.values))
    absent = [f"no tag {tag!r}{nearest(tag, known)}" for tag in (*tags, *modes) if tag not in parts]
    if absent:
        raise RecordError(f"{', '.join(map(str, paths))}: {'; '.join(absent)}")
    if not totals["rows_read"]:
        raise RecordError(f"{', '.join(map(str, paths))}: no row of data; export a longer time")
    together = {name: joined(p) for name, p in parts.items()}
    layouts = " and ".join(dict.fromkeys(kinds))
    zone = zones[0] if len(set(zones)) == 1 else ""  # of files that count differently no date is known
    rows = totals["rows_read"] + totals["rows"]
    unreadable, timeless = totals["rows"], totals["timeless"]
    return Export(together, tuple(files), layouts, rows, unreadable, timeless, zone, tuple(contents))


def _contents(path: Path, found: Mapping[str, Series], rows: int) -> Contents:
    times = [s.time_s for s in found.values() if len(s)]
    first, last = (
        min((float(t.min()) for t in times), default=np.nan),
        max((float(t.max()) for t in times), default=np.nan),
    )
    return Contents(str(path), frozenset(found), rows, first, last)


def units_of(paths: Sequence[Path]) -> dict[str, str]:
    """Column -> the unit that a row below the header or brackets in the header name."""
    found: dict[str, str] = {}
    for path in paths:
        found |= {bare(k): v for k, v in opened(path).units.items() if v}
    return found


def bare(column: str) -> str:
    """The tag that a header names, without its unit."""
    return split_header(column)[0]


# ---------------------------------------------------------------------- one file
def _read(source: Opened, layout: Layout, wanted: set[str], modes: set[str]) -> tuple[dict[str, Series], Counter[str]]:
    gather = Gathered(modes, source.decimal, wide=layout.kind == "wide")
    counts: Counter[str] = Counter()
    values = {v: bare(v) for v in layout.values if not wanted or {v, bare(v)} & wanted or layout.kind == "long"}
    qualities = {v: layout.quality[v] for v in values if v in layout.quality}
    names = [n for n in dict.fromkeys((layout.date, layout.time, layout.tag, *values, *qualities.values())) if n]
    try:
        for block in source.blocks(names):
            counts["rows_read"] += block.num_rows
            seconds = layout.clock.seconds(_stamps(block, layout))
            timed = np.isfinite(seconds)
            if not timed.all():
                counts["timeless"] += int(np.count_nonzero(~timed))
                block, seconds = block.filter(pa.array(timed)), seconds[timed]
            if layout.kind == "wide":
                for v, name in values.items():
                    gather.add(name, seconds, block.column(v), block.column(qualities[v]) if v in qualities else None)
            else:
                _long_block(gather, layout, block, seconds, wanted)
    except (pa.ArrowException, OSError, UnicodeError, EOFError) as error:
        raise RecordError(
            f"{source.path} cannot be read: {str(error).splitlines()[0]}; export the file again"
        ) from None
    if counts["rows_read"] and counts["timeless"] == counts["rows_read"]:
        raise RecordError(
            f"{source.path}: no time of column {layout.time!r} can be read; name the column with --time, its form with "
            "--time-format"
        )
    return gather.series(), counts


def _stamps(block: Any, layout: Layout) -> Any:
    """The column of times, put together where day and hour stand apart."""
    if not layout.date:
        return block.column(layout.time)
    parts = [pc.utf8_trim_whitespace(pc.cast(block.column(c), pa.string())) for c in (layout.date, layout.time)]
    return pc.binary_join_element_wise(*parts, " ")


def _long_block(gather: Gathered, layout: Layout, block: Any, seconds: Any, wanted: set[str]) -> None:
    """Share a block of (tag, time, value, quality) out among the tags."""
    tags = block.column(layout.tag)
    tags = tags if pa.types.is_dictionary(tags.type) else tags.cast(pa.string()).dictionary_encode()
    tags = tags.combine_chunks() if isinstance(tags, pa.ChunkedArray) else tags
    index = np.asarray(tags.indices.fill_null(-1).to_numpy(zero_copy_only=False))
    (value,) = layout.values
    quality = layout.quality.get(value)
    for i, name in enumerate(tags.dictionary.to_pylist()):
        name = str(name).strip()
        rows = np.flatnonzero(index == i)
        if rows.size and (not wanted or name in wanted):
            part = block.take(pa.array(rows))
            gather.add(name, seconds[rows], part.column(value), part.column(quality) if quality else None)


# ---------------------------------------------------------------------- formats
def _parquet(path: Path) -> Opened:
    file = pq.ParquetFile(path)
    header = tuple(file.schema_arrow.names)
    if not header:
        raise RecordError(f"{path}: the file has no columns")
    first = next(file.iter_batches(batch_size=200), None)
    sample = {n: first.column(i).to_pylist() if first is not None else [] for i, n in enumerate(header)}

    def blocks(names: Sequence[str]) -> Iterator[Any]:
        return pq.ParquetFile(path).iter_batches(batch_size=BLOCK_ROWS, columns=list(names))

    return Opened(path, header, sample, {n: split_header(n)[1] for n in header}, ".", blocks, Counter())


def _text(path: Path, dialect: Dialect) -> Opened:
    sample = {n: [row[i] for row in dialect.rows] for i, n in enumerate(dialect.header)}
    unreadable: Counter[str] = Counter()

    def skip(_row: Any) -> str:
        unreadable["rows"] += 1
        return "skip"

    def blocks(names: Sequence[str]) -> Iterator[Any]:
        stream = pa.input_stream(str(path), compression="gzip" if path.suffix.lower() == ".gz" else None)
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
    return Opened(path, dialect.header, sample, units, dialect.decimal, blocks, unreadable)
