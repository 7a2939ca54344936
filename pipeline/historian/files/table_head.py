"""Where the table of a text begins: title lines, the header, rows of units, and the first row of values."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from loopwright.pipeline.historian.files.date_forms import COMPACT, DATE, HOUR, plain_date
from loopwright.pipeline.historian.files.headers import TIME_UNITS, UNIT
from loopwright.pipeline.historian.files.numbers import NUMBER, plain

ISO_DAY = re.compile(r"^\d{4}-\d\d-\d\d([T ].*)?$")
LONGEST_UNIT = 14  # characters
ALIKE_LINES = 0.6  # of the lines have as many cells
UNIT_WORDS = {"", "unit", "units", "einheit", "einheiten", "eu", "engunits", "uom", "unité", "unidad"}
LONGEST_CELL = 40  # characters of a number or time


@dataclass(frozen=True, slots=True)
class Head:
    """The header and the first rows of a table, in rows of ``width`` cells."""

    header: tuple[str, ...]
    units: tuple[str, ...]  # "" where none is written
    first: int  # index of the first row of values
    rows: tuple[tuple[str, ...], ...]  # the first ones


def kind_of_cell(cell: str) -> str:
    """The kind of a cell: "empty", "number", "time" or "text"."""
    if not cell:
        return "empty"
    if len(cell) > LONGEST_CELL:
        return "text"
    if NUMBER.match(cell):
        return "number"
    if not any(c.isdigit() for c in cell):
        return "text"
    if ISO_DAY.match(cell) or HOUR.match(cell) or DATE.match(date := plain_date(cell)) or COMPACT.match(date):
        return "time"
    return "number" if not cell[0].isalpha() and NUMBER.match(plain(cell)) else "text"


def head_of_table(lines: Sequence[Sequence[str]]) -> Head | str:
    """The head of a table in rows of cells; else why there is none, empty where nothing is like a table."""
    lengths = Counter(len(c) for c in lines if len(c) > 1 and any(c))
    if not lengths:
        return ""
    width, times = lengths.most_common(1)[0]
    if times < ALIKE_LINES * sum(1 for c in lines if any(c)):
        return ""
    ends_empty = not any(c[-1] for c in lines if len(c) == width)
    rows = [_of_width(c, width, ends_empty) for c in lines]
    kinds = [None if r is None else [kind_of_cell(c) for c in r] for r in rows]
    anchors = _anchors([k for k in kinds if k is not None], width)
    if not anchors:
        return ""
    first = next((i for i, k in enumerate(kinds) if k is not None and _is_data(k, anchors)), None)
    if first is None:
        return ""
    place = _header_place(rows[:first], kinds[:first])
    if place is None:
        if any(kinds[first][j] == "text" for j in anchors):  # type: ignore[index]  # tags that are numbers
            place = first
        else:
            return _no_header(lines, first, width)
    units: tuple[str, ...] = ("",) * width
    first = place + 1
    while first < len(rows) and not _has_values(kinds[first], anchors):
        row = rows[first]
        if row is not None and any(row) and _are_units(row) and not any(units):
            units = tuple(u.strip(" []()") for u in row)
        first += 1
    body = tuple(tuple(r) for c, r in zip(lines[first:], rows[first:], strict=True) if r is not None and any(c))
    header = rows[place]
    if not body or header is None:
        return ""
    return Head(tuple(header), _without_words(units), first, body)


def _of_width(cells: Sequence[str], width: int, ends_empty: bool) -> list[str] | None:
    """The row with ``width`` cells, where no more than separators at its end are missing or too many."""
    if len(cells) == width:
        return list(cells)
    if len(cells) > width:
        return list(cells[:width]) if cells[0] + "".join(cells[1:width]) and not any(cells[width:]) else None
    return [*cells, ""] if ends_empty and len(cells) == width - 1 else None


def _anchors(kinds: Sequence[Sequence[str]], width: int) -> dict[int, str]:
    """Columns that hold numbers or times in most rows, and which of them."""
    found = {}
    for j in range(width):
        counts = Counter(k[j] for k in kinds if k[j] != "empty")
        if counts:
            kind, times = counts.most_common(1)[0]
            if kind != "text" and 2 * times >= sum(counts.values()):
                found[j] = kind
    return found


def _is_data(kinds: Sequence[str], anchors: dict[int, str]) -> bool:
    """Whether a row has values: none without its time or with it alone, as a dated title; more numbers than texts."""
    right = sum(kinds[j] == kind for j, kind in anchors.items())
    wrong = sum(kinds[j] == "text" for j in anchors)
    lead = min((j for j, kind in anchors.items() if kind == "time"), default=min(anchors))
    return right > min(1, len(anchors) - 1) and right >= wrong and kinds[lead] == anchors[lead]


def _has_values(kinds: Sequence[str] | None, anchors: dict[int, str]) -> bool:
    return kinds is not None and any(kinds[j] == kind for j, kind in anchors.items())


def _header_place(rows: Sequence[Sequence[str] | None], kinds: Sequence[Sequence[str] | None]) -> int | None:
    """The line that names most columns; titles above it, and units below it, name fewer."""
    best, place = 0, None
    for i, (row, kind) in enumerate(zip(rows, kinds, strict=True)):
        if row is None or kind is None or not any(row) or "time" in kind:
            continue
        if place is not None and row[0].strip().lower().rstrip(":") in UNIT_WORDS and _are_units(row):
            continue
        filled = 2 * sum(bool(c) for c in row[1:]) + bool(row[0])
        if filled > best and (filled // 2 > best // 2 or place is None):
            best, place = filled, i
    return place


def _are_units(row: Sequence[str]) -> bool:
    """Whether most cells are units, or all are short words beside an empty one or the word unit."""
    filled = [c.strip(" []()") for c in row[1:] if c]
    units = [c for c in filled if UNIT.match(c) or c.lower() in TIME_UNITS]
    short = all(len(c) <= LONGEST_UNIT and kind_of_cell(c) == "text" for c in filled)
    named = row[0].strip().lower().rstrip(":") in UNIT_WORDS
    return bool(filled) and short and (named or 2 * len(units) >= len(filled))


def _without_words(units: Sequence[str]) -> tuple[str, ...]:
    return ("" if units[0].lower().rstrip(":") in UNIT_WORDS else units[0], *units[1:])


def _no_header(lines: Sequence[Sequence[str]], first: int, width: int) -> str:
    for i, cells in enumerate(lines[:first]):
        filled = [c for c in cells if c]
        if len(filled) > 1 and len(cells) != width and all(kind_of_cell(c) == "text" for c in filled):
            return (
                f"the header in line {i + 1} names {len(cells)} columns and the rows have {width}; give every column a "
                "name, and let no decimal comma be the separator too"
            )
    return f"no line above line {first + 1}, the first of values, names the {width} columns; write a header there"
