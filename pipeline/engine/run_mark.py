"""The mark of `loopwright run` in a folder: a lock that lasts as long as the run, whatever ends it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ModuleNotFoundError:  # on Windows, where nothing tells of a run
    fcntl = None  # type: ignore[assignment]

# DVC's own scratch folder: git and DVC pass it over. A file in work/ would be one that no other clone has.
MARK_FILE = Path(".dvc") / "tmp" / "loopwright-run"


@contextlib.contextmanager
def run_marked() -> Iterator[None]:
    """A run is under way here, for others to see; several may be, of which DVC lets one at a time write."""
    if fcntl is None:
        yield
        return
    MARK_FILE.parent.mkdir(parents=True, exist_ok=True)
    mark = os.open(MARK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(mark, fcntl.LOCK_SH)
        yield
    finally:
        os.close(mark)


def runs_here() -> bool:
    """Whether a `loopwright run` is at work in this folder; a `dvc repro` by hand is not seen."""
    if fcntl is None:
        return False
    try:
        mark = os.open(MARK_FILE, os.O_RDWR)
    except OSError:
        return False  # none ever was, or it is another person's
    try:
        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(mark)
    return False
