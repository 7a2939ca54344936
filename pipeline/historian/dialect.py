"""How a text file is written: encoding, separator, decimal sign, header, row of units."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.decimal_sign import Sign, decimal_sign
from loopwright.pipeline.historian.file_kinds import head_of, kind_of
from loopwright.pipeline.historian.headers import split_header
from loopwright.pipeline.historian.quality import is_quality_name
from loopwright.pipeline.historian.table_head import Head, head_of_table

SAMPLE_BYTES = 1 << 18
SAMPLE_LINES = 200
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
