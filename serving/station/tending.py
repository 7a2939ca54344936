"""Files of a loop in a folder for temporary ones, looked after for months."""

from __future__ import annotations

import threading
from collections.abc import Callable

from loopwright.serving.words import named

EVERY_S = 60.0  # an alarm of another loop ends so long after that loop at most


class Tending:
    """Calls ``act`` now and then from a thread of its own; ``trouble`` is told what it raises, and "" once it is well.

    No word is said twice in a row.
    """

    def __init__(
        self, act: Callable[[], None], trouble: Callable[[str], None] = lambda _: None, every_s: float = EVERY_S
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
