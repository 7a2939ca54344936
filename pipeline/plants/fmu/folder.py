"""The folder into which an FMU is unpacked: it goes with the process that needs it, however that one ends."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import final

from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.fmu.description import Description, fmpy

try:
    import fcntl
except ImportError:  # Windows: what a killed process leaves stays there
    fcntl = None  # type: ignore[assignment]

PREFIX, LOCK = "loopwright-fmu-", "in-use.lock"


@final
class Folder:
    """An FMU unpacked: its libraries for this machine and its resources.

    An FMU without resources needs its folder no more once it is loaded (``loaded``). Else the folder goes with this
    object. A worker process may be ended without a word, so a lock, which ends with its process and the forks of it,
    marks each folder that is in use; the next one to unpack an FMU removes those that nobody holds.
    """

    def __init__(self, of: Description) -> None:
        _sweep()
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        self._finalizer = weakref.finalize(self, _remove, self.path, _locked(self.path), os.getpid())
        platforms = {fmpy().platform, fmpy().platform_tuple}

        def needed(name: str) -> bool:
            parts = name.split("/")
            return parts[0] not in {"documentation", "sources"} and (
                parts[0] != "binaries" or len(parts) < 2 or parts[1] in platforms
            )

        try:
            fmpy().extract(str(of.path), str(self.path), needed)
        except Exception as error:
            self._finalizer()
            raise PlantError(f"{of.path} cannot be unpacked: {' '.join(str(error).split())}") from None

    def loaded(self) -> None:
        """Remove the folder, if the FMU has no files to read later."""
        resources = self.path / "resources"
        if not (resources.is_dir() and any(resources.iterdir())):
            self._finalizer()


def _remove(path: Path, lock: int | None, owner: int) -> None:
    if os.getpid() == owner:  # and not a fork of it
        shutil.rmtree(path, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _locked(folder: Path) -> int | None:
    """A file of the folder, locked until this process and its forks have ended; None where there are no such locks."""
    if fcntl is None:
        return None
    draft = folder / f"{LOCK}.new"
    file = os.open(draft, os.O_CREAT | os.O_RDWR, 0o600)
    fcntl.flock(file, fcntl.LOCK_EX)
    draft.rename(folder / LOCK)  # locked from the moment that it has this name
    return file


def _sweep() -> None:
    """Remove the folders whose process has ended."""
    if fcntl is None:
        return
    for lock in Path(tempfile.gettempdir()).glob(f"{PREFIX}*/{LOCK}"):
        with _free(lock) as free:
            if free:
                shutil.rmtree(lock.parent, ignore_errors=True)


@contextlib.contextmanager
def _free(lock: Path) -> Iterator[bool]:
    try:
        file = os.open(lock, os.O_RDWR)
    except OSError:
        yield False  # another one was faster, or it is another person's
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    except OSError:
        yield False
    finally:
        os.close(file)
