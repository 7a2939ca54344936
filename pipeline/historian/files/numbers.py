"""Cells of an export -> numbers, and the reason where a cell is none."""

from __future__ import annotations

import re
from collections import Counter
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from loopwright.pipeline.historian.files.headers import UNIT
from loopwright.pipeline.historian.files.quality import Reason
from loopwright.pipeline.metrics import Array

EMPTY = ("", "nan", "null", "none", "na", "n/a", "#n/a", "#nv", "-", "--", "?", "<null>", "1.#qnan", "-1.#ind")
# What a number looks like: with a point; with a point or a comma and no thousands; with whatever signs.
PLAIN = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
EITHER_SIGN = re.compile(r"^[+-]?\d+([.,]\d+)?([eE][+-]?\d+)?$")
NUMBER = re.compile(r"^[+-]?(\d[\d.,]*|[.,]\d+)([eE][+-]?\d+)?$")
MINUS = (
    "\u2212\u2010\u2011\u2012\u2013\u2014\ufe58\ufe63\uff0d"  # minus, hyphens and dashes that programs write for one
)
UNSEEN = "\u200b\u200e\u200f\u2060\ufeff\u00ad"  # of no width
BLANKS = " \t\u00a0\u2000-\u200a\u202f\u205f\u3000"
BETWEEN = rf"[{BLANKS}'’‘ʼ`´]"  # between thousands
GROUPED = rf"^[+-]?\d{{1,3}}({BETWEEN}\d{{3}})+([.,]\d*)?([eE][+-]?\d+)?$"
THOUSANDS = {  # by the decimal sign: certain ones, and those of one sign alone, which may be a decimal sign
    ".": (
        r"^[+-]?\d{1,3}(,\d{3})*(,\d{3}\.\d*|,\d{3},\d{3})$", r"^[+-]?\d{1,3},\d{3}$",
        r"^[+-]?\d*,\d+([eE][+-]?\d+)?$",
    ),
    ",": (
        r"^[+-]?\d{1,3}(\.\d{3})*(\.\d{3},\d*|\.\d{3}\.\d{3})$", r"^[+-]?\d{1,3}\.\d{3}$",
        r"^[+-]?\d*\.\d+([eE][+-]?\d+)?$",
    ),
}  # fmt: skip
ODD = re.compile(rf"[{MINUS}{UNSEEN}\uff0b{BLANKS}'’‘ʼ`´]|-$")  # what a plain number has not
WITH_UNIT = r"^(?P<number>[+-]?[\d.,]*\d)(?P<unit>\s*[%°‰]\S*|\s+[^\s\d][^\s\d]*)$"
LOOSE = re.compile(r"[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?")
# Codes of a state, as [-11059] No Good Data or Error 254: a number in brackets before words, or one behind a word that
# is no limit.
LIMITS = (
    "about|above|approx|below|circa|greater|größer|high|kleiner|less|limit|low|max|mehr|min|more|over|smaller|under|unter|"
    r"upper|weniger|über|(?:bar|ca|hi|lo|lod|loq)\b"
)
STATE = re.compile(rf"^\W*(\[[+-]?\d+\]\s*[^\W\d_]|(?!{LIMITS})[^\W\d_]{{3,}})", re.IGNORECASE)

Codes = NDArray[np.uint8]


def numbers(column: Any, decimal: str = ".") -> tuple[Array, Codes, Counter[str]]:
    """Values (n,) of an Arrow column, NaN where there is none; codes (n,) of Reason; the texts that are no numbers."""
    kind = column.type
    if pa.types.is_dictionary(kind):
        column, kind = pc.cast(column, kind.value_type), kind.value_type
    if pa.types.is_null(kind):
        return np.full(len(column), np.nan), np.full(len(column), Reason.EMPTY, np.uint8), Counter()
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        return _of_numbers(column)
    quick = column
    if decimal == ",":
        if pc.any(pc.match_substring(column, ".")).as_py():
            return _of_texts(column, decimal)
        quick = pc.replace_substring(column, ",", ".")
    try:
        # Empty cells are no reason for the slow way.
        found = pc.cast(pc.if_else(pc.equal(quick, ""), pa.scalar(None, kind), quick), pa.float64())
    except pa.ArrowInvalid:
        return _of_texts(column, decimal)
    return _of_numbers(found)


@lru_cache(maxsize=4096)
def plain(text: str) -> str:
    """The cell with the signs of a plain number: every minus is ``-``, no blanks or apostrophes between thousands."""
    if not ODD.search(text):
        return text
    return str(_plain(pa.array([text]))[0])


def loose_number(text: str) -> float | None:
    """The number that a text shows beside other signs, as ``(5,2)`` or ``< 0.5``; None for none, several, or a code."""
    if STATE.search(text):
        return None
    found = LOOSE.findall(plain(text).replace("- ", "-"))
    return float(found[0].replace(",", ".")) if len(found) == 1 else None


def _plain(column: Any) -> Any:
    text = pc.replace_substring_regex(column, f"[{UNSEEN}]", "")
    text = pc.replace_substring_regex(text, f"[{MINUS}]", "-")
    text = pc.replace_substring(text, "\uff0b", "+")
    text = pc.replace_substring_regex(text, rf"^[{BLANKS}]+|[{BLANKS}]+$", "")
    text = pc.replace_substring_regex(text, rf"^([+-])[{BLANKS}]+(\d)", r"\1\2")
    text = pc.replace_substring_regex(text, r"^(\d[\d.,]*)-$", r"-\1")  # 5.2- as some programs write -5.2
    grouped = pc.match_substring_regex(text, GROUPED)
    return pc.if_else(grouped, pc.replace_substring_regex(text, BETWEEN, ""), text)


def _of_numbers(column: Any) -> tuple[Array, Codes, Counter[str]]:
    try:
        column = pc.cast(column, pa.float64(), safe=False)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):  # dates, lists
        return np.full(len(column), np.nan), np.full(len(column), Reason.TEXT, np.uint8), Counter({str(column.type): 1})
    values = np.array(column.to_numpy(zero_copy_only=False), dtype=np.float64)
    codes = np.where(np.isnan(values), np.uint8(Reason.EMPTY), np.uint8(Reason.GOOD))
    endless = np.isinf(values)
    if endless.any():
        codes[endless], values[endless] = Reason.TEXT, np.nan
    return values, codes, Counter({"inf": int(endless.sum())} if endless.any() else {})


def _of_texts(column: Any, decimal: str) -> tuple[Array, Codes, Counter[str]]:
    text = pc.fill_null(pc.utf8_trim_whitespace(column), "")
    points = _with_points(_plain(text), decimal)
    plain_ones = pc.match_substring_regex(points, PLAIN)
    digits = pc.utf8_ltrim(pc.if_else(plain_ones, points, pa.scalar(None, points.type)), "+")
    values = np.array(pc.cast(digits, pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
    empty = pc.is_in(pc.utf8_lower(_plain(text)), value_set=pa.array(EMPTY, text.type)).to_numpy(zero_copy_only=False)
    codes = np.full(len(values), Reason.TEXT, np.uint8)
    codes[empty] = Reason.EMPTY
    codes[np.isfinite(values)] = Reason.GOOD
    values[~np.isfinite(values)] = np.nan
    if not np.any(codes == Reason.GOOD) and (own := _without_unit(text, codes)) is not None:
        return _of_texts(own, decimal)
    words = text.filter(pa.array(codes == Reason.TEXT))
    return values, codes, Counter({row["values"]: row["counts"] for row in pc.value_counts(words).to_pylist()})


def _without_unit(text: Any, codes: Codes) -> Any | None:
    """The texts without the unit that all numbers of a column have, as 60.3 %; None where they have none or several."""
    parts = pc.extract_regex(text, WITH_UNIT)
    units = pc.value_counts(pc.struct_field(parts, "unit")).to_pylist()
    own = [row for row in units if row["values"] is not None]
    if (
        len(own) != 1
        or not UNIT.match(own[0]["values"].strip())
        or 2 * own[0]["counts"] <= np.count_nonzero(codes == Reason.TEXT)
    ):
        return None
    return pc.coalesce(pc.struct_field(parts, "number"), text)


def _with_points(text: Any, decimal: str) -> Any:
    """1.234,5 as 1234.5 where the comma is the decimal sign, 1,234.5 where the point is.

    A number with the other sign is neither, and stays as it is, a text. Where such ones stand beside 1,234 or 1.234,
    these may be either too.
    """
    certain, one_sign, other = THOUSANDS[decimal]
    groups = pc.match_substring_regex(text, certain)
    single = pc.match_substring_regex(text, one_sign)
    strange = pc.and_not(pc.match_substring_regex(text, other), single)
    if not pc.any(strange).as_py():
        groups = pc.or_(groups, single)
    if decimal == ".":
        return pc.if_else(groups, pc.replace_substring(text, ",", ""), text)
    own = pc.if_else(groups, pc.replace_substring(text, ".", ""), text)
    mine = pc.invert(pc.match_substring(own, "."))
    return pc.if_else(mine, pc.replace_substring(own, ",", "."), pc.binary_join_element_wise(own, pa.scalar(""), "?"))
