"""How a text file is written: encoding, separator, decimal sign, header, row of units."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import RecordError

SAMPLE_BYTES = 1 << 18
SAMPLE_LINES = 200
SEPARATORS = ("\t", ";", "|", ",")  # a comma last: it may be the decimal sign
NUMBER = re.compile(r"^\s*[+-]?(\d[\d.,]*|[.,]\d+)([eE][+-]?\d+)?\s*$")
COMMA_DECIMAL = re.compile(r"^\s*[+-]?(\d{1,3}(\.\d{3})+|\d*),\d+([eE][+-]?\d+)?\s*$")
COMMA_THOUSANDS = re.compile(r"^\s*[+-]?\d{1,3}(,\d{3})+(\.\d+)?\s*$")
POINT_DECIMAL = re.compile(r"^\s*[+-]?\d*\.\d+([eE][+-]?\d+)?\s*$")
LONGEST_UNIT = 14  # characters


@dataclass(frozen=True, slots=True)
class Dialect:
    """One text file's way of writing a table."""

    encoding: str
    separator: str
    decimal: str  # "." or ","
    first_line: int  # lines before the first row of values
    header: tuple[str, ...]
    units: tuple[str, ...]  # below the header, "" where none is written
    rows: tuple[tuple[str, ...], ...]  # the first ones

    @property
    def thousands(self) -> str:
        """The sign between thousands."""
        return "." if self.decimal == "," else ","


def sniff(path: Path) -> Dialect:
    """The dialect of a text file, gzipped or not; RecordError where it holds no table."""
    raw = _head(path)
    if not raw.strip():
        raise RecordError(f"{path}: the file is empty; give an export with a header and rows")
    encoding = encoding_of(raw)
    text = codecs.getincrementaldecoder(encoding)(errors="replace").decode(raw)
    lines = text.splitlines()
    lines = lines[: SAMPLE_LINES if len(raw) < SAMPLE_BYTES else min(SAMPLE_LINES, len(lines) - 1)]
    for separator in SEPARATORS:
        cells = list(_split(lines, separator))
        place = _header_line(cells)
        if place is not None:
            break
    else:
        if sum(bool(line.strip()) for line in lines) == 1:
            raise RecordError(f"{path}: there is one line and no row below it; export a longer time")
        raise RecordError(
            f"{path}: no table was found in the first {len(lines)} lines; a header of names and rows of equal length "
            "are wanted, separated by comma, semicolon, tab or |"
        )
    header, below = cells[place], [c for c in cells[place + 1 :] if any(c)]
    units: tuple[str, ...] = ("",) * len(header)
    first = place + 1
    if len(below) > 1 and _are_units(below[0], below[1]):
        units, below, first = tuple(u.strip(" []()") for u in below[0]), below[1:], place + 2
    rows = tuple(tuple(c) for c in below if len(c) == len(header))
    return Dialect(encoding, separator, _decimal(rows), first, _names(path, header), units, rows)


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


def _head(path: Path) -> bytes:
    try:
        with gzip.open(path, "rb") if path.suffix.lower() == ".gz" else path.open("rb") as file:
            return file.read(SAMPLE_BYTES)
    except FileNotFoundError:
        raise RecordError(f"{path}: no such file; give the path of an export") from None
    except (OSError, EOFError, zlib.error) as error:
        raise RecordError(f"{path} cannot be read: {error}; export the file again") from None


def _split(lines: list[str], separator: str) -> Iterator[list[str]]:
    for line in lines:
        try:
            yield [c.strip() for c in next(csv.reader([line.replace("\0", "")], delimiter=separator), [])]
        except csv.Error:
            yield []


def _header_line(cells: list[list[str]]) -> int | None:
    """The line that names the columns: the first of those as long as most, and it holds no number."""
    lengths = Counter(len(c) for c in cells if len(c) > 1)
    if not lengths:
        return None
    length, times = lengths.most_common(1)[0]
    if times < 0.6 * sum(1 for c in cells if any(c)):
        return None
    place = next(i for i, c in enumerate(cells) if len(c) == length)
    filled = [c for c in cells[place] if c]
    return place if filled and not any(NUMBER.match(c) for c in filled) and len(cells) > place + 1 else None


def _are_units(row: list[str], after: list[str]) -> bool:
    filled = [c for c in row[1:] if c]
    numbers = sum(bool(NUMBER.match(c)) for c in after)
    short = all(len(c) <= LONGEST_UNIT and not NUMBER.match(c) for c in filled)
    return bool(filled) and short and not re.match(r"^\d", row[0]) and numbers > 0


def _decimal(rows: tuple[tuple[str, ...], ...]) -> str:
    """The sign that the numbers show; a cell such as 1,234 alone decides for a decimal comma."""
    cells = [c for row in rows for c in row if NUMBER.match(c)]
    comma = sum(bool(COMMA_DECIMAL.match(c)) for c in cells)
    thousands = sum(bool(COMMA_THOUSANDS.match(c)) for c in cells)
    point = sum(bool(POINT_DECIMAL.match(c)) for c in cells)
    return "," if comma > 0 and not (thousands >= comma and point) else "."


def _names(path: Path, header: list[str]) -> tuple[str, ...]:
    names = [name or f"column {i + 1}" for i, name in enumerate(header)]
    twice = [name for name, times in Counter(names).items() if times > 1]
    if twice:
        raise RecordError(f"{path}: column {twice[0]!r} stands twice in the header; rename or remove one of them")
    return tuple(names)
