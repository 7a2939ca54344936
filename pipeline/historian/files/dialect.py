"""How a text file is written: encoding, separator, decimal sign, header, row of units; and files that are no text."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.headers import split_header
from loopwright.pipeline.historian.files.numbers import NUMBER, THOUSANDS, plain
from loopwright.pipeline.historian.files.quality import is_quality_name
from loopwright.pipeline.historian.files.table_head import Head, head_of_table, kind_of_cell

# ------------------------------------------------------------------------ files that are no text, by their first bytes
GZIP, PARQUET, ZIP = b"\x1f\x8b", b"PAR1", b"PK\x03\x04"
# First bytes -> what the file is, and what to do with it.
OTHERS: tuple[tuple[bytes, str, str], ...] = (
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old Excel workbook (.xls)", "save it as .xlsx or .csv"),
    (b"%PDF", "a PDF", "export the readings as .csv, .xlsx or .parquet"),
    (b"SQLite format 3\x00", "an SQLite database", "export the table of readings as .csv or .parquet"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file, or a MATLAB file of version 7.3", "write its table as .csv or .parquet"),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file", "write its table as .csv, with writetable"),
    (b"ARROW1", "an Arrow or Feather file", "write its table as .parquet"),
    (b"{\\rtf", "a document (.rtf)", "export the readings as .csv, .xlsx or .parquet"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", "unpack it and give the files in it"),
    (b"Rar!", "a rar archive", "unpack it and give the files in it"),
    (b"BZh", "a bzip2 archive", "unpack it and give the file in it"),
    (b"\xfd7zXZ", "an xz archive", "unpack it and give the file in it"),
    (b"\x28\xb5\x2f\xfd", "a zstd archive", "unpack it and give the file in it"),
)
MARKUP = ((b"<!doctype html", "a web page (HTML)"), (b"<html", "a web page (HTML)"), (b"<table", "a web page (HTML)"),
          (b"<?xml", "an XML file"))  # fmt: skip


def kind_of(path: Path) -> str:
    """How a file is to be read: "parquet", "workbook", "gzip" or "text".

    RecordError that names what it is where it is none of these.
    """
    with path.open("rb") as file:
        first = file.read(512)
    if first.startswith(PARQUET):
        return "parquet"
    if first.startswith(GZIP):
        return _gzipped(path)
    if first.startswith(ZIP):
        return _zipped(path)
    for mark, what, remedy in OTHERS:
        if first.startswith(mark):
            raise RecordError(f"{path} is {what}; {remedy}")
    begin = first.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    for mark, what in MARKUP:
        if begin.startswith(mark):
            raise RecordError(f"{path} is {what}; open it in a spreadsheet and save it as .xlsx or .csv")
    if begin.startswith((b'{"', b"{\n", b"{\r", b"[{", b"[\n", b"[[", b"{ ")):
        raise RecordError(f"{path} is a JSON file; write its table as .csv or .parquet")
    return "text"


def _gzipped(path: Path) -> str:
    try:
        first = head_of(path, "gzip", 512)
    except (OSError, EOFError, zlib.error):
        return "gzip"  # cut off, and said so where it is read
    kinds = (PARQUET, "a Parquet file"), (ZIP, "a workbook or a zip archive"), *((m, w) for m, w, _ in OTHERS)
    for mark, what in kinds:
        if first.startswith(mark):
            raise RecordError(f"{path} is {what}, gzipped; unpack it and give the file in it")
    return "gzip"


def _zipped(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            kind = archive.read("mimetype")[:80] if "mimetype" in names else b""
    except (zipfile.BadZipFile, OSError, KeyError, RuntimeError):
        raise RecordError(f"{path} is a zip archive, or a workbook, that is cut off; export the file again") from None
    if "xl/workbook.xml" in names:
        return "workbook"
    if "xl/workbook.bin" in names:
        raise RecordError(f"{path} is a binary Excel workbook (.xlsb); save it as .xlsx or .csv")
    if b"opendocument" in kind:
        raise RecordError(f"{path} is an OpenDocument file (.ods); save it as .xlsx or .csv")
    shown = ", ".join(names[:3])
    raise RecordError(f"{path} is a zip archive of {len(names)} files ({shown}); unpack it and give the files in it")


def head_of(path: Path, kind: str, size: int) -> bytes:
    """The first ``size`` bytes of a text, unpacked where it is gzipped."""
    with gzip.open(path, "rb") if kind == "gzip" else path.open("rb") as file:
        return file.read(size)


# ------------------------------------------------------------------ point or comma, and whether 1,234 is 1.234 or 1234
COMMA_DECIMAL = re.compile(r"^\s*[+-]?(\d{1,3}(\.\d{3})+|\d*),\d+([eE][+-]?\d+)?\s*$")
POINT_DECIMAL = re.compile(r"^\s*[+-]?\d*\.\d+([eE][+-]?\d+)?\s*$")
EITHER = re.compile(r"^[+-]?[1-9]\d{0,2}(?P<sign>[.,])\d{3}$")  # 1,234 is 1.234 or 1234
SMALL = re.compile(r"^[+-]?[1-9]\d{0,2}$")
CODES = {99, 999}  # of a reading that failed: alone they are no smaller numbers of the same kind
BESIDE = np.log(1.5)  # numbers of one kind: a code as 500 beside 1.234 is neither
OTHER = {".": ",", ",": "."}


@dataclass(frozen=True, slots=True)
class Sign:
    """The decimal sign that cells show; ``unclear`` are the columns of cells like 1,234 where nothing tells it."""

    decimal: str
    unclear: tuple[str, ...] = ()
    example: str = ""


def decimal_sign(columns: Mapping[str, Sequence[str]], separator: str, where: str) -> Sign:
    """The sign that most numbers show.

    Where all are like 1,234 the comma is between thousands if it separates cells, or if smaller numbers of the column,
    as 998, are of that size. So is the point. RecordError where columns disagree.
    """
    own = {
        name: [c if NUMBER.match(c) else plain(c) for c in cells if kind_of_cell(c) == "number"]
        for name, cells in columns.items()
    }
    every = [c for cells in own.values() for c in cells]
    comma = sum(bool(COMMA_DECIMAL.match(c)) and not EITHER.match(c) for c in every)
    point = sum(bool(POINT_DECIMAL.match(c)) and not EITHER.match(c) for c in every)
    if comma or point:
        return Sign("," if comma > point else ".")
    for decimal, (certain, *_) in THOUSANDS.items():
        if any(re.match(certain, c) for c in every):
            return Sign(decimal)
    signs = {
        name: found for name, cells in own.items() if (found := {m["sign"] for c in cells if (m := EITHER.match(c))})
    }
    if separator == "," or not signs:
        return Sign(".")
    example = {m["sign"]: c for c in every if (m := EITHER.match(c))}
    votes = {decimal for name, found in signs.items() if len(found) == 1 and (decimal := _by_size(own[name], *found))}
    both = len(set.union(*signs.values())) > 1
    if len(votes) == 1:
        return Sign(votes.pop())
    if votes:
        raise RecordError(_refused(where, example))
    (first, *_) = signs.values()
    sign = "" if both else min(first)
    return Sign(sign, tuple(signs), " and ".join(example.values()))


def whole_files_sign(
    first: Sign, blocks: Callable[[Sequence[str]], Iterable[Mapping[str, Sequence[str]]]], separator: str, where: str
) -> Sign:
    """The sign by cells from all over the unclear columns, block by block until one tells it.

    RecordError where cells like 1,234 and 1.234 stand in one file, and nothing tells which are decimals.
    """
    if not first.unclear:
        return first
    cells: dict[str, list[str]] = {name: [] for name in first.unclear}
    for block in blocks(first.unclear):
        for name, own in block.items():
            cells[name] += own
        sign = decimal_sign(cells, separator, where)
        if not sign.unclear:
            return sign
    if not first.decimal:
        raise RecordError(_refused(where, {"": first.example}))
    return first


def _refused(where: str, example: Mapping[str, str]) -> str:
    shown = " and ".join(example.values())
    return f"{where}: {shown} may be decimals or thousands; export numbers without a sign between thousands"


def _by_size(cells: Sequence[str], sign: str) -> str:
    """The decimal sign by the size of smaller numbers beside those like 1,234: "" where none tells it."""
    small = np.array([abs(float(c)) for c in cells if SMALL.match(c)])
    if not small.size or set(small.tolist()) in ({code} for code in CODES):
        return ""
    numbers = np.array([abs(float(c.replace(",", "."))) for c in cells if EITHER.match(c)])
    away = {}
    for decimal, scale in ((sign, 1.0), (OTHER[sign], 1000.0)):
        low, high = np.log(scale * numbers.min()), np.log(scale * numbers.max())
        away[decimal] = float(np.median(np.maximum(np.maximum(low - np.log(small), np.log(small) - high), 0)))
    near = min(away, key=away.__getitem__)
    return near if away[near] < BESIDE < max(away.values()) else ""


# ----------------------------------------------------------------------------------------------------- the whole of it
SAMPLE_BYTES = 1 << 18  # bytes at the start of a file by which its dialect is recognized; read at once, too
SAMPLE_LINES = 200  # lines by which separators and decimals are recognized
SEPARATORS = ("\t", ";", "|", ",")  # a comma last: it may be the decimal sign
LONGEST_HEADER = 6  # lines of one header, with line breaks in quoted names


@dataclass(frozen=True, slots=True)
class Dialect:
    """One text file's way of writing a table."""

    encoding: str
    separator: str
    sign: Sign  # of decimals, by the first rows
    first_line: int  # lines before the first row of values
    header: tuple[str, ...]  # of every column, "column 3" where none is written
    units: tuple[str, ...]  # below the header, "" where none is written
    rows: tuple[tuple[str, ...], ...]  # the first ones
    unused: frozenset[str]  # columns without a name and a value, as of rows that end with a separator

    @property
    def decimal(self) -> str:
        """The point or the comma; empty where the first rows do not tell it."""
        return self.sign.decimal


def sniff(path: Path, kind: str = "text", encoding: str = "") -> Dialect:
    """The dialect of a text file, gzipped or not; RecordError where it holds no table. ``encoding`` "" is found."""
    raw = _head(path, kind)
    if not raw.strip():
        raise RecordError(f"{path}: the file is empty; give an export with a header and rows")
    encoding = encoding or encoding_of(raw)
    text = codecs.getincrementaldecoder(encoding)(errors="replace").decode(raw)
    lines = re.split(r"\r\n|\n|\r", text)
    lines = lines[: SAMPLE_LINES if len(raw) < SAMPLE_BYTES else min(SAMPLE_LINES, len(lines) - 1)]
    failures = []
    for separator in SEPARATORS:
        rows, after = _split(lines, separator)
        found = head_of_table(rows)
        if isinstance(found, Head):
            break
        failures.append(found)
    else:
        if sum(bool(line.strip()) for line in lines) == 1:
            raise RecordError(f"{path}: there is one line and no row below it; export a longer time")
        why = next((f for f in failures if f), "a header of names and rows of equal length are wanted, separated by "
                   "comma, semicolon, tab or |")  # fmt: skip
        raise RecordError(f"{path}: no table was found in the first {len(lines)} lines; {why}")
    header = names_of(path, found.header)
    unused = frozenset(n for i, n in enumerate(header) if not found.header[i] and not any(r[i] for r in found.rows))
    first = after[found.first - 1]
    columns = dict(zip(header, zip(*found.rows, strict=True), strict=True))
    sign = decimal_sign(columns, separator, str(path))
    return Dialect(encoding, separator, sign, first, header, found.units, found.rows, unused)


def encoding_of(raw: bytes) -> str:
    """utf-8-sig, utf-16, utf-8, or cp1252 for whatever is none of them."""
    if raw.startswith(codecs.BOM_UTF8):
        return "utf-8-sig"
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if raw[:400].count(0) > len(raw[:400]) // 4:  # a text in Latin letters has a zero in every second byte
        return "utf-16-le" if raw[1:2] == b"\0" else "utf-16-be"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(raw)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def is_utf8(path: Path) -> bool:
    """Whether a whole file, unpacked, is a text in UTF-8."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        with gzip.open(path, "rb") if kind_of(path) == "gzip" else path.open("rb") as file:
            while part := file.read(SAMPLE_BYTES):
                decoder.decode(part)
    except UnicodeDecodeError:
        return False
    except (OSError, EOFError, zlib.error):  # cut off, and said so elsewhere
        return True
    return True


def names_of(path: Path, header: Sequence[str]) -> tuple[str, ...]:
    """A name for each column: a quality that stands beside every tag under one name gets its tag's too.

    RecordError where a name stands twice.
    """
    names = [" ".join(name.split()) or f"column {i + 1}" for i, name in enumerate(header)]
    twice = {name for name, times in Counter(names).items() if times > 1}
    for i, name in enumerate(names):
        if name in twice and i and is_quality_name(split_header(name)[0]) and names[i - 1] not in twice:
            names[i] = f"{split_header(names[i - 1])[0]} {name}"
    twice = {name for name, times in Counter(names).items() if times > 1}
    if twice:
        first = next(name for name in names if name in twice)
        pairs = "; where each tag has a column of times, export one for all, or a file a tag" * (
            split_header(first)[0].lower() in {"time", "timestamp", "date", "datetime", "zeit", "zeitstempel"}
        )
        raise RecordError(f"{path}: column {first!r} stands twice in the header; rename or remove one of them{pairs}")
    return tuple(names)


def _head(path: Path, kind: str) -> bytes:
    try:
        return head_of(path, kind, SAMPLE_BYTES)
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; give the path of an export") from None
    except (OSError, EOFError, zlib.error) as error:
        raise RecordError(f"{path} cannot be read: {error}; export the file again") from None


def _ends_in_quotes(text: str, separator: str) -> bool:
    """Whether a quoted cell goes on behind the text; a quote within a cell, as of 3" valve, opens none."""
    quoted = False
    begins = True  # a cell
    for sign in text:
        if sign == '"' and (quoted or begins):
            quoted = not quoted
        begins = not quoted and (sign in (separator, "\n") or (begins and sign == " "))
    return quoted


def _split(lines: Sequence[str], separator: str) -> tuple[list[list[str]], list[int]]:
    """Rows of cells, and the number of lines up to each row's end: a quoted name may hold line breaks."""
    rows, after, k = list[list[str]](), list[int](), 0
    while k < len(lines):
        n = 1
        while '"' in lines[k] and _ends_in_quotes("\n".join(lines[k : k + n]), separator):
            n += 1
            if n > LONGEST_HEADER or k + n > len(lines):
                n = 1
                break
        text = " ".join(lines[k : k + n]).replace("\0", "")
        try:
            rows.append([c.strip() for c in next(csv.reader([text], delimiter=separator), [])])
        except csv.Error:
            rows.append([])
        k += n
        after.append(k)
    return rows, after
