"""Pieces of work that workers import. Not a test."""

from __future__ import annotations

import os
import resource
import signal
from pathlib import Path
from threading import Event

from distributed import get_worker

from loopwright.pipeline.engine.parallel import parallel_map
from loopwright.pipeline.errors import PipelineError


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


def pages_of(_: int) -> int:
    """How many pages the system cleared for this process while it made an array of 16 MB a hundred times."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        bytearray(16 * 1024**2)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def waking_ms(_: int) -> tuple[float, float]:
    """How often [ms] this worker looks at its event loop, and at what it takes of the machine."""
    callbacks = get_worker().periodic_callbacks
    return callbacks["tick"].callback_time, callbacks["monitor"].callback_time


def watched(_: int) -> bool:
    """Whether Dask's profiler looks into the frames of this process's tasks."""
    return "profile" in get_worker().periodic_callbacks


def sums_of_squares(item: int) -> int:
    """Of a piece that shares its work in turn, in its folder."""
    here = os.getcwd()
    found = parallel_map(squares, range(item), "of a piece")
    assert os.getcwd() == here
    return sum(found) + int(Path("given.txt").read_text())


def folder_of(item: int) -> str:
    """The working folder; the piece 2 leaves a file there."""
    if item == 2:
        Path("left.txt").touch()
    return os.getcwd()


def fatal(item: int) -> int:
    if item == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return item
