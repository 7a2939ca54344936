"""Output of stages and workers on the terminal.

A worker's process holds several stages at a time, of which one at most runs; the others wait for their pieces. So what
is said belongs to the thread that says it.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TextIO

END_BYTES = 16  # drawn at random: no program writes them by chance
NO_TEXT = b"\xff"  # begins the end: a byte of UTF-8 never has this value, so no text has to wait for what follows it


@contextlib.contextmanager
def outlet(stopped: threading.Event) -> Iterator[int]:
    """Within, what this process and those that it starts write to stderr passes through here; the real one's number.

    Once ``stopped``, no more comes out: workers that are ended while they start complain of what they did not get, at
    a time of their own, and the last line of a stopped run is to be the one that says how to go on.
    """
    real, (source, into), end = os.dup(2), os.pipe(), NO_TEXT + os.urandom(END_BYTES)
    os.dup2(into, 2)
    passing = threading.Thread(target=_pass_on, args=(source, real, stopped, end), daemon=True)
    passing.start()
    try:
        yield real
    finally:
        if not stopped.is_set():  # else a worker that is only now started would write to the terminal again
            os.dup2(real, 2)
        os.write(into, end)  # behind all that was written; who still writes does so into nothing
        passing.join()
        os.close(into)


def _pass_on(source: int, to: int, stopped: threading.Event, end: bytes) -> None:
    kept, over, within = b"", False, False  # within a line
    while not over:  # who writes on may have written behind the end already
        text, found, _ = (kept + os.read(source, 65_536)).partition(end)
        over = bool(found)
        begun = 0 if over else _begun(text, end)
        text, kept = text[: len(text) - begun], text[len(text) - begun :]
        if stopped.is_set():  # print writes a line and its end one after the other, and the stop may fall between them
            text = b"\n" * within
        within = not text.endswith(b"\n") if text else within
        with contextlib.suppress(OSError):  # nobody reads any more; unread here, it would stop those who write
            os.write(to, text)


def _begun(text: bytes, end: bytes) -> int:
    """How many of the last bytes may be the beginning of the end."""
    return next((n for n in range(len(end) - 1, 0, -1) if text.endswith(end[:n])), 0)


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
