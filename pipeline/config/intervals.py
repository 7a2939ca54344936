"""Times to leave out of a record, as params.yaml and the command line write them: ``FROM..TO``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import date, datetime, timedelta

DAY = re.compile(r"^\d{4}-\d\d-\d\d$")
FORM = "write FROM..TO in ISO dates or times, as in 2024-03-04T06:00..2024-03-04T18:00, or in seconds, as in 3600..7200"


@dataclass(frozen=True, slots=True)
class Interval:
    """From ``first`` to before ``end``: both dates with a time, or both seconds."""

    text: str
    first: datetime | float
    end: datetime | float

    @classmethod
    def of(cls, text: str) -> Interval:
        """The interval of ``FROM..TO``; a TO that is a day ends with it. ValueError for another form."""
        ends = text.split("..")
        if len(ends) != 2:
            raise ValueError(f"{text!r} is no interval; {FORM}")
        first, end = (_moment(part.strip(), text, last=last) for part, last in zip(ends, (False, True), strict=True))
        if isinstance(first, datetime) is not isinstance(end, datetime):
            raise ValueError(f"{text!r} has a date at one end and seconds at the other; {FORM}")
        if isinstance(first, datetime) and isinstance(end, datetime) and (first.tzinfo is None) != (end.tzinfo is None):
            raise ValueError(f"{text!r} has a time zone at one end only; give it at both or at none")
        if not first < end:  # type: ignore[operator]
            raise ValueError(f"{text!r} ends before it begins; {FORM}")
        return cls(text, first, end)


def _moment(part: str, text: str, *, last: bool) -> datetime | float:
    if DAY.match(part):
        try:
            day = date.fromisoformat(part) + timedelta(days=last)
        except ValueError:
            raise ValueError(f"{part!r} in {text!r} is no day of the calendar; {FORM}") from None
        return datetime(day.year, day.month, day.day)
    for read in (float, datetime.fromisoformat):
        try:
            moment = read(part)
        except ValueError:
            continue
        if isinstance(moment, datetime) or math.isfinite(moment):
            return moment
    raise ValueError(f"{part!r} in {text!r} is neither a date nor seconds; {FORM}")
