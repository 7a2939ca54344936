"""Connections that take their time, or are too many."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0  # in which a request's head must be here
STALLED_S = 30.0  # in which an answer that is waiting must be taken
MOST_CONNECTIONS = 200  # connections at once, not browsers: beyond it the longest idle one is closed


class Impatient(H11Protocol):
    """Closes a connection that is open for ``REQUEST_S`` without a whole request, or takes no answer for ``STALLED_S``.

    Beyond the most connections the one that has idled longest goes, else the one that is open longest, whatever is
    answered on it: whoever opens many keeps nobody out, and a page that had to go comes back by itself.
    """

    _began = 0.0
    _deadline: asyncio.TimerHandle | None = None
    _stalled: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin."""
        super().connection_made(transport)
        self._began = self.loop.time()
        if len(self.connections) > MOST_CONNECTIONS:
            self._to_go().give_up()
        self._watch()

    def pause_writing(self) -> None:
        """More waits to be taken than is kept for a connection."""
        super().pause_writing()
        if self._stalled is None:
            self._stalled = self.loop.call_later(STALLED_S, self.give_up)

    def resume_writing(self) -> None:
        """It was taken."""
        super().resume_writing()
        self._taken()

    def data_received(self, data: bytes) -> None:
        """Some bytes of a request."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """The next request may come."""
        super().on_response_complete()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        self._taken()
        super().connection_lost(exc)

    def give_up(self) -> None:
        """Close it without a farewell, which nobody would read."""
        if not self.transport.is_closing():
            self.transport.abort()

    def _watch(self) -> None:
        """Run the clock while no request is answered."""
        busy = self.cycle is not None and not self.cycle.response_complete
        if busy and self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        elif not busy and self._deadline is None:
            self._deadline = self.loop.call_later(REQUEST_S, self._too_slow)

    def _too_slow(self) -> None:
        self._deadline = None
        self.give_up()

    def _taken(self) -> None:
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def _to_go(self) -> Impatient:
        """The idle connection whose deadline comes first; the one that is open longest where all are busy."""
        others = [c for c in self.connections if isinstance(c, Impatient) and not c.transport.is_closing()]
        idle = [(c._deadline.when(), i) for i, c in enumerate(others) if c._deadline is not None]
        busy = [(c._began, i) for i, c in enumerate(others) if c is not self]
        return others[min(idle or busy)[1]] if idle or busy else self
