"""Faceplates of a law that operators steer, in a real browser: ranges, refusals, a lost sensor, keyboard, phone."""

from __future__ import annotations

import re
from typing import Any

import pytest
from chromium import CHROMIUM
from faceplate_steps import Steered, change, come_in, fact, value
from processes import within

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)

from playwright.sync_api import Browser, Page, expect

pytest_plugins = ["faceplates_in_chromium"]


def test_a_range_is_narrowed_in_one_request_and_drawn(page: Page, steered: Steered) -> None:
    loop, _ = steered
    before = len(loop.changes("y1: "))
    change(page, "y1", low="-1.5", high="1.25", rank="1")
    expect(page.locator("#dialog")).to_be_hidden()
    expect(fact(page, "y1", "range")).to_have_text("-1.500 … 1.250 m")
    expect(fact(page, "y1", "rank")).to_have_text("1")
    assert [value(loop, f"y1.{what}") for what in ("low", "high", "rank", "track")] == [-1.5, 1.25, 1.0, 1.0]
    assert len(loop.changes("y1: ")) == before + 1  # what was not touched is not sent, and all at once is one change
    expect(page.locator('[data-chart="y1"]')).to_have_attribute("data-bands", "1")
    expect(page.locator('[data-chart="y0"]')).to_have_attribute("data-bands", "0")  # as wide as it was designed
    bar = page.locator('[aria-label="y1"] .within')
    share = bar.evaluate("e => e.offsetWidth / e.parentElement.offsetWidth")
    assert share == pytest.approx(2.75 / 6, abs=0.02)


def test_an_mv_is_taken_out_of_use_and_stays(page: Page, steered: Steered) -> None:
    loop, _ = steered
    change(page, "u1", use="0")
    stands = page.locator('[data-operated="u1"] .stands')
    expect(stands).to_be_visible()
    assert stands.get_attribute("data-level") == ""  # somebody wanted it: no colour
    assert value(loop, "u1.use") == 0.0
    place = len(loop.commands)
    loop.does("sp", {"y0": 0.4})
    assert within(20, lambda: len(loop.commands) > place + 5)
    moved = [c.mv.tolist() for c in loop.commands[place:]]
    assert len({mv[1] for mv in moved}) == 1
    assert len({mv[0] for mv in moved}) > 1
    change(page, "u1", use="1")
    expect(stands).to_be_hidden()


def test_a_refused_value_is_told_beside_its_entry_and_changes_nothing(page: Page, steered: Steered) -> None:
    loop, _ = steered
    before = value(loop, "y0.low"), value(loop, "y0.cost")
    change(page, "y0", low="7", cost="2")
    low = page.locator('[data-field="y0.low"]')
    line = page.locator('[id="wrong-y0.low"]')
    expect(line).to_contain_text("y0.low is 7")
    expect(low).to_have_attribute("aria-invalid", "true")
    expect(low).to_have_attribute("aria-describedby", "wrong-y0.low")
    expect(low).to_be_focused()
    expect(page.locator("#refusal")).to_contain_text("y0.low")
    expect(page.locator('[id="wrong-y0.cost"]')).to_be_empty()
    assert (value(loop, "y0.low"), value(loop, "y0.cost")) == before
    low.fill("-2")
    page.click("#confirm")
    expect(page.locator("#dialog")).to_be_hidden()
    assert (value(loop, "y0.low"), value(loop, "y0.cost")) == (-2.0, 2.0)


def test_a_pv_that_is_left_out_is_told_in_colour_with_a_sign_and_why(page: Page, steered: Steered) -> None:
    _, plant = steered
    stands = page.locator('[data-operated="y1"] .stands')
    plant.bad = ("", "BadSensorFailure")
    expect(stands).to_contain_text("BadSensorFailure")
    expect(stands).to_have_attribute("data-level", "alarm")  # bridged for four periods, then left out
    expect(stands).to_contain_text("▲")
    expect(fact(page, "y1", "reading")).to_contain_text("ago")
    plant.bad = ()
    expect(stands).to_be_hidden()
    expect(fact(page, "y1", "reading")).not_to_contain_text("ago")


def test_a_limit_that_binds_is_marked_and_one_that_does_not_is_not(page: Page, steered: Steered) -> None:
    loop, _ = steered
    stands = page.locator('[data-operated="u0"] .stands')
    expect(stands).to_be_hidden()
    loop.does("operate", {"u0.high": 0.95})  # narrower than the engineered end, and not reached
    expect(stands).to_be_hidden()
    loop.does("operate", {"u0.high": max(-0.99, float(loop.commands[-1].mv[0]) - 0.05)})
    expect(stands).to_have_attribute("data-level", "watch")
    loop.does("operate", {"u0.low": -1.0, "u0.high": 1.0})
    loop.does("sp", {"y0": 0.0})
    expect(stands).to_be_hidden()


def test_all_of_it_goes_by_keyboard_alone(page: Page, steered: Steered) -> None:
    loop, _ = steered
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.dataset.change") == "u0":
            break
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.dataset.field") == "u0.use"
    for _ in range(20):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.dataset.field") == "u0.max_move":
            break
    page.keyboard.press("Control+a")
    page.keyboard.type("0.5")
    page.keyboard.press("Enter")
    expect(page.locator("#dialog")).to_be_hidden()
    assert value(loop, "u0.max_move") == 0.5
    assert page.evaluate("document.activeElement.dataset.change") == "u0"  # where the operator was


def test_every_faceplate_and_field_has_a_name_for_a_screen_reader(page: Page) -> None:
    for signal in ("y0", "u0", "law"):
        button = page.locator(f'[data-change="{signal}"]')
        assert button.get_attribute("aria-label") != button.text_content()
        button.click()
        for field in page.locator("#dialog-fields [data-field]").all():
            words = field.evaluate("e => e.labels[0].textContent")
            assert re.search(r"\w{3,}", str(words))
        page.keyboard.press("Escape")
    assert page.get_by_role("group", name="y0").count() == 1


def test_a_law_that_takes_no_course_has_no_part_for_it(page: Page) -> None:
    expect(page.locator("#courses")).to_be_hidden()
    expect(page.locator('[data-chart="y0"]')).to_have_attribute("data-course", "0")


def test_speed_and_caution_of_the_whole_law(page: Page, steered: Steered) -> None:
    loop, _ = steered
    page.click('[data-change="law"]')
    page.fill('[data-field="speed"]', "2")
    page.fill('[data-field="caution"]', "0.5")
    page.click("#confirm")
    expect(fact(page, "law", "speed")).to_have_text("× 2")
    assert (value(loop, "speed"), value(loop, "caution")) == (2.0, 0.5)
    loop.does("operate", {"speed": 1.0, "caution": 1.0})


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_shows_and_changes_it_without_scrolling_sideways(
    browser: Browser, steered: Steered, scheme: Any
) -> None:
    loop, _ = steered
    how: dict[str, Any] = {"viewport": {"width": 360, "height": 780}, "has_touch": True, "is_mobile": True}
    phone = come_in(browser, loop, color_scheme=scheme, **how)
    assert phone.evaluate("document.scrollingElement.scrollWidth") <= 360
    phone.locator('[data-change="u0"]').tap()
    dialog = phone.locator("#dialog")
    expect(dialog).to_be_visible()
    assert dialog.evaluate("e => e.scrollWidth <= e.clientWidth + 1 && e.offsetWidth <= 360")
    phone.fill('[data-field="u0.cost"]', "1.5" if scheme == "light" else "0.5")
    phone.locator("#confirm").tap()
    expect(dialog).to_be_hidden()
    assert value(loop, "u0.cost") == (1.5 if scheme == "light" else 0.5)
    phone.close()


# ------------------------------------------------------------------------------------------------ why, and what if
def test_what_the_law_predicts_is_drawn_right_of_now_and_said(page: Page) -> None:
    for signal, points in (("y0", r"[1-9]\d*"), ("u1", r"[1-9]\d*"), ("d0", "0")):
        expect(page.locator(f'[data-chart="{signal}"]')).to_have_attribute("data-ahead", re.compile(f"^{points}$"))
    expect(fact(page, "y0", "expected")).to_contain_text(" in 20 s")
    expect(fact(page, "u0", "why")).to_contain_text(re.compile(r"stands|%"))
    expect(fact(page, "law", "missing")).to_be_hidden()
    page.click("#earlier")  # what is past has no prediction beside it
    expect(page.locator('[data-chart="y0"]')).to_have_attribute("data-ahead", "0")


def test_a_law_that_moves_nothing_predicts_nothing(page: Page, steered: Steered) -> None:
    loop, _ = steered
    expect(fact(page, "y0", "expected")).to_be_visible()
    loop.does("mode", "MANUAL")
    expect(fact(page, "y0", "expected")).to_be_hidden()
    expect(fact(page, "u0", "why")).to_be_hidden()
    expect(page.locator('[data-chart="y0"]')).to_have_attribute("data-ahead", "0")
    loop.does("mode", "AUTO")
    expect(fact(page, "y0", "expected")).to_be_visible()


def test_a_change_is_looked_at_before_it_is_set(page: Page, steered: Steered) -> None:
    loop, _ = steered
    events = loop.events()
    page.click("#change-sp")
    page.fill('[data-field="y0"]', "1.5")
    rows = page.locator("#dialog-foreseen tbody tr")
    expect(rows).to_have_count(4)
    *ends, between = rows.nth(2).locator("td").all_text_contents()
    now, changed = (float(text.split(" ")[0]) for text in ends)
    low, high = map(float, between.split(" … "))
    assert rows.nth(2).locator("th").text_content() == "y0"
    assert abs(changed - 1.5) < abs(now - 1.5)
    assert low <= changed <= high
    page.click("#cancel")
    page.click('[data-change="y0"]')
    page.fill('[data-field="y0.high"]', "-9")
    expect(page.locator('[id="wrong-y0.high"]')).to_contain_text("y0.high")  # before anybody confirms it
    page.click("#cancel")
    assert loop.events() == events
