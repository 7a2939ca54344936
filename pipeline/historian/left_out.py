"""Times that a person leaves out of a record: a stop, a test of another kind, a sensor under repair."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.config.intervals import Interval
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.export import Export, Series
from loopwright.pipeline.historian.findings import Finding, counted
from loopwright.pipeline.historian.grid import Grid
from loopwright.pipeline.historian.reason import Reason
from loopwright.pipeline.historian.times import SINCE_1970_S, UNSTATED

Span = tuple[float, float]  # [s] as the export counts, from the first to before the second


def spans_of(texts: Iterable[str], export: Export) -> list[Span]:
    """The intervals [s] as the export counts. RecordError for another form, or for dates where the export has none.

    A date without a zone counts as the export writes its own: in the zone that a person named for them, if any.
    Seconds count from the first reading of an export with dates, unless they count from 1970 themselves; else as the
    export's do.
    """
    first_s = min((float(s.time_s[0]) for s in export.series.values() if len(s)), default=0.0)
    found = []
    for text in texts:
        try:
            interval = Interval.of(text)
        except ValueError as error:
            raise RecordError(f"leave_out: {error}") from None
        found.append((_seconds(interval.first, text, export, first_s), _seconds(interval.end, text, export, first_s)))
    return found


def _seconds(moment: datetime | float, text: str, export: Export, first_s: float) -> float:
    if not isinstance(moment, datetime):
        return moment + first_s if export.zone and moment < SINCE_1970_S else moment
    if not export.zone:
        raise RecordError(f"leave_out: {text!r} has dates, and the times of the export are none; give its seconds")
    if moment.tzinfo is not None and export.zone == UNSTATED:
        raise RecordError(f"leave_out: {text!r} has a time zone, and the export states none; give its own times")
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=export.local or UTC)).timestamp()


def interval_text(first_s: float, end_s: float, export: Export) -> str:
    """An interval [s] as `--leave-out` takes it: dates as the export writes them, to the second, or seconds."""
    if not export.zone:
        return f"{first_s:.10g}..{end_s:.10g}"
    first, end = (datetime.fromtimestamp(t, export.local or UTC) for t in (np.floor(first_s), np.ceil(end_s)))
    return f"{first:%Y-%m-%dT%H:%M:%S}..{end:%Y-%m-%dT%H:%M:%S}"


def flag_readings(series: Iterable[Series], spans: Sequence[Span], reason: Reason) -> None:
    """Give the good readings within the spans their reason."""
    for one in series:
        for span in spans:
            one.flag(_inside(one.time_s, span), reason)


def flag_rows(grid: Grid, tags: Iterable[str], spans: Sequence[Span], reason: Reason) -> list[int]:
    """Give the rows within the spans their reason, and no value; how many each span has."""
    rows = [_inside(grid.time_s, span) for span in spans]
    for tag in tags:
        for inside in rows:
            grid.value[tag][inside] = np.nan
            grid.code[tag][inside] = reason
    return [int(inside.sum()) for inside in rows]


def of_left_out(texts: Sequence[str], rows: Sequence[int]) -> list[Finding]:
    """How many rows each interval left out; one that met none may be mistyped."""
    return [
        Finding(
            "left_out",
            text,
            f"{counted(n, 'row')} left out" if n else "met no row: compare it with the record's times",
            n > 0,
        )
        for text, n in zip(texts, rows, strict=True)
    ]


def _inside(time_s: NDArray[np.float64], span: Span) -> NDArray[np.bool_]:
    return np.asarray((time_s >= span[0]) & (time_s < span[1]))
