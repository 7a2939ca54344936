"""A piece of work as a worker does it: values in, bytes out.

``shared`` is what all pieces of a call have in common: the function, and the files around it or None.
"""

from __future__ import annotations

import hashlib
import pickle
import traceback
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from functools import lru_cache
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from pipeline.engine.fingerprint import difference, fingerprint
from pipeline.engine.folder import changes_since, within_folder
from pipeline.engine.preload import unwatched
from pipeline.errors import PipelineError

Item = TypeVar("Item")
Result = TypeVar("Result")
_inside: ContextVar[bool] = ContextVar("inside", default=False)


def within_piece() -> bool:
    """Whether this thread does a piece, which is the smallest unit: it does by itself whatever it could share."""
    return _inside.get()


def on_worker(shared: bytes, item: bytes, theirs: Mapping[str, str]) -> bytes:
    """``answer``, as the task that it is on a worker."""
    from distributed import get_worker

    unwatched(get_worker())
    return answer(shared, item, theirs)


def answer(shared: bytes, item: bytes, theirs: Mapping[str, str]) -> bytes:
    """(error, result, changed files) of a piece, pickled; the error or the other two are None or empty."""
    token = _inside.set(True)
    try:
        if other := difference(theirs, fingerprint()):
            raise mixture(other)
        function, files = _opened(hashlib.sha256(shared).digest(), _Content(shared))
        if files is None:
            return pickle.dumps((None, alone(function, pickle.loads(item)), {}))
        with within_folder(files):
            result = alone(function, pickle.loads(item))
            return pickle.dumps((None, result, changes_since(files)))
    except Exception as error:
        error.add_note(f"on a worker:\n{traceback.format_exc()}")
        return _as_bytes(error)
    finally:
        _inside.reset(token)


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


@lru_cache(maxsize=4)
def _opened(_digest: bytes, shared: _Content) -> Any:
    """Made once for all pieces: what a function computes on first use and keeps (a plant's functions) is kept."""
    return pickle.loads(shared.content)


def alone(function: Callable[[Item], Result], item: Item) -> Result:
    """``function(item)`` on one thread: processes that each start a thread per core only fight over the cores."""
    with threadpool_limits(1):
        return function(item)


def _as_bytes(error: Exception) -> bytes:
    try:
        content = pickle.dumps((error, None, {}))
        pickle.loads(content)
    except Exception:  # not every error survives the way
        return pickle.dumps((PipelineError(f"{type(error).__name__}: {error}"), None, {}))
    return content
