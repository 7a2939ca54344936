"""The decimal sign of a file's numbers: point or comma, and whether 1,234 is 1.234 or 1234."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.numbers import NUMBER, THOUSANDS, plain
from loopwright.pipeline.historian.table_head import kind_of_cell

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
