"""Cells of an export -> numbers, and the reason where a cell is none."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from pipeline.historian.reason import Reason
from pipeline.metrics import Array

EMPTY = ("", "nan", "null", "none", "na", "n/a", "#n/a", "#nv", "-", "--", "?", "<null>")
PLAIN = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"

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
    if decimal == ",":
        column = _with_points(column)
    try:
        # Empty cells are no reason for the slow way.
        found = pc.cast(pc.if_else(pc.equal(column, ""), pa.scalar(None, kind), column), pa.float64())
    except pa.ArrowInvalid:
        return _of_texts(column, "" if decimal == "," else ",")
    return _of_numbers(found)


def _with_points(column: Any) -> Any:
    """1.234,5 as 1234.5; a number with a decimal point among those with a comma may be either, and becomes a text."""
    if pc.any(pc.match_substring(column, ".")).as_py():
        grouped = pc.match_substring_regex(column, r"^\s*[+-]?\d{1,3}(\.\d{3})+(,\d+)?\s*$")
        column = pc.if_else(grouped, pc.replace_substring(column, ".", ""), pc.replace_substring(column, ".", " . "))
    return pc.replace_substring(column, ",", ".")


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


def _of_texts(column: Any, thousands: str) -> tuple[Array, Codes, Counter[str]]:
    text = pc.fill_null(pc.utf8_trim_whitespace(column), "")
    if thousands:
        grouped = pc.match_substring_regex(text, r"^[+-]?\d{1,3}(,\d{3})+(\.\d+)?$")
        text = pc.if_else(grouped, pc.replace_substring(text, thousands, ""), text)
    plain = pc.match_substring_regex(text, PLAIN)
    digits = pc.utf8_ltrim(pc.if_else(plain, text, pa.scalar(None, text.type)), "+")
    values = np.array(pc.cast(digits, pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
    empty = pc.is_in(pc.utf8_lower(text), value_set=pa.array(EMPTY, text.type)).to_numpy(zero_copy_only=False)
    codes = np.full(len(values), Reason.TEXT, np.uint8)
    codes[empty] = Reason.EMPTY
    codes[np.isfinite(values)] = Reason.GOOD
    values[~np.isfinite(values)] = np.nan
    words = text.filter(pa.array(codes == Reason.TEXT))
    return values, codes, Counter({row["values"]: row["counts"] for row in pc.value_counts(words).to_pylist()})
