"""Files of work that is done elsewhere: those that a stage of dvc.yaml reads and writes, and a folder of its own.

``deps`` and ``outs`` are DVC's. Under ``meta`` a stage that runs on the cluster lists what it reads beside them
(``reads``: nothing that decides a result), or replaces without owning it (``replaces``). A piece of work gets the files
that it reads in a folder of its own, and gives back what changed: whoever does the work needs none of the client's file
systems, and only the client writes: what a piece left half-written is never seen.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Self

import yaml

from loopwright.pipeline.files import write_bytes

DVC_FILE, PARAMS_FILE = Path("dvc.yaml"), Path("params.yaml")
DATA = Path("work/code/data.json")  # case -> files of own plants that dvc.yaml cannot list
EVERY = "*"  # in place of a case: what the stages of all need
_FIELD = re.compile(r"\$\{([\w.]+)\}")


@dataclass(frozen=True)
class StageFiles:
    """Files that a stage finds in its folder, and those that are new afterwards."""

    reads: tuple[Path, ...]
    writes: tuple[Path, ...]


def on_cluster(kind: str, name: str) -> StageFiles | None:
    """The files of a stage that runs on the cluster; None for one that runs where it was started."""
    if not DVC_FILE.is_file() or not PARAMS_FILE.is_file():
        return None
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    stage = yaml.load(DVC_FILE.read_text(encoding="utf-8"), Loader=loader)["stages"].get(kind)
    if stage is None or "meta" not in stage.get("do", stage):
        return None
    params = yaml.load(PARAMS_FILE.read_text(encoding="utf-8"), Loader=loader) or {}
    items = params.get(_FIELD.fullmatch(stage["foreach"])[1]) if "foreach" in stage else {}  # type: ignore[index]
    if not isinstance(items, dict) or name not in items:
        return None  # the stage says so
    values = {"key": name, "item": items[name]}
    entry = stage.get("do", stage)

    def paths(listed: Any) -> list[Path]:
        names = [next(iter(entry)) if isinstance(entry, dict) else entry for entry in listed or ()]
        return [Path(_FIELD.sub(lambda found: str(_value(values, found[1])), n)) for n in names]

    outs, replaced = paths(entry.get("outs")), paths(entry["meta"].get("replaces"))
    reads = [PARAMS_FILE, *paths(entry.get("deps")), *paths(entry["meta"].get("reads")), *replaced]
    reads += _data(str(items[name].get("case", "")))
    return StageFiles(tuple(reads), tuple(outs))


def _value(values: Mapping[str, Any], name: str) -> Any:
    found: Any = values
    for part in name.split("."):
        found = found[part]
    return found


def _data(case: str) -> list[Path]:
    try:
        found = json.loads(DATA.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return [Path(name) for of in (EVERY, case) for name in found.get(of, ())]


# ------------------------------------------------------- files as values: paths are relative and stay inside the folder
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


class NewFolder:
    """A new folder with ``files`` in it; as a context, the working folder.

    It is made in ``parent`` (None: where temporary files go), and removed with ``remove`` or with this object.
    """

    def __init__(self, files: Files, parent: str | None = None) -> None:
        self._made = tempfile.TemporaryDirectory(prefix="loopwright-", dir=parent, ignore_cleanup_errors=True)
        self.path, self._before = Path(self._made.name), list[str]()
        for name, content in files.items():
            path = self.path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            os.utime(path, (0, 0))  # whatever is written again has another time, however soon it is
        self._files = self._stamps()

    def __enter__(self) -> Self:
        self._before.append(os.getcwd())
        os.chdir(self.path)
        return self

    def __exit__(self, *_: object) -> None:
        # Of a worker that holds several stages, the folder of before may be another's, and gone.
        before = self._before.pop()
        os.chdir(before if os.path.isdir(before) else tempfile.gettempdir())

    def changes(self) -> dict[str, bytes | None]:
        """Name -> new content of the files that were written since, None for those that were removed."""
        now = self._stamps()
        gone = dict.fromkeys(sorted(self._files.keys() - now.keys()))
        return {**gone, **{n: (self.path / n).read_bytes() for n, of in now.items() if self._files.get(n) != of}}

    def remove(self) -> None:
        """Remove the folder and what is in it."""
        self._made.cleanup()

    def _stamps(self) -> dict[str, tuple[int, int, int]]:
        found = ((p, p.stat()) for p in sorted(self.path.rglob("*")) if p.is_file())
        return {p.relative_to(self.path).as_posix(): (s.st_size, s.st_mtime_ns, s.st_ino) for p, s in found}


def apply(changes: Changes, anew: Iterable[Path] = ()) -> None:
    """Make the changes here, each file whole or not at all; the folders ``anew`` are emptied before.

    Raises ValueError for a name that leads out of the folder; then nothing was changed.
    """
    for name in changes:
        if _outside(Path(name)):
            raise ValueError(f"{name} leads out of the folder")
    for folder in anew:
        if folder.is_dir():
            shutil.rmtree(folder)
    for name, content in changes.items():
        if content is None:
            Path(name).unlink(missing_ok=True)
        else:
            write_bytes(Path(name), content)


def _outside(path: Path) -> bool:
    return path.is_absolute() or ".." in PurePosixPath(path.as_posix()).parts
