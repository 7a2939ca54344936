"""The card of the operator's page, in a real browser: who signed the controller in charge, and those to swap to."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from chromium import CHROMIUM, launched
from plant_servers import RunningLoop

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)

from playwright.sync_api import Page, expect

pytest_plugins = ["signed_files", "signed_loop"]
expect.set_options(timeout=30_000)


@pytest.fixture
def card_page(trusting_loop: RunningLoop) -> Iterator[Page]:
    assert trusting_loop.station.page is not None
    with launched() as browser:
        made = browser.new_page()
        made.goto(trusting_loop.station.page.url)
        yield made


def test_the_card_shows_who_signed_and_offers_what_is_trusted(card_page: Page) -> None:
    card = card_page.locator("#card-body")
    expect(card).to_contain_text(re.compile(r"signed by\s*anna \(key [0-9a-f]{16}\)"))
    buttons = card_page.locator("#candidates .candidate")
    expect(buttons).to_have_count(1)
    expect(buttons).to_contain_text(
        re.compile(r"inverse_dob for thiosulfate_cstr \(inverse_dob\.onnx, [0-9a-f]{8}, signed by anna \(key")
    )
