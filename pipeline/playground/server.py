"""A file server for the page, on this machine alone."""

from __future__ import annotations

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

from loopwright.pipeline.errors import PipelineError

HOST = "127.0.0.1"


class _Files(SimpleHTTPRequestHandler):
    # What the machine's own table says of these differs from system to system; a browser wants exactly these.
    extensions_map: ClassVar[dict[str, str]] = {  # type: ignore[misc]
        "": "application/octet-stream",
        ".html": "text/html; charset=utf-8",
        ".css": "text/css",
        ".js": "text/javascript",
        ".mjs": "text/javascript",
        ".json": "application/json",
        ".svg": "image/svg+xml",
        ".wasm": "application/wasm",
    }

    def end_headers(self) -> None:
        """Add that nothing is to be kept: a page that was written again is to be seen."""
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing of each request."""


def file_server(folder: Path, port: int) -> ThreadingHTTPServer:
    """A server of ``folder`` that listens at ``port``, 0 for any free one; PipelineError where it cannot."""
    try:
        return ThreadingHTTPServer((HOST, port), partial(_Files, directory=str(folder)))
    except OSError as error:
        raise PipelineError(
            f"nothing can listen at {HOST}:{port}: {error.strerror or error}; give another --port, 0 for a free one"
        ) from None
