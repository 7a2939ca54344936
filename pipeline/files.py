"""Files: written whole or not at all, JSON in and out, and their digests.

This is the only place that renames drafts: what was there before stays until the new content is complete.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from loopwright.pipeline.errors import HostError, PipelineError


@contextlib.contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """A file beside ``path``, of the same suffix, to write into.

    It takes the place of ``path`` unless an exception was raised; whatever happens, none is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    draft = Path(name)
    try:
        yield draft
        draft.chmod(0o644)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


@contextlib.contextmanager
def draft_folder_of(path: Path) -> Iterator[Path]:
    """A folder beside ``path`` to write into.

    It becomes ``path``, which must not be there, unless an exception was raised; none is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        yield draft
        draft.chmod(0o755)
        os.rename(draft, path)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    with draft_of(path) as draft:
        draft.write_bytes(content)


def write_text(path: Path, content: str) -> None:
    """Write a text in UTF-8, whole or not at all."""
    write_bytes(path, content.encode("utf-8"))


def require_new_folder(path: Path) -> None:
    """HostError where something lies at ``path`` already."""
    if path.exists():
        raise HostError(f"{path} is there already; remove it, or name another folder")


def write_text_folder(path: Path, texts: Mapping[str, str]) -> str:
    """Write a folder of ``texts`` by file name, whole or not at all; its files and their size in words."""
    with draft_folder_of(path) as draft:
        for name, text in texts.items():
            write_text(draft / name, text)
    return f"{', '.join(texts)}, {size_words(sum(len(text.encode()) for text in texts.values()))}"


def size_words(size_bytes: int) -> str:
    """A size of a file in words, in kB of 1,000 bytes."""
    return f"{size_bytes / 1000:.0f} kB"


def write_json(path: Path, content: Any) -> None:
    """Write JSON, whole or not at all; ValueError for NaN and infinity, which JSON does not have."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """The content of a file of ``write_json``; PipelineError where an earlier stage has not run."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PipelineError(f"{path} cannot be read ({error}); run the stages before this one: dvc repro") from None


def kept_folder(name: str) -> Path:
    """The folder of this user for what takes long to fetch or to make, and can be had again; it need not be there."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "loopwright" / name


def digest(content: Any) -> str:
    """sha256 of JSON-ready content, however its keys are ordered; what JSON does not know counts as its text."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def sha256(path: Path) -> str:
    """Digest of a file's content, as 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
