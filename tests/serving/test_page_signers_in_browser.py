"""The card of the operator's page, in a real browser: who signed the controller in charge, and those to swap to."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator

import pytest
from plant_servers import RunningLoop

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if CHROMIUM is None:
    pytest.skip("no chromium is installed (apt install chromium)", allow_module_level=True)

from playwright.sync_api import Page, expect, sync_playwright  # noqa: E402

pytest_plugins = ["signed_files", "signed_loop"]
expect.set_options(timeout=30_000)


@pytest.fixture
def card_page(trusting_loop: RunningLoop) -> Iterator[Page]:
    assert trusting_loop.station.page is not None
    with sync_playwright() as p:
        # Containers have no user namespaces; the page is our own.
        browser = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        made = browser.new_page()
        made.goto(trusting_loop.station.page.url)
        yield made
        browser.close()


def test_the_card_shows_who_signed_and_offers_what_is_trusted(card_page: Page) -> None:
    card = card_page.locator("#card-body")
    expect(card).to_contain_text(re.compile(r"signed by\s*anna \(key [0-9a-f]{16}\)"))
    buttons = card_page.locator("#candidates .candidate")
    expect(buttons).to_have_count(1)
    expect(buttons).to_contain_text(
        re.compile(r"inverse_dob for thiosulfate_cstr \(inverse_dob\.onnx, [0-9a-f]{8}, signed by anna \(key")
    )
