"""The commit of the code that a run uses, which only who has the repository can tell."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from contextvars import ContextVar
from functools import partial

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
