"""A journal's file that is deleted, replaced or cut short while it is written: noticed, and made again."""

from __future__ import annotations

import os
import sqlite3
import stat
import zlib
from contextlib import closing, suppress
from enum import Enum
from pathlib import Path
from typing import TypeAlias

from loopwright.serving.journal.entries import EventEntry
from loopwright.serving.journal.file import held, is_damage

Identity: TypeAlias = tuple[int, int] | None  # device, inode; None: not there

BESIDE = ("", "-wal", "-shm")  # SQLite's files of one journal
COPY = (*BESIDE, "-journal")  # of a copy that is being made


class FileChange(Enum):
    """A change of a file that is open."""

    GONE = "was deleted"
    REPLACED = "was replaced by another file"
    CUT = "was cut short"
    DAMAGED = "was damaged"


class OpenFiles:
    """The files of an open journal, as they were last: SQLite itself writes on into a file that was deleted.

    Not ``steady``: the file system gives a file another number each time that it is asked, so that only its presence
    and its size say anything. ``mode`` are the file's own rights.
    """

    def __init__(self, path: Path, *, steady: bool = True) -> None:
        self.path, self.steady = path, steady
        self.mode: int | None = None
        self._size = 0
        self._known: dict[str, Identity] = {}
        self.harm()

    def harm(self, rows: int = 0) -> FileChange | None:
        """Their changes since; None without any. OSError where nobody can tell.

        ``rows`` is how many scans and events the journal holds.
        """
        for end in BESIDE:
            now, found = self._identity(end)
            before = self._known.setdefault(end, now) or now
            if now != before:
                return FileChange.GONE if now is None else FileChange.REPLACED
            self._known[end] = now
            if not end and found is not None:
                before_size, self._size, self.mode = self._size, found.st_size, stat.S_IMODE(found.st_mode)
                if self._size < before_size and not self._whole(rows):
                    return FileChange.CUT
        return None

    def own(self, end: str) -> bool:
        """Whether what lies at a file's place is the file that is open."""
        now, _ = self._identity(end)
        return now is not None and (not self.steady or now == self._known.get(end))

    def _identity(self, end: str) -> tuple[Identity, os.stat_result | None]:
        try:
            found = _beside(self.path, end).stat()
        except (FileNotFoundError, NotADirectoryError):
            return None, None
        return (found.st_dev, found.st_ino) if self.steady else (0, 0), found

    def _whole(self, rows: int) -> bool:
        """Whether a smaller file is one that somebody has vacuumed: it has all its rows still.

        A new connection reads what lies there; the one that writes would find lost pages in its memory.
        """
        try:
            with closing(sqlite3.connect(self.path.as_uri() + "?mode=ro", uri=True)) as base:
                return sound(base) and held(base) >= rows
        except sqlite3.Error:
            return False


def sound(base: sqlite3.Connection) -> bool:
    """Whether a journal's tables hang together and every block of scans can be unpacked.

    SQLite copies pages of zeros from a file that was cut, without an error.
    """
    try:
        if base.execute("pragma quick_check(1)").fetchone() != ("ok",):
            return False
        for (data,) in base.execute("select data from block"):
            zlib.decompress(data)
    except (sqlite3.DatabaseError, zlib.error) as error:
        if isinstance(error, zlib.error) or is_damage(error):
            return False
        raise
    return True


def copied(base: sqlite3.Connection, path: Path) -> Path | None:
    """A whole copy of all that an open journal holds, beside its place. Its rows keep their ids.

    None where the open journal cannot be read any more. Raises sqlite3.Error and OSError where the disk takes no copy
    now. In both cases no copy stays.
    """
    copy = path.with_name(path.name + ".new")
    _remove(copy)
    try:
        with closing(sqlite3.connect(copy)) as new:
            base.backup(new)
            whole = sound(new)
        if whole:
            handle = os.open(copy, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
            return copy
    except sqlite3.Error as error:
        if not is_damage(error):
            _remove(copy)
            raise
    except BaseException:
        _remove(copy)
        raise
    _remove(copy)
    return None


def _remove(copy: Path) -> None:
    for end in COPY:
        _beside(copy, end).unlink(missing_ok=True)


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


def made_again(harm: FileChange, lost: int, *, empty: bool, aside: Path | None, unsteady: bool) -> str:
    """The fate of a journal, in a sentence. ``unsteady``: the numbers of its files are believed no more."""
    loss = f"{lost} scans and events are lost"
    end = f"it is made again with the rows that are left; {loss}" if lost else "it is made again with all its rows"
    return (
        f"the journal's file {harm.value} while it was written: {f'a new one begins, and {loss}' if empty else end}"
        + (f"; the file that lay there is now {aside.name}" if aside else "")
        + ("; its file system numbers files anew, so that another file there is noticed no more" if unsteady else "")
    )


def alarm(time_s: float, what: str, over: str) -> list[EventEntry]:
    """An alarm of the journal itself that is over already, and that somebody has to see."""
    return [
        EventEntry(time_s, "fault", "journal", what, alarm="journal", raised=True),
        EventEntry(time_s, "fault", "journal", over, alarm="journal"),
    ]


def _beside(path: Path, end: str) -> Path:
    return path.with_name(path.name + end)


def _free(path: Path) -> Path:
    k = 1
    while (aside := path.with_name(f"{path.name}.aside-{k}")).exists():
        k += 1
    return aside
