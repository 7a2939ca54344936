"""Connections that take their time, or are too many."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 10.0  # in which a request's head must be here
STALLED_S = 30.0  # in which an answer that is waiting must be taken
MOST_CONNECTIONS = 200


class Impatient(H11Protocol):
    """Closes a connection that is open for ``REQUEST_S`` without a whole request, or takes no answer for ``STALLED_S``.

    Beyond the most connections the one that has idled longest goes, so that whoever opens many keeps nobody out.
    """

    _deadline: asyncio.TimerHandle | None = None
    _stalled: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin."""
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            self._longest_idle().give_up()
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

    def _longest_idle(self) -> Impatient:
        """The connection whose deadline comes first; this one where all others are being answered."""
        idle = [c for c in self.connections if isinstance(c, Impatient) and not c.transport.is_closing()]
        waits = [(c._deadline.when(), i) for i, c in enumerate(idle) if c._deadline is not None]
        return idle[min(waits)[1]] if waits else self
