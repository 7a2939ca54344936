"""Files as values: a piece of work gets those that it reads in a folder of its own, and gives back what changed.

Paths are relative and stay inside the folder. So whoever does the work needs none of the client's file systems, and
only the client writes: what a piece left half-written is never seen.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath

from pipeline.files import write_bytes

Files = Mapping[str, bytes]
Changes = Mapping[str, bytes | None]  # None: removed


def read_files(paths: Iterable[Path]) -> dict[str, bytes]:
    """Name -> content of some files, and of those in some folders; what is not there or lies outside is left out."""
    found = dict[str, bytes]()
    for path in paths:
        if _outside(path):
            continue
        inside = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        found.update({p.as_posix(): p.read_bytes() for p in inside})
    return found


@contextlib.contextmanager
def within_folder(files: Files) -> Iterator[None]:
    """A new folder with ``files`` in it as the working folder; it is gone afterwards."""
    before = os.getcwd()
    folder = tempfile.mkdtemp(prefix="loopwright-")
    try:
        os.chdir(folder)
        for name, content in files.items():
            path = Path(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        yield
    finally:
        # Of a worker that holds several stages, the folder of before may be another's, and gone.
        os.chdir(before if os.path.isdir(before) else tempfile.gettempdir())
        shutil.rmtree(folder, ignore_errors=True)


def changes_since(files: Files) -> dict[str, bytes | None]:
    """What of the working folder differs from ``files``, which it began with."""
    now = {p.as_posix(): p.read_bytes() for p in sorted(Path().rglob("*")) if p.is_file()}
    return {**dict.fromkeys(sorted(files.keys() - now.keys())), **{n: c for n, c in now.items() if files.get(n) != c}}


def apply(changes: Changes) -> None:
    """Make the changes here, each file whole or not at all. ValueError for a name that leads out of the folder."""
    for name, content in changes.items():
        path = Path(name)
        if _outside(path):
            raise ValueError(f"{name} leads out of the folder")
        if content is None:
            path.unlink(missing_ok=True)
        else:
            write_bytes(path, content)


def _outside(path: Path) -> bool:
    return path.is_absolute() or ".." in PurePosixPath(path.as_posix()).parts
