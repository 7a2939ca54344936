"""Versions and sources of a process: versions of what decides results, and a digest of the sources.

Results of a run must come of one code. A client sends its fingerprint with every task; a worker with another refuses.
"""

from __future__ import annotations

import contextlib
import hashlib
import platform
import subprocess
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = (
    "numpy",
    "scipy",
    "torch",
    "casadi",
    "onnx",
    "onnxruntime",
    "onnxscript",
    "scikit-learn",
    "numba",
    "pyarrow",
)
FOLDERS = ("pipeline", "serving")
IMPORTED = Path(__file__).parents[2]  # the place of the sources that run
CODE = "code"


@cache
def fingerprint() -> Mapping[str, str]:
    """Versions by name, and under ``CODE`` the digest of all sources, as this process found them at its first call."""
    return {
        "Python": platform.python_version(),
        **{name: _version(name) for name in PACKAGES},
        CODE: digest_of_sources(IMPORTED),
    }


def difference(ours: Mapping[str, str], theirs: Mapping[str, str]) -> str:
    """The differences, in words: "torch 2.13.0 here and 2.12.1 there"; empty where nothing does."""
    names = sorted({*ours, *theirs})
    pairs = [(name, ours.get(name, "none"), theirs.get(name, "none")) for name in names]
    return ", ".join(f"{name} {_short(name, a)} here and {_short(name, b)} there" for name, a, b in pairs if a != b)


def digest_of_sources(root: Path) -> str:
    """sha256 over the names and contents of the sources below a folder."""
    found = hashlib.sha256()
    for path in sorted(p for folder in FOLDERS for p in (root / folder).rglob("*.py")):
        content = path.read_bytes()
        found.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return found.hexdigest()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


def _short(name: str, value: str) -> str:
    return value[:12] if name == CODE else value


_told: ContextVar[str | None] = ContextVar("commit", default=None)


def commit() -> str:
    """Commit of the code, with "-dirty" where it or params.yaml was edited since; "unknown" without a repository."""
    told = _told.get()
    if told is not None:
        return told
    git = partial(subprocess.run, capture_output=True, text=True, timeout=10)
    try:
        head = git(["git", "rev-parse", "HEAD"], check=True).stdout.strip()
        edited = git(["git", "diff", "--quiet", "HEAD", "--", "pipeline", "serving", "params.yaml"]).returncode
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return head + ("-dirty" if edited else "")


@contextlib.contextmanager
def told(of: str) -> Iterator[None]:
    """Within, ``of`` is the commit: a worker has no repository, its client has."""
    token = _told.set(of)
    try:
        yield
    finally:
        _told.reset(token)
