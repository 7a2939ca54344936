"""The operator's page by keyboard, by fingers, for a screen reader, and with little motion."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from math import inf
from typing import Any
from urllib.parse import parse_qs, urlsplit
from zoneinfo import ZoneInfo

import pytest
from chromium import CHROMIUM, come_in
from fake_loop import BEGIN, FakeLoop

from loopwright.serving.journal import EventEntry
from loopwright.serving.monitor.verdicts import when

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)

from playwright.sync_api import Browser, CDPSession, Page, Request, expect

pytest_plugins = ["small_laws", "page_in_chromium"]


def times(request: Request) -> tuple[float, float]:
    """The time that a trend was asked for."""
    asked = parse_qs(urlsplit(request.url).query)
    return float(asked["from"][0]), float(asked["to"][0])


def pressed(page: Page, *keys: str) -> tuple[float, float]:
    """The time that the trends show after some keys."""
    with page.expect_request("**/api/trend*") as asked:
        for key in keys:
            page.keyboard.press(key)
    return times(asked.value)


def test_the_trends_go_through_time_by_keyboard(page: Page, loop: FakeLoop) -> None:
    shown, follow, back = page.locator("#time-shown"), page.locator("#follow"), page.locator("#to-live")
    page.focus("#charts")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    expect(shown).to_have_text("the last 5 min")
    from_s, to_s = pressed(page, "+")
    assert to_s - from_s == pytest.approx(150, rel=0, abs=0.01)
    expect(follow).to_have_text("Live")  # closer, about now
    assert pressed(page, "ArrowLeft") == pytest.approx((from_s - 30, to_s - 30), rel=0, abs=0.01)
    expect(follow).to_have_text("Paused")
    expect(back).to_be_visible()
    expect(shown).to_contain_text(" to ")
    assert pressed(page, "Shift+ArrowLeft") == pytest.approx((from_s - 180, to_s - 180), rel=0, abs=0.01)
    assert pressed(page, "-") == pytest.approx((from_s - 255, to_s - 105), rel=0, abs=0.01)
    for live in ("End", "Home"):
        assert pressed(page, live)[1] == pytest.approx(to_s, rel=0, abs=0.01)
        expect(follow).to_have_text("Live")
        expect(back).to_be_hidden()
        pressed(page, "ArrowLeft")
    assert pressed(page, "ArrowRight")[1] == pytest.approx(to_s, rel=0, abs=0.01)  # what reaches now is live
    expect(follow).to_have_text("Live")
    top = page.evaluate("scrollY")
    page.keyboard.press("PageDown")
    page.wait_for_function("top => scrollY > top", arg=top)  # the page is scrolled as ever


def test_values_are_read_scan_by_scan_by_keyboard(page: Page, loop: FakeLoop) -> None:
    page.focus("#charts")
    read = page.locator("#time-shown")
    page.keyboard.press(",")
    expect(read).to_contain_text(re.compile(r"^.*\d\d:\d\d:\d\d: a .*; b .*; u "))
    first = read.text_content()
    page.keyboard.press(",")
    expect(read).not_to_have_text(str(first))
    page.keyboard.press(".")
    expect(read).to_have_text(str(first))


def test_buttons_go_through_time_too_and_one_that_is_always_in_sight_goes_back(page: Page, loop: FakeLoop) -> None:
    for name, width in (("Wider", 600), ("Closer", 300)):
        with page.expect_request("**/api/trend*") as asked:
            page.get_by_role("button", name=name).click()
        from_s, to_s = times(asked.value)
        assert to_s - from_s == pytest.approx(width)
    page.get_by_role("button", name="Earlier").click()
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    back = page.get_by_role("button", name="Paused: back to live")
    expect(back).to_be_in_viewport()
    back.click()
    expect(back).to_be_hidden()
    assert page.evaluate("document.activeElement.id") == "charts"


@pytest.fixture
def phone(browser: Browser, loop: FakeLoop, served: tuple[FakeLoop, str, str]) -> Iterator[Page]:
    made = come_in(browser, served, viewport={"width": 360, "height": 780}, has_touch=True, is_mobile=True)
    yield made
    made.close()


def touch(wire: CDPSession, kind: str, *points: tuple[float, float]) -> None:
    fingers = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
    wire.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})


def test_fingers_move_the_trends_sideways_and_the_page_up_and_down(phone: Page) -> None:
    chart = phone.locator('[data-chart="a"] .u-over')
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    assert box is not None
    left, width, y = box["x"], box["width"], box["y"] + 40
    wire = phone.context.new_cdp_session(phone)
    follow = phone.locator("#follow")

    touch(wire, "touchStart", (left + 0.2 * width, y))
    for share in (0.3, 0.4, 0.6):
        touch(wire, "touchMove", (left + share * width, y))
    with phone.expect_request("**/api/trend*") as asked:
        touch(wire, "touchEnd")
    expect(follow).to_have_text("Paused")
    from_s, to_s = times(asked.value)
    assert to_s - from_s == pytest.approx(300)
    assert BEGIN + 100 - to_s == pytest.approx(0.4 * 300, rel=0.05)

    touch(wire, "touchStart", (left + 0.4 * width, y), (left + 0.6 * width, y))
    for share in (0.05, 0.1):
        touch(wire, "touchMove", (left + (0.4 - share) * width, y), (left + (0.6 + share) * width, y))
    with phone.expect_request("**/api/trend*") as asked:
        touch(wire, "touchEnd")
    closer, further = times(asked.value)
    assert further - closer == pytest.approx(150, rel=0.05)
    assert (closer + further) / 2 == pytest.approx((from_s + to_s) / 2, abs=10)  # what was between the fingers stays

    phone.locator("#to-live").tap()
    expect(follow).to_have_text("Live")
    phone.evaluate("scrollTo(0, 0)")
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    assert box is not None
    top, x, y = phone.evaluate("scrollY"), box["x"] + 0.5 * box["width"], box["y"] + 60
    touch(wire, "touchStart", (x, y))
    for up in (20, 60, 120, 180):
        touch(wire, "touchMove", (x, y - up))
    touch(wire, "touchEnd")
    phone.wait_for_function("top => scrollY > top + 50", arg=top)
    expect(follow).to_have_text("Live")
    assert phone.evaluate("document.scrollingElement.scrollWidth") <= 360


def test_a_time_without_scans_is_marked_as_no_record(page: Page) -> None:
    """Before the journal began, and in a pause: what the operator sees there is no plant at rest."""
    found = page.evaluate("""async () => {
        const { stretches } = await import('/static/bands.js');
        const record = { time: [10, 11, 12, 50, 51], from: 0, to: 100, longest: 5,
                         modes: [[10, 'AUTO'], [12, ''], [50, 'HOLD']] };
        return [stretches(record), stretches({ ...record, time: [], modes: [] })];
    }""")
    assert [(from_s, to_s, mode) for from_s, to_s, mode in found[0]] == [
        (0, 10, ""), (10, 12, "AUTO"), (12, 50, ""), (50, 51, "HOLD"), (51, inf, ""),
    ]  # fmt: skip
    assert found[1] == [[0, 100, ""]]
    # And so it is drawn: the first of five minutes are before the journal.
    page.wait_for_function("""() => {
        const canvas = document.querySelector('[data-chart="a"] canvas');
        const { data } = canvas.getContext('2d').getImageData(canvas.width * 0.4, canvas.height * 0.4, 1, 30);
        const hex = getComputedStyle(document.documentElement).getPropertyValue('--band-none').trim();
        const wanted = [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
        return [...Array(30).keys()].some((k) => wanted.every((v, i) => v === data[4 * k + i]));
    }""")


# ---------------------------------------------------------------- who cannot use a mouse, or sees nothing
OPERATED = {"button", "checkbox", "combobox", "link", "spinbutton", "textbox", "DisclosureTriangle", "application"}
NAMED = OPERATED | {"dialog", "image", "region", "group", "list", "progressbar"}


def nameless(page: Page) -> list[dict[str, Any]]:
    """What a screen reader would meet without a name."""
    wire = page.context.new_cdp_session(page)
    nodes = wire.send("Accessibility.getFullAXTree")["nodes"]
    wire.detach()
    met = [n for n in nodes if not n["ignored"] and n["role"]["value"] in NAMED]
    assert len(met) > 5
    return [n for n in met if not n.get("name", {}).get("value", "").strip() and wants_a_name(n)]


def wants_a_name(node: dict[str, Any]) -> bool:
    focusable = any(p["name"] == "focusable" and p["value"]["value"] for p in node.get("properties", []))
    return node["role"]["value"] not in {"group", "list"} or focusable


def test_all_that_is_operated_has_a_name_for_a_screen_reader(page: Page, loop: FakeLoop) -> None:
    loop.state["successor"] = {"law": "o", "file": "o.onnx", "sha256": "b" * 64, "good": 3, "trial": 60, "reason": ""}
    expect(page.locator("#trial progress")).to_be_visible()
    for details in page.locator("details:visible > summary").all():
        details.click()
    assert nameless(page) == []
    page.keyboard.press("Escape")
    page.click("#change-sp")
    assert nameless(page) == []


REACHED = """() => {
  const here = document.activeElement;
  here.dataset.reached = 'yes';
  return here === document.body;
}"""
MISSED = """() => [...document.querySelectorAll('button, input, select, summary, a[href], [tabindex="0"]')]
  .filter((e) => !e.disabled && e.checkVisibility() && !e.dataset.reached)
  .map((e) => e.outerHTML.slice(0, 120))"""


def test_all_that_is_operated_is_reached_by_the_tab_key(page: Page, loop: FakeLoop) -> None:
    expect(page.locator("#change-sp")).to_be_enabled()
    for _ in range(80):
        page.keyboard.press("Tab")
        if page.evaluate(REACHED):
            break  # after the last one
    assert page.evaluate(MISSED) == []


def test_the_menu_of_signals_opens_and_closes_by_keyboard(page: Page, loop: FakeLoop) -> None:
    page.focus("#choice summary")
    page.keyboard.press("Enter")
    expect(page.locator("#shown")).to_be_visible()
    page.keyboard.press("Tab")
    page.keyboard.press("Space")
    expect(page.locator('[data-chart="a"]')).to_have_count(0)
    page.keyboard.press("Escape")
    expect(page.locator("#shown")).to_be_hidden()
    assert page.evaluate("document.activeElement.localName") == "summary"


SAID = """() => {
  window.said = [];
  const live = [...document.querySelectorAll('[aria-live], [role=status], [role=alert], output')];
  for (const region of live)
    new MutationObserver(() => window.said.push(`${region.id}: ${region.textContent}`))
      .observe(region, { childList: true, characterData: true, subtree: true });
  return live.length;
}"""


def test_a_screen_reader_hears_of_changes_and_not_of_scans(page: Page, loop: FakeLoop) -> None:
    assert page.evaluate(SAID) >= 5
    for value in (0.51, 0.52, 0.53):
        loop.state["pv"] = [value, 0.4]
        loop.add(1)
        expect(page.locator('[data-signal="PV a"] .number')).to_have_text(f"{value:.3f}")
    assert page.evaluate("window.said") == []
    loop.state.update(mode="HOLD", reason="the sample is 1 s old")
    expect(page.locator("#mode")).to_have_text("HOLD")
    for age in (2, 3):  # worded anew at each scan
        loop.state["reason"] = f"the sample is {age} s old"
        expect(page.locator("#reason")).to_contain_text(f"the sample is {age} s old")
    assert page.evaluate("window.said") == ["spoken: HOLD: the sample is 1 s old"]


def test_nothing_moves_for_who_wants_little_motion(page: Page, loop: FakeLoop) -> None:
    motion = "getComputedStyle(document.querySelector('.bar .fill')).transitionDuration"
    expect(page.locator(".bar .fill").first).to_be_attached()
    page.emulate_media(reduced_motion="no-preference")
    assert page.evaluate(motion) != "0s"
    page.emulate_media(reduced_motion="reduce")
    assert page.evaluate(motion) == "0s"


def test_values_are_filled_in_place(page: Page, loop: FakeLoop) -> None:
    """So that a screen reader that is at a value is not thrown out of it at each scan."""
    page.evaluate("window.first = document.querySelector('[data-signal=\"PV a\"]')")
    loop.state["pv"] = [0.61, 0.4]
    expect(page.locator('[data-signal="PV a"] .number')).to_have_text("0.610")
    assert page.evaluate("window.first.isConnected")


def test_what_is_read_by_keyboard_stays_while_scans_come_in(page: Page, loop: FakeLoop) -> None:
    page.focus("#charts")
    read = page.locator("#time-shown")
    under_cursor = page.locator('[data-chart="a"] .u-series').first.locator(".u-value")

    def scans() -> None:
        chart = page.locator('[data-chart="a"]')
        rows = int(chart.get_attribute("data-rows") or 0)  # tests before this one share the journal
        loop.add(1)
        expect(chart).to_have_attribute("data-rows", str(rows + 1))

    expect(page.locator('[data-chart="a"]')).to_have_attribute("data-rows", re.compile(r"\d"))  # it is drawn
    said = list[str]()
    for _ in range(4):
        page.keyboard.press(",")
        expect(read).not_to_have_text(said[-1] if said else "")  # the page may answer late
        said.append(str(read.text_content()))
        scans()
        expect(read).to_have_text(said[-1])
        expect(under_cursor).to_have_text(said[-1].split(": ")[0])
    seconds = [text.split(": ")[0] for text in said]
    moments = [re.findall(r"(\d\d):(\d\d):(\d\d)$", text)[0] for text in seconds]
    at = [3600 * int(h) + 60 * int(m) + int(s) for h, m, s in moments]
    assert [one - other for one, other in pairwise(at)] == [1, 1, 1]
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("End")
    page.keyboard.press(",")  # another view: from its newest scan
    expect(read).to_contain_text(re.compile(rf"{clock(BEGIN + loop.scans - 1)}: a "))


def clock(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%H:%M:%S")


def test_every_time_on_the_page_is_in_the_zone_of_its_clock(
    browser: Browser, loop: FakeLoop, served: tuple[FakeLoop, str, str]
) -> None:
    since = when(BEGIN)
    verdict = {"name": "u moves", "level": "watch", "text": f"u is at its end since {since}, and the error stays"}
    loop.state["verdicts"] = [verdict]
    loop.writer.event(EventEntry(BEGIN, "monitor", "monitor", f"u moves: watch: {verdict['text']}"))
    there = datetime.fromtimestamp(BEGIN, ZoneInfo("Asia/Kolkata"))
    page = come_in(browser, served, timezone_id="Asia/Kolkata")
    for said in (page.locator("#verdicts .what"), page.locator("#events .what", has_text="u moves")):
        expect(said).to_contain_text(re.compile(rf"since {there:%d} \w+ {there:%H:%M}, and"))
    expect(page.locator("#events time").first).to_contain_text(f"{there:%H:%M}")
    expect(page.locator("body")).not_to_contain_text("UTC")
    assert "GMT+5:30" in str(page.locator("#clock").text_content())
    page.close()


def test_the_card_shows_the_certificate_and_its_grounds_on_demand(
    browser: Browser, loop: FakeLoop, served: tuple[FakeLoop, str, str]
) -> None:
    sentence, ground = "of plants like these at most 1 % fail", "not in the family: sensors that fail"
    card = loop.about["card"]
    loop.about["card"] = {**card, "certificate": {"lines": [sentence, ground], "wrong": ""}}
    page = come_in(browser, served)
    shown = page.locator("#card-body summary", has_text=sentence)
    expect(shown).to_be_visible()
    expect(page.get_by_text(ground)).to_be_hidden()
    shown.click()
    expect(page.get_by_text(ground)).to_be_visible()
    page.close()
    loop.about["card"] = {**card, "certificate": {"lines": ["that of another law"], "wrong": "that of another law"}}
    page = come_in(browser, served)
    expect(page.locator("#card-body")).to_contain_text("NOT TO BE BELIEVED: that of another law")
    page.close()
