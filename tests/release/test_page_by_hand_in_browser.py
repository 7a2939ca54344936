"""One MV by hand from the page, what is left out, and what the page says of it, in a real browser; also on a phone."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from chromium import CHROMIUM
from faceplate_steps import Steered, change, come_in, fact, value
from processes import within

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)

from playwright.sync_api import Browser, Page, expect

pytest_plugins = ["faceplates_in_chromium"]
PHONE: dict[str, Any] = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}


@pytest.fixture
def phone(browser: Browser, steered: Steered) -> Iterator[Page]:
    made = come_in(browser, steered[0], **PHONE)
    yield made
    made.close()


def test_an_mv_is_taken_in_hand_put_to_a_value_and_given_back(page: Page, steered: Steered) -> None:
    loop, _ = steered
    stands = page.locator('[data-operated="u1"] .stands')
    back = page.locator('[data-back="u1"]')
    before = len(loop.changes("u1 taken out"))
    expect(back).to_be_hidden()
    page.click('[data-by-hand="u1"]')
    page.fill('[data-field="u1"]', "0.35")
    expect(page.locator("#dialog-foreseen tbody tr")).to_have_count(4)  # what the others would do
    page.click("#confirm")
    expect(page.locator("#dialog")).to_be_hidden()
    expect(stands).to_contain_text("0.350")
    assert stands.get_attribute("data-level") == ""  # somebody wanted it: no colour
    expect(page.locator('#left-out [data-out="u1"]')).to_be_visible()
    assert value(loop, "u1.use") == 0.0
    assert within(20, lambda: float(loop.commands[-1].mv[1]) == 0.35)
    assert loop.commands[-1].mode.value == "AUTO"
    assert len(loop.changes("u1 taken out")) == before + 1
    place = len(loop.commands)
    back.click()
    page.click("#confirm")
    expect(back).to_be_hidden()
    expect(page.locator("#left-out")).to_be_hidden()
    assert value(loop, "u1.use") == 1.0
    assert within(20, lambda: len(loop.commands) > place + 3)
    first = next(c for c in loop.commands[place:] if c.mv[1] != 0.35 or c is loop.commands[-1])
    assert abs(first.mv[1] - 0.35) < 0.7  # it goes on from there, and not from where it was


def test_a_value_out_of_range_is_told_beside_its_field(page: Page, steered: Steered) -> None:
    loop, _ = steered
    page.click('[data-by-hand="u0"]')
    page.fill('[data-field="u0"]', "7")
    page.click("#confirm")
    expect(page.locator("#wrong-u0")).to_contain_text("7")
    page.click("#cancel")
    assert value(loop, "u0.use") == 1.0


def test_by_hand_is_offered_where_the_law_moves_and_where_it_can_do_without(page: Page, steered: Steered) -> None:
    loop, _ = steered
    button = page.locator('[data-by-hand="u0"]')
    expect(button).to_be_visible()
    expect(page.locator('[data-by-hand="y0"]')).to_have_count(0)
    loop.does("mode", "MANUAL")  # all of them are by hand there, by the button below
    expect(button).to_be_hidden()
    loop.does("mode", "AUTO")
    expect(button).to_be_visible()


def test_the_weight_of_a_set_point_is_in_its_dialog(page: Page, steered: Steered) -> None:
    loop, _ = steered
    change(page, "y0", weight="4")
    expect(page.locator("#dialog")).to_be_hidden()
    assert value(loop, "y0.weight") == 4.0
    expect(fact(page, "y0", "track")).to_contain_text("× 4")
    loop.does("operate", {"y0.weight": 1.0})
    expect(fact(page, "y0", "track")).not_to_contain_text("×")


def test_a_cost_and_a_largest_move_say_of_which_time_they_are(page: Page, steered: Steered) -> None:
    loop, _ = steered
    loop.does("operate", {"u0.cost": 2.0})
    expect(fact(page, "u0", "cost")).to_have_text(re.compile(r"^2 per V .*\(1 s\)"))
    expect(fact(page, "u0", "max_move")).to_contain_text("1 s")
    page.click('[data-change="u0"]')
    for what in ("cost", "max_move"):
        label = page.locator(f'[data-field="u0.{what}"]').evaluate("e => e.labels[0].textContent")
        assert "1 s" in str(label)
    page.fill('[data-field="u0.cost"]', "3")
    moves = page.locator("#dialog-moves")
    expect(moves).to_contain_text("2 → 3")
    expect(moves).not_to_contain_text("u0.cost")  # no name of a program
    expect(page.locator("#dialog-foreseen [data-note]").last).to_contain_text("cost")
    page.click("#cancel")
    loop.does("operate", {"u0.cost": 0.0})


def test_a_variable_that_is_taken_out_is_said_to_be_held_by_nothing(page: Page, steered: Steered) -> None:
    loop, _ = steered
    page.click('[data-change="y0"]')
    page.select_option('[data-field="y0.use"]', "0")
    page.fill('[data-field="y0.low"]', "2.5")  # it is below that, and nothing brings it there
    note = page.locator("#dialog-foreseen [data-note]").first
    expect(note).to_contain_text("y0")
    expect(note).to_contain_text("▲")
    page.click("#confirm")
    stands = page.locator('[data-operated="y0"] .stands')
    expect(stands).to_have_attribute("data-level", "watch")
    expect(page.locator('#left-out [data-out="y0"]')).to_be_visible()
    expect(page.locator("#alarm-list .alarm.active", has_text="y0")).to_be_visible()
    loop.does("operate", {"y0.use": 1.0, "y0.low": -3.0})
    expect(page.locator('#left-out [data-out="y0"]')).to_have_count(0)
    expect(page.locator("#alarm-list .alarm.active", has_text="y0")).to_have_count(0)


def test_an_mv_that_goes_to_its_rest_is_named_where_nothing_holds_the_variable(page: Page, steered: Steered) -> None:
    """A level that is left out drifts while its outlet goes to where it rests."""
    loop, _ = steered
    loop.does("operate", {"u1.rest": 0.9, "u1.rest_use": 1.0})
    expect(fact(page, "u1", "rest")).to_contain_text("0.9")
    page.click('[data-change="y1"]')
    page.select_option('[data-field="y1.use"]', "0")
    expect(page.locator("#dialog-foreseen [data-note]").first).to_contain_text("y1")
    note = page.locator("#dialog-foreseen [data-note]").filter(has_text="u1 goes to its resting value")
    expect(note).to_contain_text("y1")
    page.select_option('[data-field="y1.use"]', "1")
    expect(note).to_have_count(0)
    page.click("#cancel")
    loop.does("operate", {"u1.rest_use": 0.0})


def test_what_happened_names_no_program(page: Page) -> None:
    expect(page.locator("#events")).to_contain_text("the settings")
    for name in ("loop.toml", "opcua"):
        expect(page.locator("#events .who").filter(has_text=name)).to_have_count(0)


def test_a_sensor_that_is_lost_is_in_the_list_and_an_alarm(page: Page, steered: Steered) -> None:
    _, plant = steered
    plant.bad = ("", "BadSensorFailure")
    expect(page.locator('#left-out [data-out="y1"]')).to_contain_text("BadSensorFailure")
    expect(page.locator("#alarm-list .alarm.active", has_text="y1")).to_be_visible()
    plant.bad = ()
    expect(page.locator('#left-out [data-out="y1"]')).to_have_count(0)


def test_the_bars_are_explained(page: Page) -> None:
    legend = page.locator("#legend")
    expect(legend).to_be_visible()
    expect(legend.locator(".key")).to_have_count(3)


@pytest.mark.parametrize("menu", ["#choice", "#help"])
def test_an_open_menu_fits_a_phone(phone: Page, menu: str) -> None:
    phone.locator(f"{menu} summary").tap()
    box = phone.locator(f"{menu} > :last-child")
    expect(box).to_be_visible()
    assert phone.evaluate("document.scrollingElement.scrollWidth") <= 390
    left, right = box.evaluate("e => [e.getBoundingClientRect().left, e.getBoundingClientRect().right]")
    assert left >= 0
    assert right <= 390


def test_the_word_beside_a_prediction_is_whole_on_a_phone(phone: Page) -> None:
    chart = phone.locator('[data-chart="y0"]')
    expect(chart).to_have_attribute("data-ahead", re.compile("[1-9]"))
    assert int(str(chart.get_attribute("data-word-room"))) >= 0


def test_a_phone_takes_an_mv_in_hand(phone: Page, steered: Steered) -> None:
    loop, _ = steered
    phone.locator('[data-by-hand="u0"]').tap()
    phone.fill('[data-field="u0"]', "0.1")
    dialog = phone.locator("#dialog")
    expect(phone.locator("#dialog-foreseen tbody tr")).to_have_count(4)
    assert dialog.evaluate("e => e.scrollWidth <= e.clientWidth + 1 && e.offsetWidth <= 390")
    phone.locator("#confirm").tap()
    expect(dialog).to_be_hidden()
    assert within(20, lambda: float(loop.commands[-1].mv[0]) == 0.1)
    loop.does("operate", {"u0.use": 1.0})
