"""A journal's SQLite file, and a file that one process locks and that tells the others which one has it."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path

from loopwright.serving.errors import LoopError

JOURNAL_SCHEMA = 2  # of the file: a reader refuses another
TABLES = """
create table if not exists run (id integer primary key, began real not null, controller text not null,
    sha256 text not null, period_s real not null, speed real not null, columns text not null,
    signals text not null);
create table if not exists scan (id integer primary key autoincrement, run integer not null, time real not null,
    mode text not null, numbers blob not null, quality text, reason text);
create table if not exists block (first integer primary key, last integer not null, run integer not null,
    begin real not null, end real not null, data blob not null);
create table if not exists event (id integer primary key autoincrement, time real not null, kind text not null,
    who text not null, what text not null, reason text not null, alarm text not null, raised integer not null,
    about integer not null);
create table if not exists learnt (name text primary key, value text not null);
create index if not exists event_time on event (time);
create index if not exists event_alarm on event (alarm, id);
create index if not exists event_about on event (about);
create index if not exists block_end on block (end);
"""


def opened(path: Path, *, write: bool, fsync: str = "crash") -> sqlite3.Connection:
    """A journal's database. LoopError where there is none to read, or the file is something else."""
    if not write and not path.is_file():
        raise LoopError(f"{path} is not here; it is the journal that a loop writes")
    try:
        address = path.absolute().as_uri() + ("" if write else "?mode=ro")
        base = sqlite3.connect(address, uri=True, timeout=10, check_same_thread=False)
        with closing(base.cursor()) as cursor:
            (version,) = cursor.execute("pragma user_version").fetchone()
            (tables,) = cursor.execute("select count(*) from sqlite_master").fetchone()
            if version != JOURNAL_SCHEMA and (tables or not write):
                raise LoopError(
                    f"{path} is no journal of this release (version {version}, not {JOURNAL_SCHEMA}); name another file"
                )
            if write:
                cursor.execute("pragma journal_mode=wal")
                cursor.execute(f"pragma synchronous={'full' if fsync == 'power loss' else 'normal'}")
                cursor.executescript(TABLES)
                cursor.execute(f"pragma user_version={JOURNAL_SCHEMA}")
    except sqlite3.Error as error:
        raise LoopError(f"{path} is no journal, or cannot be written: {error}") from None
    return base


def held(base: sqlite3.Connection) -> int:
    """How many scans and events a journal holds; 0 where nobody can tell any more."""
    counts = ("sum(last - first + 1) from block", "count(*) from scan", "count(*) from event")
    try:
        return sum(base.execute(f"select {count}").fetchone()[0] or 0 for count in counts)
    except sqlite3.Error:
        return 0


def is_damage(error: Exception) -> bool:
    """Whether SQLite says that the file is no longer a database that it can read."""
    code = getattr(error, "sqlite_errorcode", None)
    return code is not None and code & 0xFF in {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}


def sole_writer(path: Path) -> int:
    """A handle of the lock that the one writer of a journal keeps until it closes it, or its process ends.

    The lock is a file beside the journal: closing a second handle of SQLite's own file would drop SQLite's locks.
    LoopError where another writer has it.
    """
    lock = lock_of(path)
    try:
        return locked(lock)
    except LockTakenError as error:
        raise LoopError(
            f"{path} is written by another loop (process {error.owner}); end that one first, or name another file"
        ) from None
    except OSError as error:
        raise LoopError(f"{lock} cannot be opened or locked: {error.strerror}") from None


def holds(path: Path, handle: int) -> bool:
    """Whether the lock's file is still the one that is locked: one that was deleted keeps nobody out."""
    try:
        return os.path.samestat(os.stat(lock_of(path)), os.fstat(handle))
    except OSError:
        return False


def lock_of(path: Path) -> Path:
    """The file that the writer of a journal locks."""
    return path.resolve().with_name(path.resolve().name + ".lock")


LOCK_TRIES = 20  # as often a file may be taken away in the moment before it is locked


class LockTakenError(LoopError):
    """Another ``locked`` has the lock. ``owner`` is the number of its process, as far as the file tells."""

    def __init__(self, path: Path, owner: str) -> None:
        super().__init__(f"{path} is locked by process {owner}; end that one first")
        self.owner = owner


def locked(path: Path) -> int:
    """A handle of the lock of a file, which is made where it is not there: it lasts until the handle is closed.

    The end of the process closes it, too. Raises LockTakenError where somebody has it, also this process; OSError where
    the file cannot be opened or locked, which says nothing of another owner; LoopError on a system without such locks.
    """
    try:
        import fcntl
    except ModuleNotFoundError:
        raise LoopError("files are locked on Linux and macOS; on Windows run the loop in WSL") from None
    tries = LOCK_TRIES
    while True:
        tries -= 1
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(handle, 100).decode(errors="replace")
            os.close(handle)
            raise LockTakenError(path, owner) from None
        except OSError:
            os.close(handle)
            raise
        # Else its owner took the file away in the moment before, and it keeps nobody out; or the file system gives a
        # file another number each time, as some over a network do, and nobody can tell.
        if _is_at(path, handle) or not tries:
            os.truncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
            return handle
        os.close(handle)


def _is_at(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False
