"""Which column of a file is time, which are values, and which qualities: a column a tag, or a row a reading."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import RecordError, nearest
from pipeline.historian.times import NAMES, Clock, clock_of
from pipeline.records.record_file import split_column

TAG_NAMES = {"tag", "tagname", "tag name", "name", "point", "signal", "variable", "item", "pointname", "messstelle"}
VALUE_NAMES = {"value", "val", "wert", "reading", "measurement", "tagvalue"}
QUALITY = re.compile(r"^(?P<tag>.*?)[ ._:/-]*\(?(quality|status|qual|stat|opcquality)\)?$", re.IGNORECASE)
DATE_NAMES, HOUR_NAMES = ("date", "datum", "day"), ("time", "zeit", "uhrzeit", "hour", "time of day")
HOUR = re.compile(r"^\d{1,2}:\d\d(:\d\d([.,]\d+)?)?( ?[AaPp][Mm])?$")
LONG_COLUMNS = 8  # more make a wide file


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of one file: ``wide`` has a column a tag, ``long`` the columns tag, time, value and quality."""

    kind: str
    time: str
    clock: Clock
    values: tuple[str, ...]
    quality: Mapping[str, str]  # value column -> its quality's column
    tag: str = ""
    date: str = ""  # the column of the day, where ``time`` holds the hour alone


def layout_of(
    path: Path, header: Sequence[str], sample: Mapping[str, Sequence[Any]], time_column: str = "", time_format: str = ""
) -> Layout:
    """The layout by the header and the first rows; RecordError where no column is time."""
    date, time = ("", "") if time_column else _day_and_hour(header, sample)
    if date:
        both = [f"{a} {b}" for a, b in zip(sample[date], sample[time], strict=False)]
        named, clock = "time", Clock("format", format=time_format) if time_format else None
        clock = clock or clock_of(named, both[:200], f"{path}: columns {date!r} and {time!r}")
        if clock is None:
            raise RecordError(
                f"{path}: {both[0]!r} of the columns {date!r} and {time!r} is no time that can be read; give its form "
                "with --time-format, for example '%d.%m.%Y %H:%M:%S'"
            )
    else:
        time, clock = _time(path, header, sample, time_column, time_format)
    others = [h for h in header if h not in {time, date}]
    lower = {h.strip().lower(): h for h in others}
    tag = next((lower[n] for n in lower if n in TAG_NAMES), "")
    value = next((lower[n] for n in lower if n in VALUE_NAMES), "")
    if tag and value and len(header) <= LONG_COLUMNS:
        quality = next((h for h in others if QUALITY.match(h) and h not in {tag, value}), "")
        return Layout("long", time, clock, (value,), {value: quality} if quality else {}, tag, date)
    qualities = {}
    for h in others:
        match = QUALITY.match(h)
        if match and match["tag"] and match["tag"] in others:
            qualities[match["tag"]] = h
    flags = set(qualities.values())
    values = tuple(h for h in others if h not in flags)
    if not values:
        raise RecordError(f"{path}: there is no column beside the time {time!r}; export the tags too")
    return Layout("wide", time, clock, values, qualities, date=date)


def _day_and_hour(header: Sequence[str], sample: Mapping[str, Sequence[Any]]) -> tuple[str, str]:
    """The columns of the day and of the hour, where time is written in two; "" twice where it is not."""
    lower = {h.strip().lower(): h for h in header}
    date = next((lower[n] for n in DATE_NAMES if n in lower), "")
    time = next((lower[n] for n in HOUR_NAMES if n in lower), "")
    if not (date and time and date != time):
        return "", ""
    days, hours = ([str(c).strip() for c in sample.get(h, ()) if str(c).strip()] for h in (date, time))
    split = bool(days and hours) and all(HOUR.match(h) for h in hours) and not any(":" in d for d in days)
    return (date, time) if split else ("", "")


def _time(
    path: Path, header: Sequence[str], sample: Mapping[str, Sequence[Any]], named: str, time_format: str
) -> tuple[str, Clock]:
    if named:
        if named not in header:
            raise RecordError(f"{path}: no column {named!r} for --time{nearest(named, header)}")
        order = [named]
    else:
        order = sorted(header, key=lambda h: split_column(h)[0].strip().lower() not in NAMES)
    for column in order:
        if time_format and (named or split_column(column)[0].strip().lower() in NAMES or len(order) == 1):
            return column, Clock("format", format=time_format)
        name = "time" if named and split_column(column)[0].lower() not in NAMES else column
        clock = clock_of(name, sample.get(column, ())[:200], f"{path}: column {column!r}")
        if clock is not None:
            return column, clock
    shown = next((str(sample[c][0]) for c in order if sample.get(c)), "nothing")
    raise RecordError(
        f"{path}: no column holds times that can be read ({order[0]!r} begins with {shown!r}); name the column with "
        "--time, its form with --time-format, for example '%d.%m.%Y %H:%M:%S'"
    )
