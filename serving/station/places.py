"""Where the loops of one user on one machine find each other."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

from loopwright.serving.errors import LoopError


def runtime_folder(folder: Path | None = None) -> Path:
    """A folder that only this user may enter, made where it is not there yet.

    Raises LoopError where somebody else made it first, or opened it to others, and on a system that tells no users
    apart and has no Unix sockets.
    """
    if not hasattr(os, "getuid"):
        raise LoopError("`loopwright loop` runs on Linux and macOS; on Windows run it in WSL, or embed ControlLoop")
    place = folder or Path(tempfile.gettempdir()) / f"loopwright-{os.getuid()}"
    place.mkdir(mode=0o700, exist_ok=True)
    found = place.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise LoopError(f"{place} must be a folder of this user that nobody else may enter; remove it")
    return place
