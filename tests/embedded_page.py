"""The page of examples/embed/browser in chromium, from a server of files alone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
from chromium import launched
from kits import EMBED
from playwright.sync_api import Page, expect

expect.set_options(timeout=30_000)


class Quiet(SimpleHTTPRequestHandler):
    """Serves files without a word, and keeps which were asked for."""

    asked: list[str]

    def log_message(self, format: str, *words: object) -> None:
        """Nothing."""
        self.asked.append(self.path)


@pytest.fixture(scope="module")
def asked() -> list[str]:
    """Paths that browsers of this module have asked for."""
    return []


@pytest.fixture(scope="module")
def page(asked: list[str]) -> Iterator[Page]:
    """The page from a server of files alone; whatever it says of errors fails the tests."""
    handler = type("Handler", (Quiet,), {"asked": asked})
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=EMBED))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    said: list[str] = []
    with launched() as browser:
        made = browser.new_page()
        made.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        made.on("pageerror", lambda error: said.append(str(error)))
        made.goto(f"http://127.0.0.1:{server.server_port}/browser/")
        expect(made.locator("body")).to_have_attribute("data-ready", "yes")
        yield made
    server.shutdown()
    server.server_close()
    thread.join()
    assert said == []
