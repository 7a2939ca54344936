"""A file that one process locks, and that tells the others which one has it."""

from __future__ import annotations

import os
from pathlib import Path

from loopwright.serving.errors import LoopError

TRIES = 20  # as often a file may be taken away in the moment before it is locked


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
    tries = TRIES
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
