"""The browser that the tests drive."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fake_loop import FakeLoop
    from playwright.sync_api import Browser, Page

# The shell without windows draws the same pages; the whole browser takes twice the processor time for them.
NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def launched() -> Iterator[Browser]:
    """The browser until the block ends."""
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=30_000)  # a busy machine takes its time
    with sync_playwright() as p:
        # Containers have no user namespaces; the pages are our own.
        made = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield made
        made.close()


def come_in(browser: Browser, served: tuple[FakeLoop, str, str], **how: object) -> Page:
    """A new page that shows all there is, with the token at hand."""
    from playwright.sync_api import expect

    made = browser.new_page(**{"locale": "en-GB", "timezone_id": "UTC", **how})  # type: ignore[arg-type]
    made.set_default_timeout(20_000)
    made.goto(served[1])
    expect(made.locator("#alarm-list .alarm").first).to_be_visible()
    expect(made.locator("[data-chart]").first).to_have_attribute("data-rows", re.compile("[1-9]"))
    made.evaluate("token => sessionStorage.setItem('token', token)", served[2])
    made.evaluate("sessionStorage.setItem('who', 'anna')")
    return made
