"""Courses as somebody gives them: a CSV file with a column of times and one a signal, or a request with points."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from loopwright.serving.errors import LoopError
from loopwright.serving.fields import shown
from loopwright.serving.preview.course import Points

TIME_COLUMNS = ("time", "time_s")
LARGEST_FILE = 20_000_000  # bytes: far above the points that a course may have


class AskedCourse(NamedTuple):
    """Courses that a request gives: points by signal, the signals that run straight, and those whose course ends."""

    points: Mapping[str, Points]
    straight: tuple[str, ...] = ()
    ended: tuple[str, ...] = ()
    filed: bool = False  # whether they stood in a file


def asked_course(value: Any, now_s: float, speed: float = 1.0) -> AskedCourse:
    """The courses of a request's value: points, the text of a file, or names of courses to end.

    Times and ``speed`` are as of ``courses_of``. LoopError for anything else, and with the ``entry`` csv for a file.
    """
    if isinstance(value, Mapping) and set(value) == {"end"} and _are_names(value["end"]):
        return AskedCourse({}, ended=tuple(value["end"]))
    if not isinstance(value, Mapping) or not _is_course(value):
        raise LoopError(
            'a course needs {"points": {NAME: [[time_s, value], ..]}, "straight": [NAME, ..]}, {"csv": the text of a '
            'file, "straight": [NAME, ..]}, or {"end": [..]}'
        )
    straight = tuple(value.get("straight", ()))
    if "csv" not in value:
        return AskedCourse(value.get("points", {}), straight)
    try:
        return AskedCourse(courses_of(value["csv"], now_s, "the file", speed), straight, filed=True)
    except LoopError as error:
        error.entry = "csv"
        raise


def _is_course(value: Mapping[Any, Any]) -> bool:
    """Whether a request has points or the text of a file, and names that run straight."""
    if set(value) - {"straight"} not in ({"points"}, {"csv"}, set()):
        return False
    return _are_names(value.get("straight", [])) and isinstance(value.get("csv", ""), str)


def _are_names(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def read_courses(path: Path, now_s: float, speed: float = 1.0) -> dict[str, list[tuple[float, float]]]:
    """Points (time [s] from now, value) of each signal of a file, see ``courses_of``.

    LoopError for a file that cannot be read, and with the line for a cell that is wrong.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise LoopError(f"{path} has {path.stat().st_size} bytes; a course may have {LARGEST_FILE}")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LoopError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise LoopError(f"{path} is no CSV file: {error}") from error
    return courses_of(text, now_s, str(path), speed)


def courses_of(text: str, now_s: float, path: str, speed: float = 1.0) -> dict[str, list[tuple[float, float]]]:
    """Points (time [s] from now, value) of each signal in the text of a file; ``path`` is its name in errors.

    The first line names the columns: ``time``, then signals. A time is a number of seconds from now, or a date and time
    as 2026-03-01T14:30, in UTC unless it says otherwise; ``now_s`` is the present one in seconds since 1970. A loop
    that runs ``speed`` times as fast as the clock is there in so much more of its own time. An empty cell is no point
    of its signal.

    LoopError with the line for what is wrong.
    """
    try:
        rows = list(csv.reader(text.removeprefix("\ufeff").splitlines()))
    except csv.Error as error:
        raise LoopError(f"{path} is no CSV file: {error}") from error
    names = [name.strip() for name in rows[0]] if rows else []
    if len(names) < 2 or names[0] not in TIME_COLUMNS:
        raise LoopError(
            f"{path}: the first line is {shown(','.join(names))}; it needs time and names of signals, as time,TIC-1"
        )
    if "" in names or len(set(names)) < len(names):
        raise LoopError(f"{path}: the first line has a name twice, or an empty one: {', '.join(names)}")
    points: dict[str, list[tuple[float, float]]] = {name: [] for name in names[1:]}
    for number, row in enumerate(rows[1:], start=2):
        cells = [cell.strip() for cell in row]
        if not any(cells):
            continue
        where = f"{path}, line {number}"
        if len(cells) != len(names):
            raise LoopError(f"{where} has {len(cells)} cells; the first line has {len(names)}")
        time_s = _time(cells[0], now_s, where, speed)
        for name, cell in zip(names[1:], cells[1:], strict=True):
            if cell:
                points[name].append((time_s, _number(cell, f"{where}: {name}")))
    empty = [name for name, of in points.items() if not of]
    if empty:
        raise LoopError(f"{path} has no value of {', '.join(empty)}; leave the column out, or fill it")
    return points


def _time(cell: str, now_s: float, where: str, speed: float) -> float:
    """Seconds from now of a cell that is a number of seconds, or a date and time."""
    try:
        seconds = float(cell)
        if isfinite(seconds):
            return seconds
    except ValueError:
        pass
    try:
        stamp = datetime.fromisoformat(cell)
    except ValueError:
        raise LoopError(
            f"{where}: the time is {shown(cell)}; it needs seconds from now, or as 2026-03-01T14:30"
        ) from None
    return ((stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp() - now_s) * speed


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise LoopError(f"{where} is {shown(cell)}; it needs a number, or an empty cell for no point") from None
    if not isfinite(value):
        raise LoopError(f"{where} is {shown(cell)}; it must be finite")
    return value
