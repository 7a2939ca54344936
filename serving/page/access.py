"""Access to the page: the rights of a browser, and connections that take their time, or are too many."""

from __future__ import annotations

import asyncio
from collections.abc import Collection

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

LONGEST_BODY = 10_000  # bytes
LONGEST_CHANGE = (
    100_000  # bytes of a change, which the token is asked for first: as the loop takes, for a course's file
)
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Access:
    """Answers only who asks for one of ``hosts``, and lets nothing but this page's own scripts change anything.

    A name that an attacker's own DNS points here is no name of this page (Host); a form or a script of another site
    says where it comes from (Origin, Sec-Fetch-Site). From other sites only a link to the page itself is followed.
    """

    def __init__(self, app: ASGIApp, hosts: Collection[str], scheme: str) -> None:
        self.app, self.hosts = app, frozenset(hosts)
        self.origins = frozenset(f"{scheme}://{host}" for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        refused = self._refused(scope)
        if refused:
            await JSONResponse({"error": refused[1]}, refused[0])(scope, receive, answer)
            return
        await self.app(scope, receive, answer)

    def _refused(self, scope: Scope) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        if len(hosts) != 1 or hosts[0].lower() not in self.hosts:
            return 421, f"this page is served as {', '.join(sorted(self.hosts))}; page.names in loop.toml adds names"
        if scope["method"] in {"GET", "HEAD"}:
            foreign = headers.get("sec-fetch-site", "none") not in {"same-origin", "none"}
            followed = headers.get("sec-fetch-dest") == "document" and not scope["path"].startswith("/api/")
            if foreign and not followed:
                return 403, "only this page's own scripts may read from it"
            return None
        if scope["method"] != "POST":
            return 405, "this page is read by GET and changed by POST"
        if headers.getlist("origin") not in ([o] for o in self.origins):
            return 403, "a change must come from this page itself"
        if headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return 403, "a change must come from this page itself"
        if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            return 415, "a change is sent as application/json"
        if headers.getlist("transfer-encoding") or headers.getlist("content-encoding"):
            return 413, "a change is sent as it is, and says how long it is"
        length = headers.get("content-length", "")
        most = longest(scope["path"])
        if not (length.isascii() and length.isdigit()) or int(length) > most:
            return 413, f"a change has at most {most} bytes, and says how many"
        return None


def longest(path: str) -> int:
    """The most bytes that the body of a request to a path may have."""
    return LONGEST_CHANGE if path == "/api/change" else LONGEST_BODY


# ---------------------------------------------------------------------------------------------------------- connections
REQUEST_S = 10.0  # in which a request's head must be here
STALLED_S = 30.0  # in which an answer that is waiting must be taken
MOST_CONNECTIONS = 200  # connections at once, not browsers: beyond it the longest idle one is closed


class TimedConnection(H11Protocol):
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

    def _to_go(self) -> TimedConnection:
        """The idle connection whose deadline comes first; the one that is open longest where all are busy."""
        others = [c for c in self.connections if isinstance(c, TimedConnection) and not c.transport.is_closing()]
        idle = [(c._deadline.when(), i) for i, c in enumerate(others) if c._deadline is not None]
        busy = [(c._began, i) for i, c in enumerate(others) if c is not self]
        return others[min(idle or busy)[1]] if idle or busy else self
