"""Lines for whoever started a loop, and its files in temporary folders: neither stops a scan, for months."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress

from loopwright.serving.words import named

# ------------------------------------------------------------------- lines for a reader that may be slow, full or gone
WAITING_LINES = 1_000  # lines
LONGEST_END_S = 2.0  # that an end waits for lines to be read


class LinePrinter:
    """Says lines by ``tell`` in a thread of its own, in their order; ``tell`` may block or raise as it likes.

    ``print`` blocks where a terminal is halted or a pipe is full, and raises where the disk behind it is. At most
    ``WAITING_LINES`` lines wait; those beyond are dropped, and a line tells how many.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._lines = queue.Queue[str | None](WAITING_LINES)
        self._dropped, self._ended = 0, False
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def say(self, line: str) -> None:
        """Have a line said, from any thread; at once, and without an error."""
        if self._ended:
            self._say(line)
            return
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="lines", daemon=True)
                self._thread.start()
            try:
                self._lines.put_nowait(line)
            except queue.Full:
                self._dropped += 1

    def end(self) -> None:
        """Wait a little until what waits is said; from then on lines are said by whoever has them."""
        with self._lock:
            thread, self._thread = self._thread, None
        if thread is not None:
            with suppress(queue.Full):
                self._lines.put(None, timeout=LONGEST_END_S)
            thread.join(LONGEST_END_S)
            self._ended = not thread.is_alive()

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            self._say(line)
            if self._dropped and self._lines.empty():
                with self._lock:
                    dropped, self._dropped = self._dropped, 0
                self._say(f"{dropped} more lines were not said here: nobody read them in time")

    def _say(self, line: str) -> None:
        with suppress(Exception):
            self._tell(line)


# -------------------------------------------------------------------------------- files in a folder for temporary ones
TENDING_EVERY_S = 60.0  # an alarm of another loop ends so long after that loop at most


class PeriodicTask:
    """Calls ``act`` now and then from a thread of its own; ``trouble`` is told what it raises, and "" once it is well.

    No word is said twice in a row.
    """

    def __init__(
        self, act: Callable[[], None], trouble: Callable[[str], None] = lambda _: None, every_s: float = TENDING_EVERY_S
    ) -> None:
        self._act, self._trouble, self._every_s, self._said = act, trouble, every_s, ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tending", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look after nothing any more."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing.wait(self._every_s):
            said = ""
            try:
                self._act()
            except Exception as error:  # it is tried again
                said = named(error)
            if said != self._said:
                self._said = said
                self._trouble(said)
