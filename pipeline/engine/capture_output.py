"""Output of a stage while a worker runs it: its lines go to the client that asked for it, not to the worker's log.

A worker's process holds several stages at a time, of which one at most runs; the others wait for their pieces. So what
is said belongs to the thread that says it.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TextIO

BARS = "LOOPWRIGHT_BARS"  # in the environment: somebody draws bars from marked lines of progress
MARK = "\x02"  # begins such a line
Listener = Callable[[str, str], None]  # (stdout or stderr, text)
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


class _Stream:
    """A stream of this process that gives a thread's text to the thread's listener, if it has one."""

    def __init__(self, name: str, own: TextIO) -> None:
        self.name, self.own = name, own

    def write(self, text: str) -> int:
        listener = _listener.get()
        if listener is None:
            return self.own.write(text)
        if text:
            listener(self.name, text)
        return len(text)

    def flush(self) -> None:
        if _listener.get() is None:
            self.own.flush()

    def isatty(self) -> bool:
        return _listener.get() is None and self.own.isatty()

    def __getattr__(self, name: str) -> object:
        return getattr(self.own, name)


def listen() -> None:
    """Have this process's streams know of listeners; a second time changes nothing."""
    for name in ("stdout", "stderr"):
        own = getattr(sys, name)
        if not isinstance(own, _Stream):
            setattr(sys, name, _Stream(name, own))


@contextlib.contextmanager
def spoken_to(listener: Listener) -> Iterator[None]:
    """Whatever this thread prints goes to ``listener``."""
    listen()
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
