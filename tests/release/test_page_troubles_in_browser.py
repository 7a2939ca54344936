"""The operator's page when something goes wrong between it and the loop: nothing is lost, and nothing else is moved."""

from __future__ import annotations

import json

import pytest
from chromium import CHROMIUM
from fake_loop import BEGIN, THIRDS, FakeLoop

from loopwright.serving.journal import EventEntry, ScanEntry

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)

from playwright.sync_api import Page, Route, expect

pytest_plugins = ["small_laws", "page_in_chromium"]

TOKEN_FIELD = "#token"
SUCCESSOR = {"law": "other", "file": "other.onnx", "sha256": "b" * 64, "good": 3, "trial": 60, "reason": ""}


def ask_mode(page: Page, mode: str) -> None:
    page.click(f"#modes [data-mode={mode}]")
    page.click("#confirm")


def test_only_the_set_point_that_was_changed_is_sent(page: Page, loop: FakeLoop) -> None:
    page.click("#change-sp")
    page.click("#confirm")
    expect(page.locator("#refusal")).to_have_text("No value is changed yet.")
    page.fill('[data-field="a"]', "0.7")
    expect(page.locator("#dialog-moves")).to_have_text("a 0.612 → 0.7 K")
    page.click("#confirm")
    expect(page.locator("#answer")).to_have_text("Done: well")
    assert [change["value"] for change in loop.changes] == [{"a": 0.7}]


def test_the_value_that_is_shown_can_be_confirmed_as_it_is(page: Page, loop: FakeLoop) -> None:
    page.click("#change-sp")
    page.fill('[data-field="a"]', "")
    page.fill('[data-field="a"]', "0.612")  # as shown; the set point is 0.6123456
    page.click("#confirm")
    expect(page.locator("#answer")).to_have_text("Done: well")
    assert [change["value"] for change in loop.changes] == [{"a": 0.612}]


def test_a_discrete_mv_is_offered_where_it_is_and_sent_to_the_last_digit(page: Page, loop: FakeLoop) -> None:
    loop.state["mode"] = "MANUAL"
    expect(page.locator("#change-mv")).to_be_enabled()
    page.click("#change-mv")
    field = page.locator('[data-field="u"]')
    assert float(field.input_value()) == THIRDS[1]
    field.select_option(index=2)
    field.select_option(index=1)
    page.click("#confirm")
    expect(page.locator("#answer")).to_have_text("Done: well")
    assert [change["value"] for change in loop.changes] == [{"u": THIRDS[1]}]


def test_a_refusal_is_told_after_the_dialog_was_left(page: Page) -> None:
    waiting: list[Route] = []
    page.route("**/api/change", lambda route: waiting.append(route))
    with page.expect_request("**/api/change"):
        ask_mode(page, "MANUAL")
    page.click("#cancel")
    page.click("#modes [data-mode=HOLD]")
    waiting[0].fulfill(status=409, json={"error": "the loop is busy"})
    expect(page.locator("#answer")).to_have_text("Not done: the loop is busy")
    expect(page.locator("#dialog-title")).to_have_text("AUTO → HOLD")
    expect(page.locator("#refusal")).to_have_text("")
    expect(page.locator("#confirm")).to_be_enabled()


def test_a_controller_that_is_not_proven_needs_a_second_word(page: Page, loop: FakeLoop) -> None:
    loop.unproven = "pid: its file holds no evidence of closed loops"
    ask_mode(page, "AUTO")
    expect(page.locator("#refusal")).to_contain_text(loop.unproven)
    expect(page.locator("#confirm")).to_have_text("Accept, though not proven")
    page.click("#cancel")
    page.click("#modes [data-mode=AUTO]")  # the word is not kept for another change
    expect(page.locator("#confirm")).to_have_text("Confirm")
    page.click("#confirm")
    page.click("#confirm:has-text('Accept')")
    expect(page.locator("#answer")).to_have_text("Done: well")
    assert [change.get("accept_unproven") for change in loop.changes] == [None, None, True]


def test_a_lost_answer_is_not_called_a_refusal(page: Page) -> None:
    page.route("**/api/change", lambda route: route.abort())
    ask_mode(page, "MANUAL")
    expect(page.locator("#refusal")).to_contain_text("It may have been done or not")


def test_a_token_that_was_refused_is_not_kept(page: Page) -> None:
    page.evaluate("sessionStorage.removeItem('token')")
    page.click("#modes [data-mode=MANUAL]")
    page.fill(TOKEN_FIELD, "forged")
    page.click("#confirm")
    expect(page.locator("#refusal")).to_contain_text("the token is not the loop's")
    assert page.evaluate("sessionStorage.getItem('token')") is None
    assert page.evaluate("document.activeElement.id") == "token"


def test_the_same_successor_is_shown_each_time_that_it_is_tried(page: Page, loop: FakeLoop) -> None:
    words = page.locator("#trial-words")
    for successor in (SUCCESSOR, None, SUCCESSOR):
        loop.state["successor"] = successor
        expect(words).to_have_count(0 if successor is None else 1)
    expect(words).to_contain_text("3 of 60 good scans")


def test_the_focus_stays_on_its_alarm_while_news_come_in(page: Page, loop: FakeLoop) -> None:
    page.locator("#alarm-list button").first.focus()
    held = "document.activeElement.closest('[data-id]')?.dataset.id"
    before = page.evaluate(held)
    count = page.locator("#alarm-list .alarm").count()
    loop.writer.event(EventEntry(BEGIN + 90, "alarm", "loop", "another", alarm="other", raised=True))
    expect(page.locator("#alarm-list .alarm")).to_have_count(count + 1)
    assert before is not None
    assert page.evaluate(held) == before


def test_each_alarm_that_is_over_is_shown_as_over(page: Page, loop: FakeLoop) -> None:
    def stand(level: str) -> list[str]:
        return page.locator(f'#alarm-list [data-level="{level}"] .what').all_text_contents()

    for name in ("first", "second", "third"):
        at = page.locator("#alarm-list .alarm", has_text=f"valve {name}")
        loop.writer.event(EventEntry(BEGIN + 91, "alarm", "loop", f"valve {name}", alarm="valve", raised=True))
        expect(at).to_have_attribute("data-level", "active")
        loop.writer.event(EventEntry(BEGIN + 92, "alarm", "loop", "over", alarm="valve"))
        expect(at).to_have_attribute("data-level", "past-unseen")
    assert [what for what in stand("past-unseen") if "valve" in what] == ["valve third", "valve second", "valve first"]
    expect(page.locator("#events")).to_contain_text("the alarm is over")


def test_the_trend_is_asked_for_in_the_loops_time(page: Page, loop: FakeLoop) -> None:
    # The loop's scans lie at BEGIN, and this machine's clock elsewhere.
    expect(page.locator("[data-chart]").first).to_have_attribute("data-rows", str(loop.scans))


def test_the_trend_goes_on_when_the_loops_clock_is_set_back(page: Page, loop: FakeLoop) -> None:
    """To 60 s: the trend ends at the loop's own time again, with the scans from before and after."""
    chart = page.locator("[data-chart]").first
    expect(chart).to_have_attribute("data-rows", str(loop.scans))
    loop.state |= {"time": BEGIN + 60, "reason": "the clock is set"}
    expect(page.locator("#reason")).to_contain_text("the clock is set")
    for k in range(5):
        loop.writer.scan(ScanEntry(BEGIN + 49.5 + k, "AUTO", (0.5,) * loop.columns))
    expect(chart).to_have_attribute("data-rows", str(61 + 5))


def test_the_page_follows_the_systems_light_until_the_operator_chooses(page: Page) -> None:
    root = page.locator("html")
    page.emulate_media(color_scheme="dark")
    expect(root).to_have_attribute("data-theme", "dark")
    page.click("#theme")
    page.emulate_media(color_scheme="light")
    page.emulate_media(color_scheme="dark")
    expect(root).to_have_attribute("data-theme", "light")


def stream(found: dict[str, object]) -> dict[str, object]:
    """An answer that tells the state once and breaks off."""
    return {"content_type": "text/event-stream", "body": f"retry: 100\nevent: state\ndata: {json.dumps(found)}\n\n"}


def test_an_alarm_that_was_raised_while_the_stream_was_broken_is_shown(page: Page, loop: FakeLoop) -> None:
    alarm = {"id": 900, "time": BEGIN, "kind": "alarm", "who": "loop", "what": "unheard", "reason": "", "alarm": True,
             "over": None, "acknowledged": None}  # fmt: skip
    events: list[dict[str, object]] = []
    page.route("**/api/events*", lambda route: route.fulfill(json={"events": events}))
    page.route("**/api/live", lambda route: route.fulfill(**stream(loop.state)))  # type: ignore[arg-type]
    page.reload()
    expect(page.locator("#alarm-list")).to_have_text("none")
    events.append(alarm)
    expect(page.locator("#alarm-list")).to_contain_text("unheard")


def test_an_answer_that_is_no_stream_is_not_the_last_word(page: Page) -> None:
    refused: list[Route] = []
    seen = False  # what the page says meanwhile

    def proxy(route: Route) -> None:
        refused.append(route)
        if len(refused) < 3 or not seen:
            route.fulfill(status=502, content_type="text/html", body="<h1>Bad gateway</h1>")
        else:
            route.continue_()

    page.route("**/api/live", proxy)
    page.reload()
    expect(page.locator("#banner")).to_contain_text("what you see is old")
    seen = True
    expect(page.locator("#banner")).to_be_hidden(timeout=20_000)
    expect(page.locator("body")).not_to_have_class("old")
    assert len(refused) >= 3
