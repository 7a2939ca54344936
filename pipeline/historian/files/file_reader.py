"""Files of an export -> series, in blocks, so that a file much larger than its series can be read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC as UTC_ZONE
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from loopwright.pipeline.errors import RecordError, nearest
from loopwright.pipeline.files import sha256
from loopwright.pipeline.historian.files.date_forms import DAY_S
from loopwright.pipeline.historian.files.export import Contents, Export, Note, Series, joined
from loopwright.pipeline.historian.files.gathering import Gathered, flag_repeated_rows
from loopwright.pipeline.historian.files.headers import tag_named, tags_of
from loopwright.pipeline.historian.files.layout import Layout, clocks_apart
from loopwright.pipeline.historian.files.open_file import EncodingError, Opened, opened
from loopwright.pipeline.historian.files.time_stamps import IN_UTC, UNSTATED, LocalClock, zone_named, zone_of


def read_export(
    paths: Sequence[Path],
    tags: Sequence[str] = (),
    modes: Sequence[str] = (),
    time_column: str = "",
    time_format: str = "",
    time_zone: str = "",
) -> Export:
    """The series of ``tags`` and ``modes`` (texts allowed) of all files; of every column where none is named.

    A tag may be named by its header, with the unit; its series has the name that was given. ``time_zone`` is that of
    dates that state none. Raises RecordError for a file that cannot be read, a tag that none
    of them has, time that cannot be read.
    """
    if not paths:
        raise RecordError("no file is named; give one or more exports")
    times = StatedTimes(time_column, time_format, time_zone, zone_named(time_zone) if time_zone else None)
    sources = [opened(path) for path in paths]
    columns = {column: tag for source in sources for column, tag in tags_of(source.header).items()}
    given: dict[str, list[str]] = {}  # a series keeps the name that a person gave
    for text in (*tags, *modes):
        given.setdefault(tag_named(text, columns), []).append(text)
    if twice := [texts for texts in given.values() if len({*texts}) > 1]:
        raise RecordError(f"{' and '.join(map(repr, dict.fromkeys(twice[0])))} name one column; give it one role")
    tags, modes = [tag_named(t, columns) for t in tags], [tag_named(t, columns) for t in modes]
    read = [_of_file(source, times, {*tags, *modes}, set(modes)) for source in sources]
    together: dict[str, list[Series]] = {}
    for one in read:
        for name, series in one.series.items():
            together.setdefault(name, []).append(series)
    named, known = ", ".join(map(str, paths)), set[str]().union(*(one.known for one in read))
    absent = [f"no tag {tag!r}{nearest(tag, known)}" for tag in (*tags, *modes) if tag not in together]
    if absent:
        raise RecordError(f"{named}: {'; '.join(absent)}")
    totals = sum((one.counts for one in read), Counter[str]())
    if not totals["rows_read"]:
        raise RecordError(f"{named}: no row of data; export a longer time")
    zones = {zone for one in read for zone in one.zones}
    rows, unreadable, timeless = totals["rows_read"] + totals["rows"], totals["rows"], totals["timeless"]
    notes = [note for one in read for note in one.notes]
    if unreadable or timeless:
        words = f"{unreadable} have another number of cells than the header, {timeless} no time that can be read"
        notes.append(Note(f"{rows} rows of the export", f"{words}: they are left out"))
    if time_zone and not any(one.local for one in read):
        raise RecordError(f"--time-zone {time_zone}: no file has dates without a zone of their own; leave it out")
    return Export(
        {own: replace(joined(p), tag=own) for name, p in together.items() for own in given.get(name, (name,))},
        tuple((str(path), sha256(path)) for path in paths),
        " and ".join(dict.fromkeys(one.kind for one in read)),
        rows,
        unreadable,
        timeless,
        zones.pop() if len(zones) == 1 else "",  # of files that count differently no date is known
        tuple(one.contents for one in read),
        tuple(dict.fromkeys(notes)),
        times.zone,
    )


@dataclass(frozen=True, slots=True)
class StatedTimes:
    """A person's statements on the times: their column, their form, their zone; "" and None without one."""

    column: str
    form: str
    zone_name: str
    zone: tzinfo | None


@dataclass(slots=True)
class FileRead:
    """Content of one file."""

    kind: str  # of its layout
    contents: Contents
    series: dict[str, Series]
    counts: Counter[str]
    notes: list[Note]
    zones: list[str]
    known: set[str]  # its tags
    local: bool  # some of its times were converted from the zone that a person named


def _of_file(source: Opened, times: StatedTimes, wanted: set[str], modes: set[str]) -> FileRead:
    try:
        return _of_opened(source, times, wanted, modes)
    except EncodingError as error:
        return _of_opened(opened(source.path, error.encoding), times, wanted, modes)


def _of_opened(source: Opened, times: StatedTimes, wanted: set[str], modes: set[str]) -> FileRead:
    layout = source.layout(times.column, times.form)
    apart = clocks_apart(layout, source.header)
    found, counts, notes, zones, local = dict[str, Series](), Counter[str](), [*source.notes], list[str](), False
    for own in apart:
        zone = zone_of(own.time.clock, source.sample[own.time.columns[0]])
        clock = LocalClock(times.zone_name, times.zone) if times.zone is not None and zone == UNSTATED else None
        series, of_rows, more = _read(source, own, wanted, modes, clock)
        found |= series
        counts = of_rows if len(apart) == 1 else Counter({"rows_read": of_rows["rows_read"]})
        notes += [*own.notes, *more]
        zones.append(IN_UTC if clock else zone)
        local |= clock is not None
    flag_repeated_rows(found)
    pa.default_memory_pool().release_unused()
    known = set(found) if layout.kind == "long" else {own.tags[v] for own in apart for v in own.values}
    contents = _contents(source.path, found, counts["rows_read"])
    return FileRead(layout.kind, contents, found, counts + source.unreadable, notes, zones, known, local)


def _contents(path: Path, found: Mapping[str, Series], rows: int) -> Contents:
    times = [s.time_s for s in found.values() if len(s)]
    first, last = (
        min((float(t.min()) for t in times), default=np.nan),
        max((float(t.max()) for t in times), default=np.nan),
    )
    return Contents(str(path), frozenset(found), rows, first, last)


def units_of(paths: Sequence[Path]) -> dict[str, str]:
    """Tag -> the unit that a row below the header, brackets in the header, or a column beside a reading name."""
    found: dict[str, str] = {}
    for path in paths:
        source = opened(path)
        tags = tags_of(source.header)
        found |= {tags[k]: v for k, v in source.units.items() if v}
        try:
            layout = source.layout()
        except RecordError:  # the times need a person's word, the units of headers none
            continue
        if layout.unit:
            pairs = source.pairs(layout.tag, layout.unit)
            times = Counter(tag for tag, _ in pairs)
            found |= {tag: unit for tag, unit in pairs if unit and times[tag] == 1}
    return found


def tags_in(paths: Sequence[Path]) -> set[str]:
    """Tags that the headers of files name, and of rows that are a reading those of the first ones."""
    found = set[str]()
    for source in map(opened, paths):
        found |= {*tags_of(source.header).values(), *source.header}
        try:
            layout = source.layout()
        except RecordError:  # the same file is refused when it is read
            continue
        found |= {str(c).strip() for c in source.sample.get(layout.tag, ())}
    return found


# ---------------------------------------------------------------------- one file
def _read(
    source: Opened, layout: Layout, wanted: set[str], modes: set[str], local: LocalClock | None
) -> tuple[dict[str, Series], Counter[str], list[Note]]:
    decimal, of_sign = source.decimal()
    gather = Gathered(modes, decimal, wide=layout.kind == "wide")
    counts: Counter[str] = Counter()
    values = {
        v: layout.tags[v] for v in layout.values if not wanted or layout.tags[v] in wanted or layout.kind == "long"
    }
    qualities = {v: layout.quality[v] for v in values if v in layout.quality}
    time, midnights = layout.time, Midnights()
    flags = (flag for columns in qualities.values() for flag in columns)
    names = [n for n in dict.fromkeys((*time.columns, layout.tag, *values, *flags)) if n]
    try:
        for block in source.blocks(names):
            counts["rows_read"] += block.num_rows
            seconds = time.clock.seconds(_stamps(block, layout))
            if time.clock.kind == "elapsed" and layout.kind == "wide":
                seconds = midnights.passed(seconds)
            seconds = local.utc(seconds) if local else seconds
            timed = np.isfinite(seconds)
            if not timed.all():
                counts["timeless"] += int(np.count_nonzero(~timed))
                block, seconds = block.filter(pa.array(timed)), seconds[timed]
            if layout.kind == "wide":
                for v, name in values.items():
                    gather.add(name, seconds, block.column(v), {q: block.column(q) for q in qualities.get(v, ())})
            else:
                _long_block(gather, layout, block, seconds, wanted)
    except (pa.ArrowException, UnicodeError) as error:  # a cell of another kind than the first ones
        raise RecordError(
            f"{source.path} cannot be read: {str(error).splitlines()[0]}; export the file again"
        ) from None
    if counts["rows_read"] and counts["timeless"] == counts["rows_read"]:
        raise RecordError(
            f"{source.path}: no time of column {time.name!r} can be read; name the column with --time, its form with "
            "--time-format"
        )
    series = gather.series()
    notes = of_sign + [Note(column, words) for column, words in gather.says.items() if words]
    return series, counts, notes + (_of_zone(source.path, local) if local else [])


def _of_zone(path: Path, local: LocalClock) -> list[Note]:
    """Notes on how local times were converted; RecordError where some do not exist in their zone."""
    if local.missing:
        stamp = datetime.fromtimestamp(local.missing[0], UTC_ZONE).strftime("%Y-%m-%d %H:%M:%S")
        raise RecordError(
            f"{path}: {len(local.missing)} times such as {stamp} do not exist in the zone {local.name}, whose clocks "
            "skip them; where the export keeps winter time all year give its offset, as in --time-zone +01:00"
        )
    twice = f"; {local.told} readings of an hour that came twice by their order" if local.told else ""
    return [Note(local.name, f"is the zone of the export's times, kept as UTC{twice}")]


@dataclass(slots=True)
class Midnights:
    """Hours of the day without a date, block by block: each fall by more than half a day is a midnight."""

    last_s: float = np.nan
    days: int = 0

    def passed(self, seconds: Any) -> Any:
        """Seconds (n,) since the first midnight."""
        known = np.flatnonzero(np.isfinite(seconds))
        if not known.size:
            return seconds
        own = seconds[known]
        falls = np.diff(np.r_[own[0] if np.isnan(self.last_s) else self.last_s, own]) < -DAY_S / 2
        days = self.days + np.cumsum(falls)
        self.last_s, self.days = float(own[-1]), int(days[-1])
        out = seconds.copy()
        out[known] = own + DAY_S * days
        return out


def _stamps(block: Any, layout: Layout) -> Any:
    """The column of times, put together where its parts stand apart."""
    if not layout.time.before:
        return block.column(layout.time.name)
    parts = [pc.utf8_trim_whitespace(pc.cast(block.column(c), pa.string())) for c in layout.time.columns]
    if "%H%M%S" in layout.time.clock.format:
        parts[1] = pc.utf8_lpad(parts[1], len("060054"), "0")
    return pc.binary_join_element_wise(*parts, " ")


def _long_block(gather: Gathered, layout: Layout, block: Any, seconds: Any, wanted: set[str]) -> None:
    """Share a block of (tag, time, value, quality) out among the tags."""
    tags = block.column(layout.tag)
    tags = tags if pa.types.is_dictionary(tags.type) else tags.cast(pa.string()).dictionary_encode()
    tags = tags.combine_chunks() if isinstance(tags, pa.ChunkedArray) else tags
    index = np.asarray(tags.indices.fill_null(-1).to_numpy(zero_copy_only=False))
    (value,) = layout.values
    flags = layout.quality.get(value, ())
    for i, name in enumerate(tags.dictionary.to_pylist()):
        name = str(name).strip()
        rows = np.flatnonzero(index == i)
        if rows.size and (not wanted or name in wanted):
            part = block.take(pa.array(rows))
            gather.add(name, seconds[rows], part.column(value), {flag: part.column(flag) for flag in flags})
