"""Where the operator's page is served, to whom, and the rights of a browser."""

from __future__ import annotations

import ipaddress
import socket
import ssl
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from loopwright.serving.errors import LoopError
from loopwright.serving.words import named


def listening(page: Page) -> socket.socket:
    """A socket that listens where the page is to be. LoopError where it cannot."""
    host, port = page.address
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        raise LoopError(f"the page cannot listen at {page.listen}: {error.strerror or error}") from None


def require_usable(page: Page) -> None:
    """LoopError where the page's certificate or key cannot be used."""
    if page.certificate is None:
        return
    try:
        # A key that is locked by a password would be asked for at the terminal.
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(page.certificate, page.private_key, lambda: "")
    except OSError as error:  # ssl.SSLError too
        raise LoopError(f"the page's certificate or key cannot be used: {named(error)}") from None


# ------------------------------------------------------------------------------------------------------------ settings
LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True, slots=True)
class Page:
    """The address of the page.

    Changes need the token, which the loop makes and prints at its start unless ``token_file`` has it. An address that
    others can reach needs ``allow_remote``, ``certificate`` and ``private_key`` (PEM); ``names`` are the host names,
    with port where it is not 443, by which browsers then reach it.
    """

    listen: str
    token_file: Path | None = None
    allow_remote: bool = False
    certificate: Path | None = None
    private_key: Path | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        host, port = self.address
        if not self.local and not self.allow_remote:
            raise LoopError(
                f"page listens at {host}, which other machines can reach; use 127.0.0.1:{port}, or say "
                "allow_remote = true with a certificate and private_key"
            )
        if (self.certificate is None) != (self.private_key is None):
            raise LoopError("page.certificate and page.private_key go together")
        if not self.local and self.certificate is None:
            raise LoopError("a page that other machines can reach needs TLS: page.certificate and page.private_key")

    @property
    def address(self) -> tuple[str, int]:
        """Host and port; LoopError where ``listen`` names none."""
        host, _, port = self.listen.rpartition(":")
        host = host.removeprefix("[").removesuffix("]")
        if not host or not port.isascii() or not port.isdigit() or not 0 <= int(port) < 65536:
            raise LoopError(f"page listens at {self.listen!r}; it must be HOST:PORT, such as 127.0.0.1:8080")
        return host, int(port)

    @property
    def local(self) -> bool:
        """Whether only this machine can reach it."""
        host, _ = self.address
        if host == "localhost":
            return True
        try:
            return ipaddress.ip_address(host).is_loopback
        except ValueError:
            return False

    def hosts(self, port: int) -> list[str]:
        """Allowed Host headers of a browser: at the port of its scheme it names none."""
        host, _ = self.address
        shown = f"[{host}]" if ":" in host else host
        names = list(dict.fromkeys((shown.lower(), "localhost", "127.0.0.1", "[::1]")))
        bare = names if port == (80 if self.certificate is None else 443) else []
        return [*(f"{name}:{port}" for name in names), *bare, *(n.lower() for n in self.names)]

    def token(self) -> str:
        """The token in ``token_file``; empty without one. LoopError where it is too short to be one."""
        if self.token_file is None:
            return ""
        try:
            token = self.token_file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise LoopError(f"page.token_file cannot be read: {error}") from None
        if len(token) < 16 or not token.isascii() or not token.isprintable():
            raise LoopError(f"page.token_file {self.token_file} must hold a token of at least 16 ASCII characters")
        return token


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
