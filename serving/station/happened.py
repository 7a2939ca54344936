"""The events of a journal, as lines for a person and as CSV for other tools."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from loopwright.serving.errors import LoopError
from loopwright.serving.journal import Event, JournalReader
from loopwright.serving.station.settings import Settings
from loopwright.serving.words import plain

FIELDS = ("time", "kind", "who", "what", "reason")


def journal_of(file: Path) -> Path:
    """The journal that ``file`` is, or that the loop.toml ``file`` names."""
    return Settings.read(file).journal.file if file.suffix == ".toml" else file


def happened(journal: Path, since: str = "", last: int | None = None) -> list[Event]:
    """The events of a journal, oldest first: all, or those from ``since`` on, and of these the ``last`` ones.

    ``since`` is in ISO 8601, and UTC where it names no zone. LoopError where it is no time, or ``last`` is below 1.
    """
    begin_s = _seconds(since) if since else -1e300
    if last is not None and last < 1:
        raise LoopError(f"--last is {last}; it must be 1 or more")
    with closing(JournalReader(journal)) as reader:
        events = [event for _, event in reader.events(begin_s=begin_s)]
    return events if last is None else events[-last:]


def lines(events: Sequence[Event]) -> list[str]:
    """A line an event: when, of which kind, who, what, and the reason in brackets."""
    rows = [_cells(event) for event in events]
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(3)]
    found = []
    for *head, what, reason in rows:
        start = "  ".join(cell.ljust(width) for cell, width in zip(head, widths, strict=True))
        found.append(f"{start}  {what}" + f" ({reason})" * bool(reason))
    return found


def write_csv(events: Sequence[Event], out: TextIO) -> None:
    """A row an event, below the names of the columns."""
    table = csv.writer(out, lineterminator="\n")
    table.writerow(FIELDS)
    table.writerows(_cells(event) for event in events)


def _cells(event: Event) -> list[str]:
    # An acknowledgement is written down with the text of its alarm.
    what = f"acknowledged: {event.what}" if event.kind == "acknowledged" else event.what
    moment = datetime.fromtimestamp(event.time_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return [moment, event.kind, *(plain(" ".join(text.split())) for text in (event.who, what, event.reason))]


def _seconds(since: str) -> float:
    try:
        moment = datetime.fromisoformat(since)
    except ValueError:
        raise LoopError(f"--since is {since!r}; write a date or a time, as 2026-03-01 or 2026-03-01T14:30") from None
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()
