"""Time stamps of an export -> seconds since 1970 (UTC, or local where no zone is written) or since any start."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.errors import RecordError
from pipeline.metrics import Array
from pipeline.records.record_file import split_column

NAMES = {
    "time_s", "time", "timestamp", "datetime", "date", "date time", "date/time", "datetimeutc", "ts", "t", "zeit",
    "zeitstempel", "datum", "time stamp", "utc", "epoch", "index",
}  # fmt: skip
ISO = re.compile(r"^\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d([.,]\d+)?)?)?\s*(Z|[+-]\d\d:?(\d\d)?)?$", re.IGNORECASE)
ZONE = re.compile(r"\d\s*(Z|[+-]\d\d:?(\d\d)?)$", re.IGNORECASE)
NUMERIC = re.compile(r"^[+-]?\d+([.,]\d+)?([eE][+-]?\d+)?$")
SHORT = re.compile(r"^(\d{1,4})([./-])(\d{1,2}|[A-Za-z]{3})\2(\d{4}|\d{2})(?=\D|$)(.*)$")
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
EXCEL_DAYS = 20_000.0, 80_000.0  # since 1899-12-30: years 1954 to 2119
EXCEL_EPOCH_S = 25_569 * 86_400.0
SINCE_1970_S = 1e8  # numbers of seconds from here on (1973) count from 1970; smaller ones from some start
UTC, UNSTATED = "UTC", "the export states no zone"


@dataclass(frozen=True, slots=True)
class Clock:
    """How one column writes time: ``iso``, ``number`` (seconds = scale x value - start_s) or a ``format``."""

    kind: str
    scale: float = 1.0
    start_s: float = 0.0
    format: str = ""

    def seconds(self, column: Any) -> Array:
        """Seconds (n,) of an Arrow column (n,); NaN where a stamp cannot be read."""
        if pa.types.is_timestamp(column.type) or pa.types.is_date(column.type):
            return _of_timestamps(pc.cast(column, pa.timestamp("us", getattr(column.type, "tz", None)), safe=False))
        if self.kind == "number":
            if pa.types.is_string(column.type):
                column = pc.replace_substring(pc.utf8_trim_whitespace(column), ",", ".")
                try:
                    column = pc.cast(column, pa.float64())
                except pa.ArrowInvalid:
                    column = pa.array([_number(c) for c in column.to_pylist()], pa.float64())
            values = np.asarray(pc.cast(column, pa.float64(), safe=False).to_numpy(zero_copy_only=False), np.float64)
            return values * self.scale - self.start_s
        if self.kind == "iso":
            return _iso(column)
        import pandas as pd  # only files with such dates need it

        stamps = pd.to_datetime(column.to_pandas().str.strip(), format=self.format, errors="coerce")
        return _of_timestamps(pa.array(stamps.dt.as_unit("us")))


def clock_of(name: str, sample: Sequence[Any], where: str) -> Clock | None:
    """The clock of a column by its name and first cells (texts or numbers); None where they are no times.

    RecordError for a date whose day and month cannot be told apart.
    """
    cells = [c for c in sample if c is not None and str(c).strip() != ""]
    if not cells:
        return None
    texts = [str(c).strip() for c in cells]
    if all(isinstance(c, int | float) for c in cells) or all(NUMERIC.match(t) for t in texts):
        return _numeric(name, np.array([float(t.replace(",", ".")) for t in texts]))
    if _most(texts, ISO):
        return Clock("iso")
    if _most(texts, SHORT):
        return Clock("format", format=_format(texts, where))
    return None


def zone_of(clock: Clock, sample: Sequence[Any]) -> str:
    """The zone that a clock's seconds count in, by the first cells: UTC, or UNSTATED; "" where they are no dates."""
    cells = [c for c in sample if c is not None and str(c).strip() != ""]
    if not cells:
        return ""
    if isinstance(cells[0], date):
        return UTC if getattr(cells[0], "tzinfo", None) else UNSTATED
    if clock.kind == "number":
        first = float(str(cells[0]).replace(",", ".")) * clock.scale - clock.start_s
        return "" if first < SINCE_1970_S else UNSTATED if clock.start_s else UTC
    if clock.kind == "iso":
        return UTC if ZONE.search(str(cells[0]).strip()[10:]) else UNSTATED
    return UNSTATED


def _most(texts: Sequence[str], pattern: re.Pattern[str]) -> bool:
    return 2 * sum(bool(pattern.match(t)) for t in texts) > len(texts)


def _numeric(name: str, values: Array) -> Clock | None:
    base, unit = split_column(name)
    base = base.lower()
    tail = base.rpartition("_")[2]
    unit = unit or (tail if tail in UNITS and base != tail else "")
    if base not in NAMES and not base.startswith(("time", "t_", "epoch", "timestamp", "unix")):
        return None
    size = float(np.median(np.abs(values)))
    if unit in UNITS and unit != "s":
        return Clock("number", UNITS[unit])
    if unit != "s" and EXCEL_DAYS[0] < size < EXCEL_DAYS[1] and np.ptp(values) < 2.0 and np.any(values % 1):
        return Clock("number", 86_400.0, EXCEL_EPOCH_S)
    # Seconds since 1970 have ten digits, milliseconds thirteen.
    scale = 1.0 if size < 1e11 else 1e-3 if size < 1e14 else 1e-6 if size < 1e17 else 1e-9
    return Clock("number", scale)


def _format(texts: Sequence[str], where: str) -> str:
    found = [m for m in map(SHORT.match, texts) if m]
    _, sign, second, year, rest = found[0].groups()
    if second.isalpha():
        order = ["%d", "%b"]
    else:
        firsts, seconds = [int(m[1]) for m in found], [int(m[3]) for m in found if m[3].isdigit()]
        if max(firsts) > 12 or sign == ".":
            order = ["%d", "%m"]
        elif max(seconds) > 12:
            order = ["%m", "%d"]
        else:
            raise RecordError(
                f"{where}: {texts[0]!r} may be month/day or day/month; give --time-format, "
                "for example '%d/%m/%Y %H:%M:%S', or export ISO-8601 times"
            )
    date = sign.join([*order, "%Y" if len(year) == 4 else "%y"])
    clock = ["%H", "%M", "%S"][: rest.count(":") + 1] if ":" in rest else []
    half = rest.strip().upper().endswith(("AM", "PM"))
    hours = ":".join(clock).replace("%H", "%I" if half else "%H")
    fraction = re.search(r":\d\d([.,])\d+", rest) if rest.count(":") > 1 else None
    separator = "T" if rest.startswith("T") else " "
    return (
        date + (separator + hours if clock else "") + (f"{fraction[1]}%f" if fraction else "") + (" %p" if half else "")
    )


def _iso(column: Any) -> Array:
    text = pc.utf8_trim_whitespace(column)
    first = next((t for t in text.slice(0, 50).to_pylist() if t), "")
    zone = "UTC" if ZONE.search(first[10:]) else None
    try:
        return _of_timestamps(pc.cast(text, pa.timestamp("us", zone)))
    except pa.ArrowInvalid:
        import pandas as pd  # slower, and it takes what Arrow does not: a decimal comma, a missing minute, nonsense

        words = text.to_pandas().str.replace(",", ".", regex=False)
        stamps = pd.to_datetime(words, format="ISO8601", errors="coerce", utc=True)
        return _of_timestamps(pa.array(stamps.dt.tz_localize(None).dt.as_unit("us")))


def _of_timestamps(stamps: Any) -> Array:
    """Seconds of an Arrow array of microseconds; NaN where it is null."""
    whole = pc.cast(stamps, pa.int64())
    values = np.asarray(pc.fill_null(whole, 0).to_numpy(zero_copy_only=False), dtype=np.float64) * 1e-6
    if whole.null_count:
        values[np.asarray(pc.is_null(whole).to_numpy(zero_copy_only=False), dtype=bool)] = np.nan
    return values


def _number(cell: str | None) -> float:
    try:
        return float(cell) if cell else float("nan")
    except ValueError:
        return float("nan")
