"""Where the operator's page is served, and to whom."""

from __future__ import annotations

import ipaddress
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path

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
