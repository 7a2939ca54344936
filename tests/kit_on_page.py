"""A conformance kit played on the page of examples/embed/browser."""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import Page, expect


def conform(page: Page, kit: Path, *more: Path) -> str:
    """What the page says of a kit, its files chosen together with ``more``."""
    page.set_input_files("#files", [str(file) for file in (*kit.iterdir(), *more)])
    page.click("#conform")
    expect(page.locator("#conform")).to_be_enabled()
    expect(page.locator("#said")).not_to_be_empty()
    return page.locator("#said").text_content() or ""
