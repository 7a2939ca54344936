"""What workers write to the terminal, until a run is stopped."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

END = b"\0"


@contextlib.contextmanager
def outlet(stopped: threading.Event) -> Iterator[int]:
    """Within, what this process and those that it starts write to stderr passes through here; the real one's number.

    Once ``stopped``, no more comes out: workers that are ended while they start complain of what they did not get, at
    a time of their own, and the last line of a stopped run is to be the one that says how to go on.
    """
    real, (source, into), ended = os.dup(2), os.pipe(), threading.Event()
    os.dup2(into, 2)
    passing = threading.Thread(target=_pass_on, args=(source, real, stopped, ended), daemon=True)
    passing.start()
    try:
        yield real
    finally:
        if not stopped.is_set():  # else a worker that is only now started would write to the terminal again
            os.dup2(real, 2)
        ended.set()
        os.write(into, END)  # behind all that was written; who still writes does so into nothing
        passing.join()
        os.close(into)


def _pass_on(source: int, to: int, stopped: threading.Event, ended: threading.Event) -> None:
    text = b""
    while not (ended.is_set() and END in text):  # who writes on may have written behind the end already
        text = os.read(source, 65_536)
        if not stopped.is_set():
            with contextlib.suppress(OSError):  # nobody reads any more; unread here, it would stop those who write
                os.write(to, text.partition(END)[0] if ended.is_set() else text)
