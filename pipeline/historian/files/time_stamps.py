"""Time stamps of an export -> seconds since 1970 (UTC, or local where no zone is written) or since any start."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta, timezone, tzinfo
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.date_forms import (
    DAY_S,
    DAYS,
    ELAPSED,
    MIDNIGHT,
    SERIAL,
    UnclearCountError,
    calendar_digits,
    days_of,
    form_of,
    other_forms,
    plain_date,
)
from loopwright.pipeline.historian.files.headers import NO_UNITS, SPELLINGS, TIME_UNITS, TimeHeader, time_header
from loopwright.pipeline.historian.files.numbers import EITHER_SIGN
from loopwright.pipeline.metrics import Array

# --------------------------------------------------------------------------- the zone of local times, over summer time
OFFSET = re.compile(r"^(?:UTC|GMT)?(?P<sign>[+-])(?P<hours>\d{1,2})(?::?(?P<minutes>\d\d))?$", re.IGNORECASE)
HOUR_S = 3600.0  # [s] that a clock jumps by in spring and autumn
SET_BACK_S = 600.0  # against the order of the file; less is disorder
NO_CHANGES = np.zeros((0, 3))


def zone_named(text: str) -> tzinfo:
    """The zone of a name as Europe/Berlin, or of an offset as +01:00; RecordError where it is neither."""
    if match := OFFSET.match(text.strip()):
        minutes = 60 * int(match["hours"]) + int(match["minutes"] or 0)
        if minutes <= 14 * 60:
            return timezone(timedelta(minutes=-minutes if match["sign"] == "-" else minutes))
    if text.strip().upper() in {"UTC", "Z", "GMT"}:
        return UTC
    try:
        return ZoneInfo(text.strip())
    except (ZoneInfoNotFoundError, ValueError, OSError, ModuleNotFoundError):
        raise RecordError(
            f"--time-zone {text}: no such zone; write a name as Europe/Berlin, or an offset as +01:00"
        ) from None


@dataclass(slots=True)
class LocalClock:
    """A clock of one file on the wall, read block by block in the order of the file.

    In the hour that comes twice the first pass is summer time; the second begins where the times go back. A file with
    the newest row first is read the other way round.
    """

    name: str
    zone: tzinfo
    second: bool = False  # the second pass of an hour that comes twice
    last_s: float = -np.inf
    falls: bool | None = None  # the newest row comes first
    told: int = 0  # readings of hours that come twice, by their order
    missing: list[float] = field(default_factory=list)  # local times that the clock skipped

    def utc(self, local_s: Array) -> Array:
        """Seconds since 1970 (n,) of local ones (n,), NaN where they are."""
        known = np.flatnonzero(np.isfinite(local_s))
        out = np.full(len(local_s), np.nan)
        if not known.size:
            return out
        local = local_s[known]
        if self.falls is None:
            steps = np.diff(local)
            self.falls = bool(np.count_nonzero(steps < 0) > np.count_nonzero(steps > 0))
        changes = self._changes(float(local.min()), float(local.max()))
        offset = np.full(len(local), self._offset(datetime.fromtimestamp(float(local.min()) - DAY_S, UTC)))
        for at, before, after in changes:
            offset[local >= at + max(before, after)] = after
            skipped = (local >= at + before) & (local < at + after)
            if skipped.any():
                self.missing += local[skipped].tolist()
            twice = (local >= at + after) & (local < at + before)
            offset[twice] = np.where(self._second_pass(local, twice), after, before)
        out[known] = local - offset
        self.last_s = float(local[-1])
        return out

    def _second_pass(self, local: Array, twice: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Where readings of an hour that comes twice (m,) lie after the clock was set back."""
        place = np.flatnonzero(twice)
        if not place.size:
            return np.zeros(0, dtype=bool)
        self.told += int(place.size)
        steps = np.diff(local) * (-1.0 if self.falls else 1.0)
        usual_s = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
        stamps_repeat = bool(np.any(np.delete(steps, np.minimum(place, len(steps) - 1)) == 0)) if len(steps) else True
        before = np.r_[self.last_s, local[:-1]][place]
        own = local[place]
        entered = np.r_[place[0] == 0 or not twice[place[0] - 1], np.diff(place) > 1]
        if place[0] == 0 and np.isfinite(self.last_s):  # the hour goes on from the block before
            entered[0] = abs(own[0] - self.last_s) >= HOUR_S
        out = np.zeros(len(place), dtype=bool)
        second = self.second
        for i in range(len(place)):
            back_s = (before[i] - own[i]) * (-1.0 if self.falls else 1.0)
            if entered[i]:
                begins = place[i] == 0 and self._begins_second(local, twice, usual_s, stamps_repeat=stamps_repeat)
                second = bool(self.falls) or begins
            elif back_s > SET_BACK_S or (back_s == 0 and usual_s >= HOUR_S and not stamps_repeat):
                second = not self.falls
            out[i] = second
        self.second = second
        return out

    def _begins_second(self, local: Array, twice: NDArray[np.bool_], usual_s: float, *, stamps_repeat: bool) -> bool:
        """Whether the file begins in the second pass: it goes on beyond the hour without a gap, and never back."""
        if np.isfinite(self.last_s) or twice.all():
            return False
        steps = np.diff(local[: int(np.argmin(twice)) + 1])
        on = bool(np.all(steps >= 0 if stamps_repeat else steps > 0))
        return on and float(steps[-1]) < usual_s + HOUR_S / 2

    def _offset(self, utc: datetime) -> float:
        offset = utc.astimezone(self.zone).utcoffset()
        return 0.0 if offset is None else offset.total_seconds()

    def _changes(self, first_s: float, last_s: float) -> Array:
        """Rows (time UTC, offset before, offset after) [s] of each change of the clock near some local times."""
        found = []
        days = np.arange(first_s - 2 * DAY_S, last_s + 2 * DAY_S, DAY_S)
        if len(days) > 100_000:
            raise RecordError("the times of the export cover more than 270 years; check --time and --time-format")
        offsets = [self._offset(datetime.fromtimestamp(float(d), UTC)) for d in days]
        for k in np.flatnonzero(np.diff(offsets)):
            low, high = float(days[k]), float(days[k + 1])
            while high - low > 1:  # the second of the change
                middle = np.floor((low + high) / 2)
                if self._offset(datetime.fromtimestamp(middle, UTC)) == offsets[k]:
                    low = middle
                else:
                    high = middle
            found.append((np.ceil(high), offsets[k], offsets[k + 1]))
        return np.array(found).reshape(-1, 3) if found else NO_CHANGES


# -------------------------------------------------------------------------------------------------------------- stamps
ISO = re.compile(r"^\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d([.,]\d+)?)?)?\s*(Z|[+-]\d\d:?(\d\d)?)?$", re.IGNORECASE)
ZONE = re.compile(r"\d\s*(Z|[+-]\d\d:?(\d\d)?)$", re.IGNORECASE)
SINCE_1970_S = 1e8  # numbers of seconds from here on (1973) count from 1970; smaller ones from some start
IN_UTC, UNSTATED = "UTC", "the export states no zone"


# Ticks of 100 ns: of .NET since the year 1, of Windows since 1601.
TICK_COUNTS = ((6.2e17, 6.6e17, 62_135_596_800.0), (1.25e17, 1.45e17, 11_644_473_600.0))
STARTS = {d.at_1970 * DAY_S for d in DAYS}
SERIAL_UNIT = "serial"


@dataclass(frozen=True, slots=True)
class TimeForm:
    """How one column writes time: ``iso``, ``number`` (seconds = scale x value - start_s), ``elapsed`` or a ``format``.

    ``elapsed`` is 26:03:10 since some start. ``says`` is what was taken for granted, for a person; empty where all is
    written. ``certain`` is False where only the want of a unit makes numbers seconds.
    """

    kind: str
    scale: float = 1.0
    start_s: float = 0.0
    format: str = ""
    says: str = ""
    certain: bool = True

    @property
    def dates(self) -> bool:
        """Whether the column writes dates, and no numbers or hours alone."""
        return self.kind in {"iso", "format"}

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
        column = pc.cast(column, pa.string())
        if self.kind == "elapsed":
            return np.array([_elapsed(c) for c in column.to_pylist()], dtype=np.float64)
        return _iso(column) if self.kind == "iso" else _formatted(column, self.format)


def clock_of(
    name: str, sample: Sequence[Any], where: str, unit: str = "", *, everywhere: bool = False
) -> TimeForm | None:
    """The clock of a column by its name and first cells (texts or numbers); None where they are no times.

    ``unit`` is what a row below the header says. Cells from ``everywhere`` in a column are no neighbours. RecordError
    for a date whose day and month cannot be told apart, and for numbers in an unknown unit; UnclearCountError for
    numbers that may be seconds or dates.
    """
    cells = [c for c in sample if c is not None and str(c).strip() != ""]
    if not cells:
        return None
    texts = [str(c).strip() for c in cells]
    header = time_header(name)
    numbers = all(isinstance(c, int | float) and not isinstance(c, bool) for c in cells)
    if numbers or all(EITHER_SIGN.match(t) for t in texts):
        values = np.array([float(t.replace(",", ".")) for t in texts])
        return _numeric(header, values, where, unit, everywhere=everywhere) if header.named else None
    if _most(texts, ISO):
        return TimeForm("iso")
    if form := form_of(texts, where):
        return TimeForm("format", format=form)
    if header.named and _most(texts, ELAPSED):
        return TimeForm("elapsed", says="hours, minutes and seconds without a date")
    return None


def given_clock(form: str) -> TimeForm:
    """The clock of a form that a person gave: as of strptime, or a unit of numbers (ms, s, min, h, d, serial)."""
    if form.lower() == SERIAL_UNIT:
        return TimeForm("number", DAY_S, SERIAL.at_1970 * DAY_S)
    if form.lower() in TIME_UNITS:
        return TimeForm("number", TIME_UNITS[form.lower()])
    if "%" not in form:
        raise RecordError(
            f"--time-format {form}: write a form as in '%d.%m.%Y %H:%M:%S', or a unit of numbers: {allowed_units()}"
        )
    return TimeForm("format", format=form)


def allowed_units() -> str:
    """The units of time that a header may have."""
    return ", ".join((*SPELLINGS, SERIAL_UNIT))


def zone_of(clock: TimeForm, sample: Sequence[Any]) -> str:
    """The zone that a clock's seconds count in, by the first cells: UTC, or UNSTATED; "" where they are no dates."""
    cells = [c for c in sample if c is not None and str(c).strip() != ""]
    if not cells or clock.kind == "elapsed":
        return ""
    if isinstance(cells[0], date):
        return IN_UTC if getattr(cells[0], "tzinfo", None) else UNSTATED
    if clock.kind == "number":
        first = _number(str(cells[0]).replace(",", ".")) * clock.scale - clock.start_s
        return "" if not first >= SINCE_1970_S else UNSTATED if clock.start_s in STARTS else IN_UTC
    if clock.kind == "iso":
        return IN_UTC if ZONE.search(str(cells[0]).strip()[10:]) else UNSTATED
    return IN_UTC if "%z" in clock.format else UNSTATED


def _most(texts: Sequence[str], pattern: re.Pattern[str]) -> bool:
    return 2 * sum(bool(pattern.match(t)) for t in texts) > len(texts)


def _numeric(header: TimeHeader, values: Array, where: str, unit: str, *, everywhere: bool) -> TimeForm:
    factor, unit = header.factor, "" if unit.strip().lower() in NO_UNITS else unit
    if factor is None and unit:
        factor = TIME_UNITS.get(unit.strip().lower().rstrip("."))
    unknown = header.unknown or (unit if unit and factor is None else "")
    if factor is None and unknown:
        raise RecordError(
            f"{where}: {unknown!r} is no unit of time that is known; write one of {allowed_units()} in the "
            "header, or give --time-format with one of them"
        )
    size = float(np.median(np.abs(values)))
    dated, counter = factor == DAY_S or header.date, header.rank >= 2
    try:
        days = days_of(values, dated=dated, counter=counter, everywhere=everywhere) if factor in {None, DAY_S} else None
    except UnclearCountError as number:
        raise UnclearCountError(
            f"{where}: numbers such as {number} may be seconds or dates of a spreadsheet; give --time-format s or "
            f"--time-format {SERIAL_UNIT}"
        ) from None
    if days is not None:
        return TimeForm("number", DAY_S, days.at_1970 * DAY_S, says=f"numbers are {days.words}")
    if factor is not None and factor != 1.0:
        return TimeForm("number", factor)
    if factor is None and (form := calendar_digits(values.tolist(), days=header.date)):
        return TimeForm("format", format=form)
    for low, high, start_s in TICK_COUNTS:
        if low < size < high:
            return TimeForm("number", 1e-7, start_s, says="numbers are ticks of 100 ns")
    # Seconds since 1970 have ten digits, milliseconds thirteen.
    scale = 1.0 if size < 1e11 else 1e-3 if size < 1e14 else 1e-6 if size < 1e17 else 1e-9
    assumed = factor is None and size < SINCE_1970_S
    says = "numbers are taken as seconds, no unit is written; --time-format names another, as in --time-format min"
    return TimeForm("number", scale, says=says if assumed else "", certain=not assumed)


def _formatted(column: Any, form: str) -> Array:
    import pandas as pd  # only files with such dates need it

    text = column.to_pandas().str.strip()
    utc = "%z" in form
    stamps = pd.to_datetime(text, format=form, errors="coerce", utc=utc)
    lost = stamps.isna() & text.notna() & (text != "")
    if lost.any():
        plain = text[lost].map(plain_date)
        for other in other_forms(form):
            again = pd.to_datetime(plain, format=other, errors="coerce", utc=utc)
            stamps = stamps.fillna(again)
            plain = plain[again.isna()]
            if plain.empty:
                break
    ends = text[stamps.isna()].dropna()
    ends = ends[ends.str.contains(MIDNIGHT)]
    if len(ends):  # 24:00 is the next day's 00:00
        days = pd.to_datetime(ends.str.replace(MIDNIGHT, "00", regex=True), format=form, errors="coerce", utc=utc)
        stamps = stamps.fillna(days + pd.Timedelta(days=1))
    stamps = stamps.dt.tz_localize(None) if utc else stamps
    return _of_timestamps(pa.array(stamps.dt.as_unit("us")))


def _iso(column: Any) -> Array:
    text = pc.utf8_trim_whitespace(column)
    first = next((t for t in text.slice(0, 50).to_pylist() if t), "")
    zone = "UTC" if ZONE.search(first[10:]) else None
    try:
        return _of_timestamps(pc.cast(text, pa.timestamp("us", zone)))
    except pa.ArrowInvalid:
        import pandas as pd  # slower, and it takes what Arrow does not: a decimal comma, a missing minute, nonsense

        words = text.to_pandas().str.replace(",", ".", regex=False)
        ends = words.str.contains(MIDNIGHT, na=False)  # 24:00 is the next day's 00:00
        words = words.where(~ends, words.str.replace(MIDNIGHT, "00", regex=True))
        stamps = pd.to_datetime(words, format="ISO8601", errors="coerce", utc=True)
        stamps += pd.to_timedelta(ends.astype(int), "D")
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


def _elapsed(cell: str | None) -> float:
    """Seconds of 26:03:10.5, or of 06:03:10 PM."""
    if not cell or not ELAPSED.match(cell.strip()):
        return float("nan")
    clock = cell.strip().lower().replace(",", ".")
    hours, minutes, seconds = clock.rstrip(" apm").split(":")
    hour = int(hours) % 12 + 12 * (clock[-2] == "p") if clock.endswith("m") else int(hours)
    return 3600.0 * hour + 60.0 * int(minutes) + float(seconds)
