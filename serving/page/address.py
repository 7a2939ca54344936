"""Needs of a page on its machine: a port to listen at, and a certificate with its key."""

from __future__ import annotations

import socket
import ssl

from loopwright.serving.errors import LoopError
from loopwright.serving.page.settings import Page
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
