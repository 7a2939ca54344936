"""Access to the page, and the rights of a browser."""

from __future__ import annotations

from collections.abc import Collection

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LONGEST_BODY = 10_000  # bytes
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
        if not (length.isascii() and length.isdigit()) or int(length) > LONGEST_BODY:
            return 413, f"a change has at most {LONGEST_BODY} bytes, and says how many"
        return None
