"""A piece of work as a worker does it: values in, bytes out.

``shared`` is what all pieces of a call have in common: the function, and the files around it or None.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import pickle
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from threadpoolctl import ThreadpoolController

from loopwright.pipeline.engine.cluster import address, unwatched
from loopwright.pipeline.engine.fingerprint import difference, fingerprint
from loopwright.pipeline.engine.progress import lines_anew
from loopwright.pipeline.engine.stage_files import Files, NewFolder
from loopwright.pipeline.errors import PipelineError

if TYPE_CHECKING:
    from distributed import Worker

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class WorkerTask:
    """The work of this thread of a worker: the files that it began with, who waits for it, and in how many others.

    ``wanted`` says whether somebody still waits.
    """

    files: Files
    wanted: Callable[[], bool]
    depth: int = 0


_task: ContextVar[WorkerTask | None] = ContextVar("task", default=None)


def current_task() -> WorkerTask | None:
    """The task that this thread of a worker does; None on a client."""
    return _task.get()


@contextlib.contextmanager
def doing(task: WorkerTask) -> Iterator[None]:
    """Within, this thread of a worker does ``task``, whose pieces go to the cluster."""
    token = _task.set(task)
    try:
        yield
    finally:
        _task.reset(token)


def still_wanted(worker: Worker, key: str) -> bool:
    """Whether somebody waits for the task of this key, which the worker does."""
    task = worker.state.tasks.get(key)
    return task is not None and task.state not in {"cancelled", "released", "forgotten"}


def on_worker(item: bytes, key: str, *, shared: bytes, theirs: Mapping[str, str], depth: int) -> bytes:
    """``answer``, as the task ``key`` that it is on a worker."""
    from distributed import get_worker

    worker = get_worker()
    unwatched(worker)
    with lines_anew(math.inf):
        return answer(shared, item, theirs, worker.local_directory, lambda: still_wanted(worker, key), depth)


def answer(
    shared: bytes,
    item: bytes,
    theirs: Mapping[str, str],
    parent: str | None = None,
    wanted: Callable[[], bool] = lambda: True,
    depth: int = 0,
) -> bytes:
    """(error, result, changed files) of a piece, pickled; the error or the other two are None or empty.

    Folders are made in ``parent``; ``wanted`` and ``depth`` are those of ``WorkerTask``.
    """
    try:
        if other := difference(theirs, fingerprint()):
            raise mixture(other)
        opened = _opened(hashlib.sha256(shared).digest(), _Content(shared))
        with doing(WorkerTask(opened.files or {}, wanted, depth)), contextlib.ExitStack() as stack:
            folder = None if opened.files is None else stack.enter_context(opened.folder(parent))
            result = alone(opened.function, pickle.loads(item))
            return pickle.dumps((None, result, folder.changes() if folder else {}))
    except Exception as error:
        error.add_note(f"on a worker:\n{traceback.format_exc()}")
        return _as_bytes(error)


def mixture(other: str) -> PipelineError:
    """The line for a worker that runs other code or other versions than who asks it."""
    return PipelineError(
        f"a worker runs something else than this run: {other}; results of a mixture are of no use: "
        "install the same on both and start the workers again (sources that were edited meanwhile count, too)"
    )


class _Content:
    """Bytes that are no part of a key."""

    def __init__(self, content: bytes) -> None:
        self.content = content

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content)

    def __hash__(self) -> int:
        return 0


@dataclass
class _Opened:
    """Data that the pieces of a call share, on one worker."""

    function: Callable[[Any], Any]
    files: Files | None
    kept: list[NewFolder] = field(default_factory=list)  # folders that nobody uses or has changed

    @contextlib.contextmanager
    def folder(self, parent: str | None) -> Iterator[NewFolder]:
        """A folder with the files as the working folder; it is kept for the next piece if nothing was changed."""
        folder = self.kept.pop() if self.kept else NewFolder(self.files or {}, parent)
        try:
            with folder:
                yield folder
        finally:
            if folder.changes():
                folder.remove()
            else:
                self.kept.append(folder)


@lru_cache(maxsize=4)
def _opened(_digest: bytes, shared: _Content) -> _Opened:
    """Made once for all pieces: what a function computes on first use and keeps (a plant's functions) is kept."""
    return _Opened(*pickle.loads(shared.content))


def alone(function: Callable[[Item], Result], item: Item) -> Result:
    """``function(item)`` on one thread: processes that each start a thread per core only fight over the cores."""
    with _pools(*_loaded()).limit(limits=1):
        return function(item)


@lru_cache(maxsize=1)
def _pools(_modules: int, _libraries: int) -> ThreadpoolController:
    """The libraries with threads of their own, found anew where something was loaded: that takes some milliseconds."""
    return ThreadpoolController()


def _loaded() -> tuple[int, int]:
    """How many modules and, on Linux, parts of libraries: CasADi's solvers come without a module."""
    maps = Path("/proc/self/maps")
    return len(sys.modules), maps.read_bytes().count(b".so") if maps.exists() else 0


def _as_bytes(error: Exception) -> bytes:
    try:
        content = pickle.dumps((error, None, {}))
        pickle.loads(content)
    except Exception:  # not every error survives the way
        return pickle.dumps((PipelineError(f"{type(error).__name__}: {error}"), None, {}))
    return content


def lost(error: Exception, what: str) -> PipelineError:
    """The line for work that the cluster could not do."""
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        # Dask counts the deaths of a worker for all that waits there, so no single piece can be named.
        return PipelineError(
            "workers died one after the other (often the memory was not enough); start fewer, and run it again"
        )
    if "scheduler-connection-lost" in str(error):
        return PipelineError(
            f"the connection to the scheduler at {address()} was lost; start it again, and run this again"
        )
    return PipelineError(f"{what}: the cluster gave it up ({' '.join(str(error).split())}); run it again")
