"""Columns of a file: time, values and qualities, a column a tag, or a row a reading."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.files.export import Note
from loopwright.pipeline.historian.files.headers import split_header, tags_of
from loopwright.pipeline.historian.files.quality import QUALITY, is_quality, is_sure, names_a_state
from loopwright.pipeline.historian.files.table_head import UNIT_WORDS, kind_of_cell
from loopwright.pipeline.historian.files.time_column import TimeColumn, seconds_of, time_column_of
from loopwright.pipeline.metrics import Array

TAG_NAMES = {
    "tag", "tagname", "tagid", "name", "point", "pointname", "pointid", "signal", "signalname", "variable", "varname",
    "variablename", "item", "itemid", "itemname", "nodeid", "node", "sensor", "sensorid", "sensorname", "channel",
    "channelname", "parameter", "parametername", "metric", "field", "measurand", "series", "id", "key", "object",
    "messstelle", "messstellenname", "kanal", "bezeichnung", "datenpunkt", "größe", "groesse", "kennung", "messgröße",
    "étiquette", "repère", "nom", "etiqueta", "punto", "nombre", "señal", "measurement", "desc", "description",
    "beschreibung", "kks", "tagpath", "path", "messpunkt", "webid", "identifier", "attributename", "historiantag",
}  # fmt: skip
VALUE_NAMES = {
    "value", "val", "wert", "messwert", "reading", "measurement", "tagvalue", "data", "result", "valeur", "valor",
    "valore", "avg", "average", "mean", "numericvalue", "floatvalue", "doublevalue", "realvalue", "zahlenwert",
    "istwert", "v", "vvalue", "pointvalue", "numeric", "analogvalue", "varvalue",
    "attrvalue", "attributevalue", "eventvalue",
}  # fmt: skip
LONG_COLUMNS = 8  # more make a wide file


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of one file: ``wide`` has a column a tag, ``long`` the columns tag, time, value and quality."""

    kind: str
    time: TimeColumn
    values: tuple[str, ...]
    quality: Mapping[str, tuple[str, ...]]  # value column -> the columns of its quality
    tags: Mapping[str, str]  # value column -> tag
    tag: str = ""
    unit: str = ""  # the column of a reading's unit, of a long file
    notes: tuple[Note, ...] = ()  # what was assumed


def layout_of(
    path: Path,
    header: Sequence[str],
    sample: Mapping[str, Sequence[Any]],
    time_column: str = "",
    time_format: str = "",
    units: Mapping[str, str] | None = None,
    spread: Callable[[str], Sequence[Any]] | None = None,
    counted: Callable[[str], Mapping[str, int]] | None = None,
) -> Layout:
    """The layout by the header and the first rows; RecordError where no column is time.

    ``units`` stand below the header. Where the first cells do not do, ``spread`` gives cells from all over a column,
    and ``counted`` each text of a column and how often it stands there.
    """
    more = spread or (lambda column: sample.get(column, ()))
    whole = counted or (lambda column: Counter(_texts(sample.get(column, ()))))
    time = time_column_of(path, header, sample, time_column, time_format, units or {}, more)
    notes = [Note(time.name, words) for words in (time.left, time.clock.says) if words]
    others = [h for h in header if h not in time.columns]
    tag, value = _tag_and_value(others, sample, time, more)
    if tag and value:
        found = tuple(
            h for h in others if h not in {tag, value} and _is_quality(h, sample, beside=not names_a_state(h))
        )
        qualities = {value: found} if found else {}
        unit = next((h for h in others if h.strip().lower() in UNIT_WORDS and _kind(sample.get(h, ())) == "text"), "")
        return Layout("long", time, (value,), qualities, tags_of(header), tag, unit, tuple(notes))
    qualities = {}
    of_all = list[str]()
    for h in others:
        match = QUALITY.match(h)
        if match is None:
            continue
        own = [o for o in others if o != h and match["tag"] and split_header(o)[0] in _tags_before(match["tag"])]
        if own and _is_quality(h, sample):
            qualities[own[0]] = (*qualities.get(own[0], ()), h)
        elif not match["tag"] and is_quality(h, whole(h), beside=False):
            of_all.append(h)
        elif own or is_sure(h):
            of_whom = own[0] if own else "all tags"
            notes.append(Note(h, f"has the name of a quality of {of_whom}, and other cells: it is read as a tag"))
    flags = {*of_all, *(h for columns in qualities.values() for h in columns)}
    values = tuple(h for h in others if h not in flags)
    if of_all:
        qualities = {v: (*qualities.get(v, ()), *of_all) for v in values}
        notes += [Note(h, "is the quality of every tag in its row") for h in of_all]
    if not values:
        raise RecordError(f"{path}: there is no column beside the time {time.name!r}; export the tags too")
    return Layout("wide", time, values, qualities, tags_of(header), notes=tuple(notes))


def clocks_apart(layout: Layout, header: Sequence[str]) -> tuple[Layout, ...]:
    """A layout a clock, where each tag of a wide file has its own column of dates before or behind it; else the one."""
    clocks = dict(((layout.time.name, layout.time.clock), *layout.time.others))
    flags = {flag for columns in layout.quality.values() for flag in columns}
    order = [h for h in header if h not in flags]
    kinds = [h in clocks for h in order]
    if (
        layout.kind != "wide"
        or len(clocks) < 2
        or kinds not in ([True, False] * len(clocks), [False, True] * len(clocks))
    ):
        return (layout,)
    first = 0 if kinds[0] else 1
    times, values = order[first::2], order[1 - first :: 2]
    own = "; ".join(f"{v} by {t}" for t, v in zip(times, values, strict=True))
    notes = (
        *(n for n in layout.notes if n.words != layout.time.left),
        Note(layout.time.name, f"each tag has times: {own}"),
    )
    return tuple(
        replace(layout, time=TimeColumn(t, clocks[t]), values=(v,), notes=notes)
        for t, v in zip(times, values, strict=True)
    )


def _tags_before(text: str) -> set[str]:
    """The tags that may stand in front of a word of quality."""
    return {text.strip(), text.strip().rstrip(" ._:/-")}


def _is_quality(column: str, sample: Mapping[str, Sequence[Any]], *, beside: bool = True) -> bool:
    """Whether a column beside a tag, or in a row that is one reading, holds qualities, by its first cells."""
    return is_quality(column, Counter(_texts(sample.get(column, ()))), beside=beside)


def _tag_and_value(
    others: Sequence[str],
    sample: Mapping[str, Sequence[Any]],
    time: TimeColumn,
    spread: Callable[[str], Sequence[Any]],
) -> tuple[str, str]:
    """The columns of the tag and of the value where a row is a reading; "" twice where it is not.

    By their names; or by content: a column of words beside one of numbers, where each time has several words, or where
    the times begin anew with another word.
    """
    if len(others) + len(time.columns) > LONG_COLUMNS:
        return "", ""
    kinds = {h: _kind(sample.get(h, ())) for h in others}
    flags = {h for h in others if _is_quality(h, sample)}
    numbers = [h for h in others if kinds[h] in {"number", "empty"} and h not in flags]
    words = [h for h in others if kinds[h] == "text" and h not in flags]
    tags = [h for h in others if _plain(h) in TAG_NAMES and h not in flags]
    values = [h for h in others if _plain(h) in VALUE_NAMES]
    tag = next((h for h in tags if h in words), next((h for h in tags if _numbered(sample[h], numbers)), ""))
    value = next((h for h in values if h in numbers and h != tag), next((h for h in values if h != tag), ""))
    if tag and value:
        return tag, value
    if tag in words and len([n for n in numbers if n != tag]) == 1:
        value = next(n for n in numbers if n != tag)
        if len(set(_texts(sample[tag]))) > 1 or len(set(_texts(spread(tag)))) > 1:
            return tag, value
    numbers = [n for n in numbers if not _counts(sample.get(n, ()))] or numbers
    if len(numbers) == 1:
        stamps = [_texts(sample.get(c, ())) for c in time.columns]
        rows = list(zip(*stamps, strict=False))
        for h in words:
            cells = _texts(sample[h])
            together = set(zip(rows, cells, strict=False))
            if 1 < len(set(cells)) <= len(cells) // 2 and len(together) > 1.5 * len(set(rows)):
                return h, numbers[0]
        for h in words:
            if not time.before and _begins_anew(_texts(spread(h)), seconds_of(time.clock, spread(time.name))):
                return h, numbers[0]
    return "", ""


def _counts(cells: Sequence[Any]) -> bool:
    """Whether a column of numbers stands, or counts the rows, so that it is no value of several tags."""
    try:
        steps = np.diff([float(t.replace(",", ".")) for t in _texts(cells) if t])
    except ValueError:
        return False
    return bool(len(steps)) and bool(np.all(steps >= 0))


def _begins_anew(words: Sequence[str], seconds: Array) -> bool:
    """Whether the times go back where another word begins, and nowhere else: a file sorted by tag."""
    turns = np.array(words[1:]) != np.array(words[:-1])
    steps = np.diff(seconds)
    back = steps < 0 if 2 * np.count_nonzero(steps > 0) > len(steps) else steps > 0
    times = np.count_nonzero(back)
    return bool(times and not np.any(back & ~turns) and 2 * times >= np.count_nonzero(turns))


def _numbered(cells: Sequence[Any], numbers: Sequence[str]) -> bool:
    """Whether the numbers of a column are tags: they come again, and beside them stands one column of values."""
    texts = _texts(cells)
    return 1 < len(set(texts)) <= len(texts) // 2 and len(numbers) == 2


def _plain(column: str) -> str:
    """The header in small letters, without its unit, blanks and signs."""
    return re.sub(r"[\W_]+", "", split_header(column)[0].lower())


def _texts(cells: Sequence[Any]) -> list[str]:
    return ["" if c is None else str(c).strip() for c in cells]


def _kind(cells: Sequence[Any]) -> str:
    """The kind of most cells of a column: "number", "time", "text", or "empty"."""
    kinds = [kind_of_cell(t) for t in _texts(cells) if t]
    return max(set(kinds), key=kinds.count) if kinds else "empty"
