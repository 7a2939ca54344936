"""What tests do at the faceplates of a law that operators steer. Not a test."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from operated_page import TOKEN, ModelPlant
from plant_servers import RunningLoop

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

Steered: TypeAlias = tuple[RunningLoop, ModelPlant]


def come_in(browser: Browser, loop: RunningLoop, **how: Any) -> Page:
    """A new page of the loop, with the token at hand."""
    from playwright.sync_api import expect

    assert loop.station.page is not None
    made = browser.new_page(**{"locale": "en-GB", "timezone_id": "UTC", **how})
    made.goto(loop.station.page.url)
    expect(made.locator('[data-operated="y0"]')).to_be_visible()
    made.evaluate("token => sessionStorage.setItem('token', token)", TOKEN)
    made.evaluate("sessionStorage.setItem('who', 'anna')")
    return made


def value(loop: RunningLoop, name: str) -> float:
    """An entry of ``operate`` as the loop has it."""
    assert loop.station.loop is not None
    found: float = loop.station.loop.operate[loop.station.controller.manifest.operate.index(entry(loop, name))]
    return found


def entry(loop: RunningLoop, name: str) -> Any:
    return next(e for e in loop.station.controller.manifest.operate if e.name == name)


def fact(page: Page, signal: str, what: str) -> Locator:
    return page.locator(f'[data-operated="{signal}"] [data-fact="{what}"]')


def change(page: Page, signal: str, **values: str) -> None:
    """By mouse, one request for all."""
    page.click(f'[data-change="{signal}"]')
    for what, text in values.items():
        field = page.locator(f'[data-field="{signal}.{what}"]')
        if field.evaluate("e => e.localName") == "select":
            field.select_option(text)
        else:
            field.fill(text)
    page.click("#confirm")
