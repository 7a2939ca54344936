"""``exports.<plant>`` of params.yaml: the files that a record is made of, and the times to leave out of it."""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

from loopwright.pipeline.config.params import PARAMS_FILE, parse, read_section, sections
from loopwright.pipeline.errors import ParamsError

DAY = re.compile(r"^\d{4}-\d\d-\d\d$")
FORM = "write FROM..TO in ISO dates or times, as in 2024-03-04T06:00..2024-03-04T18:00, or in seconds, as in 3600..7200"


@dataclass(frozen=True, slots=True)
class TimeSpan:
    """From ``first`` to before ``end``: both dates with a time, or both seconds."""

    text: str
    first: datetime | float
    end: datetime | float

    @classmethod
    def of(cls, text: str) -> TimeSpan:
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


SECTION = "exports"
SCREENED = "screened"  # the name of the record


@dataclasses.dataclass(frozen=True, slots=True)
class ExportedTag:
    """A column of the files and its role; unit, range and name where a person gave them.

    Else the unit is the files', the range is what the readings show, and the name is the tag's own, made safe.
    ``unit_certain``: no reading is in another unit, so that none is left out for looking like it. ``between``: a line
    or a step from one reading to the next. ``ends``: rows at the lowest or highest value are kept or dropped.
    ``loop``: tags with the same word belong together, ``-`` is none ("": by the tag's name).
    """

    tag: str
    role: Literal["pv", "constraint", "analyser", "constraint-analyser", "mv", "dv", "sp", "mode"]
    unit: str = ""
    low: float | None = None
    high: float | None = None
    name: str = ""
    unit_certain: bool = False
    between: Literal["", "step", "line"] = ""
    ends: Literal["", "keep", "drop"] = ""
    loop: str = ""


@dataclasses.dataclass(frozen=True, slots=True)
class ExportParams:
    """``exports.<plant>``: the export files of a plant, and how they are read.

    ``period_s``, ``hold_s``: sampling period of the record and the longest time that a reading is held (None: from the
    data). ``without_mode``: rows of these modes are left out. ``leave_out``: times FROM..TO that are. ``time``,
    ``time_format``: the column of times and its form ("": found by name and content). ``time_zone``: that of dates
    which state none. ``anyway``: the record is used even where it cannot carry a model.
    """

    case: str
    files: tuple[Path, ...]
    tags: tuple[ExportedTag, ...]
    period_s: float | None = None
    hold_s: float | None = None
    without_mode: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    time: str = ""
    time_format: str = ""
    time_zone: str = ""
    anyway: bool = False

    def __post_init__(self) -> None:
        if not self.files:
            raise ValueError("files is empty; name one or more exports")
        for text in self.leave_out:
            TimeSpan.of(text)
        for name in ("period_s", "hold_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name} is {value:g}; it must be a positive number of seconds")

    @classmethod
    def read(cls, plant: str, path: Path = PARAMS_FILE) -> ExportParams:
        """The section of one plant; ParamsError where it is not there, wrong, or another plant's."""
        params = parse(cls, read_section(SECTION, plant, path), f"{SECTION}.{plant}")
        if params.case != plant:
            raise ParamsError(f"{SECTION}.{plant} has `case: {params.case}`; write `case: {plant}`")
        return params

    def to_dict(self) -> dict[str, Any]:
        """The section; what was not given is left out."""
        files = [file.as_posix() for file in self.files]
        tags = [_given(ExportedTag, tag) for tag in self.tags]
        given = {k: list(v) if isinstance(v, tuple) else v for k, v in _given(ExportParams, self).items()}
        return {**given, "files": files, "tags": tags}


def screened_record(plant: str) -> Path:
    """The record that stage `screen` makes of a plant's exports."""
    return Path("work") / plant / "records" / SCREENED / "record.parquet"


def is_exported(plant: str, path: Path = PARAMS_FILE) -> bool:
    """Whether the record of a plant is made of export files by stage `screen`."""
    return plant in sections(SECTION, path)


def _given(cls: type, values: Any) -> dict[str, Any]:
    """Field -> value, without those that have their default."""
    return {f.name: v for f in dataclasses.fields(cls) if (v := getattr(values, f.name)) != f.default}
