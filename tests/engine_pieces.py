"""Pieces of work that workers import. Not a test."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Event

from distributed import get_worker

from pipeline.errors import PipelineError


def squares(item: int) -> int:
    return item**2


def refuse(item: int) -> int:
    if item == 2:
        raise PipelineError("the valve is stuck")
    return item


def pid_of(folder: Path, item: int) -> int:
    """Say who does it; the first time the piece 3 waits to be killed."""
    (folder / f"{item}-{os.getpid()}").touch()
    if item == 3 and len(list(folder.glob("3-*"))) == 1:
        Event().wait(60)
    return item**2


def process_of(_: int) -> int:
    Event().wait(0.05)
    return os.getpid()


def watched(_: int) -> bool:
    """Whether Dask's profiler looks into the frames of this process's tasks."""
    return "profile" in get_worker().periodic_callbacks
