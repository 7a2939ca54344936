"""The time column of an export: dates before numbers, a column that rises before one that does not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.historian.files.date_forms import DAY_S, HOUR, HOUR_DIGITS, UnclearCountError
from loopwright.pipeline.historian.files.headers import split_header, time_header
from loopwright.pipeline.historian.files.table_head import kind_of_cell
from loopwright.pipeline.historian.files.time_stamps import SINCE_1970_S, TimeForm, clock_of, given_clock
from loopwright.pipeline.metrics import Array

TIME_CELLS = 200  # cells of a column
RISING_STEPS = 0.9  # share of the steps that go one way


@dataclass(frozen=True, slots=True)
class TimeColumn:
    """The column of times and how it writes them; ``before`` it stand those of the day, or of year to minute."""

    name: str
    clock: TimeForm
    before: tuple[str, ...] = ()
    left: str = ""  # for a person: which others could have been it
    others: tuple[tuple[str, TimeForm], ...] = ()  # further columns of dates that rise

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that make the time."""
        return (*self.before, self.name)


@dataclass(frozen=True, slots=True)
class TimeCandidate:
    """A column that may be time, by its name and first cells."""

    column: str
    clock: TimeForm
    rank: int  # of its name, as in TimeHeader
    rises: bool  # or falls
    stands: bool  # one value in all rows
    first_s: float

    @property
    def order(self) -> tuple[bool, int, bool, int]:
        """The least one is the time: dates, then numbers since 1970, then others; what rises; the better name."""
        since_start = 2 if self.clock.certain and self.clock.kind != "elapsed" else 3
        kind = 0 if self.clock.dates else 1 if self.first_s >= SINCE_1970_S else since_start
        return self.stands, kind, not self.rises, self.rank


def time_column_of(
    path: Path,
    header: Sequence[str],
    sample: Mapping[str, Sequence[Any]],
    named: str,
    time_format: str,
    units: Mapping[str, str],
    spread: Callable[[str], Sequence[Any]],
) -> TimeColumn:
    """The column of times; ``named`` and ``time_format`` are what a person said of it, "" for nothing.

    ``spread`` gives cells from all over a column, where the first ones do not tell day and month apart.
    RecordError where there is none, where it cannot be read, or where its unit is not known.
    """
    if named:
        return _named(path, header, sample, named, time_format, units, spread)
    if time_format:
        clock = given_clock(time_format)
        if pair := _day_and_hour(header, sample):
            return TimeColumn(pair[1], clock, pair[:1])
        return TimeColumn(_fitting(path, header, sample, clock), clock)
    found, refused = list[TimeCandidate](), list[tuple[int, RecordError]]()
    for column in header:
        try:
            candidate = _candidate(path, column, sample.get(column, ())[:TIME_CELLS], units.get(column, ""), spread)
        except RecordError as error:
            refused.append((time_header(column).rank, error))
            continue
        if candidate is not None:
            found.append(candidate)
    best = min(found, key=lambda c: c.order, default=None)
    if (best is None or not best.clock.dates) and (parts := _year_to_second(header, sample)):
        return TimeColumn(parts[-1], TimeForm("format", format=" ".join(FORMS[: len(parts)])), parts[:-1])
    pair = _day_and_hour(header, sample)
    if pair and (best is None or best.column in pair or not best.clock.dates):
        return _paired(path, sample, *pair, spread)
    if refused and (best is None or not best.clock.certain):
        raise min(refused, key=lambda r: r[0])[1]
    if best is None:
        first = min(header, key=lambda h: time_header(h).rank)
        shown = next((str(c) for c in sample.get(first, ()) if str(c).strip()), "nothing")
        raise RecordError(
            f"{path}: no column holds times that can be read ({first!r} begins with {shown!r}); name the column with "
            "--time, its form with --time-format, for example '%d.%m.%Y %H:%M:%S'"
        )
    others = [c for c in found if c is not best and not c.stands and (c.rank < 3 or (c.clock.dates and c.rises))]
    names = ", ".join(c.column for c in others)
    left = f"is the time; {names} could be too, --time names another" if others else ""
    dates = tuple((c.column, c.clock) for c in others if best.clock.dates and c.clock.dates and c.rises)
    return TimeColumn(best.column, best.clock, left=left, others=dates)


def _candidate(
    path: Path, column: str, cells: Sequence[Any], unit: str, spread: Callable[[str], Sequence[Any]]
) -> TimeCandidate | None:
    """The column as one of times; None where it holds none, or its name is vague and it does not rise."""
    header = time_header(column)
    where = f"{path}: column {column!r}"
    try:
        clock = clock_of(column, cells, where, unit)
    except RecordError as error:
        dates = any(kind_of_cell(str(c).strip()) == "time" for c in cells)
        if header.rank >= 2 and not dates and not isinstance(error, UnclearCountError):  # a temperature T (°C)
            return None
        clock = _clock_by_all(column, cells, where, unit, lambda: spread(column))
    if clock is None:
        return None
    seconds = seconds_of(clock, cells)
    rises, stands = _way(seconds)
    if stands and clock.dates and header.named and np.any(seconds % DAY_S):  # to the minute, and many rows in each
        rises, stands = _way(seconds_of(clock, spread(column)))
    if not clock.dates and header.rank >= 2 and (not rises or stands):
        return None
    first_s = float(seconds[np.isfinite(seconds)][0]) if np.isfinite(seconds).any() else 0.0
    return TimeCandidate(column, clock, header.rank, rises, stands, first_s)


def _way(seconds: Array) -> tuple[bool, bool]:
    """Whether times (n,) rise or fall, and whether they stand."""
    steps = np.diff(seconds[np.isfinite(seconds)])
    way = max(np.count_nonzero(steps > 0), np.count_nonzero(steps < 0))
    rises = bool(way >= RISING_STEPS * np.count_nonzero(steps)) if len(steps) else True
    return rises, bool(len(steps)) and not steps.any()


def seconds_of(clock: TimeForm, cells: Sequence[Any]) -> Array:
    """Seconds (n,) of cells (n,) by a clock; NaN where one cannot be read."""
    try:
        return clock.seconds(pa.array(list(cells)))
    except (pa.ArrowException, ValueError, TypeError):
        return clock.seconds(pa.array([None if c is None else str(c) for c in cells], pa.string()))


def _named(
    path: Path,
    header: Sequence[str],
    sample: Mapping[str, Sequence[Any]],
    named: str,
    time_format: str,
    units: Mapping[str, str],
    spread: Callable[[str], Sequence[Any]],
) -> TimeColumn:
    column = next((h for h in header if named in {h, split_header(h)[0]}), "")
    if not column:
        raise RecordError(f"{path}: no column {named!r} for --time{nearest(named, header)}")
    pair = _day_and_hour(header, sample)
    pair = pair if pair and column in pair else None
    if time_format:
        given = given_clock(time_format)
        return TimeColumn(pair[1], given, pair[:1]) if pair and given.dates else TimeColumn(column, given)
    if pair:
        return _paired(path, sample, *pair, spread)
    where, cells = f"{path}: column {column!r}", sample.get(column, ())[:TIME_CELLS]
    unit = split_header(column)[1] or units.get(column, "")
    name = column if time_header(column).named else f"time [{unit}]" if unit else "time"
    clock = _clock_by_all(name, cells, where, unit, lambda: spread(column))
    if clock is None:
        shown = next((str(c) for c in cells if str(c).strip()), "nothing")
        raise RecordError(
            f"{where} begins with {shown!r}, which is no time that can be read; give its form with --time-format, for "
            "example '%d.%m.%Y %H:%M:%S'"
        )
    return TimeColumn(column, clock)


def _fitting(path: Path, header: Sequence[str], sample: Mapping[str, Sequence[Any]], clock: TimeForm) -> str:
    """The column that a given form reads: most cells, and the best name."""
    found = []
    for column in header:
        cells = [c for c in sample.get(column, ())[:TIME_CELLS] if c is not None and str(c).strip()]
        rank = time_header(column).rank
        if cells and (clock.dates or rank < 3 or len(header) == 1):
            found.append((rank, -float(np.mean(np.isfinite(seconds_of(clock, cells)))), column))
    fits = [f for f in found if f[1] < -0.5]
    if fits:
        return min(fits)[2]
    named = [f for f in found if f[0] < 3]
    if named:  # the whole column is tried, and refused with its first cells
        return min(named)[2]
    raise RecordError(f"{path}: no column has times of the form that --time-format gives; name one with --time")


YEAR_TO_SECOND = (
    {"year", "yyyy", "jahr", "année", "annee", "año"}, {"month", "monat", "mois", "mes"},
    {"day", "tag", "jour", "día", "dia"}, {"hour", "hours", "stunde", "heure", "hora"},
    {"minute", "minutes", "min", "minuto"},
    {"second", "seconds", "sec", "sekunde", "seconde", "segundo"},
)  # fmt: skip
FORMS = ("%Y", "%m", "%d", "%H", "%M", "%S")


def _year_to_second(header: Sequence[str], sample: Mapping[str, Sequence[Any]]) -> tuple[str, ...]:
    """The columns of year, month, day, hour, minute and, where there is one, second; () where one is missing."""
    found = list[str]()
    for words in YEAR_TO_SECOND:
        column = next((h for h in header if split_header(h)[0].strip().lower() in words), "")
        if not column:
            break
        found.append(column)
    if len(found) < len(FORMS) - 1:
        return ()
    years = [str(c).strip() for c in sample.get(found[0], ()) if c is not None and str(c).strip()]
    return tuple(found) if years and all(len(y.removesuffix(".0")) == 4 for y in years) else ()


def _day_and_hour(header: Sequence[str], sample: Mapping[str, Sequence[Any]]) -> tuple[str, str] | None:
    """The columns of the day and of the hour, where time is written in two."""
    texts = {h: [str(c).strip() for c in sample.get(h, ()) if c is not None and str(c).strip()] for h in header}
    hours = [h for h, own in texts.items() if own and all(HOUR.match(c) for c in own)]
    hours += [h for h, own in texts.items() if own and _may_be_hours(h) and all(HOUR_DIGITS.match(c) for c in own)]
    if not hours:
        return None
    for day, own in texts.items():
        if own and day not in hours and not any(":" in c for c in own):
            clock = _quiet(day, own)
            if clock is not None and clock.dates:
                return day, hours[0]
    return None


def _may_be_hours(column: str) -> bool:
    header = time_header(column)
    return header.named and header.factor is None


def _quiet(column: str, cells: Sequence[str]) -> TimeForm | None:
    """The clock of a column of days; one whose day and month cannot be told apart is a column of days too."""
    try:
        return clock_of(column, cells[:TIME_CELLS], column)
    except RecordError:
        return TimeForm("iso")


def _clock_by_all(
    name: str, cells: Sequence[Any], where: str, unit: str, more: Callable[[], Sequence[Any]]
) -> TimeForm | None:
    """The clock by the first cells, or by more of them where these cannot be told to be one thing or another."""
    try:
        return clock_of(name, cells, where, unit)
    except RecordError as error:
        try:
            return clock_of(name, more(), where, unit, everywhere=True)
        except RecordError:
            raise error from None


def _paired(
    path: Path,
    sample: Mapping[str, Sequence[Any]],
    date: str,
    time: str,
    spread: Callable[[str], Sequence[Any]],
) -> TimeColumn:
    digits = all(HOUR_DIGITS.match(str(c).strip()) for c in sample[time])
    hours = [str(c).strip().zfill(len("060054") if digits else 0) for c in sample[time]]
    both = [f"{a} {b}" for a, b in zip(sample[date], hours, strict=False)]

    def more() -> list[str]:
        return [f"{day} {hours[0]}" for day in spread(date)]

    clock = _clock_by_all("time", both[:TIME_CELLS], f"{path}: columns {date!r} and {time!r}", "", more)
    if clock is None:
        raise RecordError(
            f"{path}: {both[0]!r} of the columns {date!r} and {time!r} is no time that can be read; give its form "
            "with --time-format, for example '%d.%m.%Y %H:%M:%S'"
        )
    return TimeColumn(time, clock, (date,))
