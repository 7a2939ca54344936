"""A journal's file that is deleted, replaced or cut short while it is written: noticed, and made again."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing, suppress
from enum import Enum
from pathlib import Path
from typing import TypeAlias

from serving.journal.entries import Event

Identity: TypeAlias = tuple[int, int] | None  # device, inode; None: not there

BESIDE = ("", "-wal", "-shm")  # SQLite's files of one journal


class Harm(Enum):
    """A change of a file that is open."""

    GONE = "was deleted"
    REPLACED = "was replaced by another file"
    CUT = "was cut short"
    DAMAGED = "was damaged"


class OpenFiles:
    """The files of an open journal, as they were last: SQLite itself writes on into a file that was deleted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = 0
        self._known: dict[str, Identity] = {}
        self.harm()

    def harm(self) -> Harm | None:
        """What happened to them since; None: nothing did. OSError where nobody can tell."""
        for end in BESIDE:
            now, size = _identity(_beside(self.path, end))
            before = self._known.setdefault(end, now) or now
            if now != before:
                return Harm.GONE if now is None else Harm.REPLACED
            self._known[end] = now
            if not end:
                if size < self._size:  # SQLite shrinks no file in WAL mode
                    return Harm.CUT
                self._size = size
        return None

    def own(self, end: str) -> bool:
        """Whether what lies at a file's place is the file that is open."""
        now, _ = _identity(_beside(self.path, end))
        return now is not None and now == self._known.get(end)


def copied(base: sqlite3.Connection, path: Path) -> Path:
    """A whole copy of all that an open journal holds, beside its place. Its rows keep their ids.

    Raises sqlite3.Error and OSError where the copy cannot be made; then there is none.
    """
    copy = path.with_name(path.name + ".new")
    copy.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(copy)) as new:
            base.backup(new)
        handle = os.open(copy, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except BaseException:
        copy.unlink(missing_ok=True)
        raise
    return copy


def cleared(files: OpenFiles, *, keep: bool) -> Path | None:
    """Clear the place of a journal. A foreign file, and with ``keep`` its own one, is kept beside it by this name."""
    foreign = {end for end in BESIDE if _beside(files.path, end).exists() and not files.own(end)}
    aside = _free(files.path) if "" in foreign or (keep and files.own("")) else None
    for end in BESIDE:
        here = _beside(files.path, end)
        if aside is not None and (not end or end in foreign):
            with suppress(FileNotFoundError):
                here.rename(_beside(aside, end))
        else:
            here.unlink(missing_ok=True)
    return aside


def alarm(time_s: float, what: str, over: str) -> list[Event]:
    """An alarm of the journal itself that is over already, and that somebody has to see."""
    return [
        Event(time_s, "fault", "journal", what, alarm="journal", raised=True),
        Event(time_s, "fault", "journal", over, alarm="journal"),
    ]


def _beside(path: Path, end: str) -> Path:
    return path.with_name(path.name + end)


def _identity(path: Path) -> tuple[Identity, int]:
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None, 0
    return (found.st_dev, found.st_ino), found.st_size


def _free(path: Path) -> Path:
    k = 1
    while (aside := path.with_name(f"{path.name}.aside-{k}")).exists():
        k += 1
    return aside
