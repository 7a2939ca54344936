"""The operator's page in a real browser: from SHADOW to AUTO, a fault, an alarm, another controller.

With LOOPWRIGHT_PICTURES=FOLDER the pictures of docs/ are taken there.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import CHROMIUM, launched
from PIL import Image
from plant_servers import Plant, RunningLoop, spoil
from processes import within

from loopwright.pipeline.__main__ import main

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)

from playwright.sync_api import Browser, Page, expect

ARTIFACTS = Path(__file__).parents[2] / "artifacts" / "thiosulfate_cstr"
PICTURES = os.environ.get("LOOPWRIGHT_PICTURES")
TOKEN = "a token that is long enough"
SPEED = 2.0  # periods of .25 s
PATIENT = re.compile("max_age_s = .*")
WIDE = {"width": 1500, "height": 1000}
expect.set_options(timeout=20_000)


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("plant"), "thiosulfate_cstr", SPEED, "--noise")
    made.start()
    yield made
    made.end()


@pytest.fixture(scope="module")
def loop(plant: Plant, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLoop]:
    folder = tmp_path_factory.mktemp("loop")
    (folder / "figures").mkdir()
    for law in ("pid", "inverse_dob"):
        shutil.copy(ARTIFACTS / f"{law}.onnx", folder)
        shutil.copy(ARTIFACTS / "figures" / f"closed_loop_{law}.png", folder / "figures")
    path = folder / "loop.toml"
    assert main(["loop", "init", str(folder / "pid.onnx"), "--endpoint", plant.endpoint, "--out", str(path)]) == 0
    (folder / "token").write_text(TOKEN)
    text = path.read_text().replace('page = "127.0.0.1:8080"', f"speed = {SPEED}")
    text = PATIENT.sub("max_age_s = 5", text)  # this machine has other work beside it
    path.write_text(text + '\n[page]\nlisten = "127.0.0.1:0"\ntoken_file = "token"\n')
    made = RunningLoop(path)
    yield made
    made.end()


@pytest.fixture(scope="module")
def browser(loop: RunningLoop) -> Iterator[Browser]:
    """After the loop, which is begun by an event loop of its own; the browser keeps one running."""
    with launched() as made:
        yield made


@pytest.fixture
def page(browser: Browser, loop: RunningLoop) -> Iterator[Page]:
    made = browser.new_page(viewport=WIDE, locale="en-GB", timezone_id="UTC")
    said: list[str] = []
    made.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    made.on("pageerror", lambda error: said.append(str(error)))
    assert loop.station.page is not None
    made.goto(loop.station.page.url)
    yield made
    made.close()
    # What the server refuses is shown to the operator; the browser writes it down too.
    assert [text for text in said if "Failed to load resource" not in text] == []


def confirm(page: Page, token: str = TOKEN, why: str = "") -> None:
    page.fill("#who", "anna")
    page.fill("#why", why)
    page.fill("#token", token)
    page.click("#confirm")


def drawn(page: Page) -> int:
    """The scans that the trend of C_A shows."""
    return int(page.locator('[data-chart="C_A"]').get_attribute("data-rows") or 0)


def picture(page: Page, name: str, whole: bool = False) -> None:
    if PICTURES:
        path = Path(PICTURES) / f"{name}.png"
        page.evaluate("scrollTo(0, 0)")
        page.screenshot(path=path, full_page=whole)
        # The page has few colours; so a picture has a third of the bytes.
        with Image.open(path) as taken:
            small = taken.convert("RGB").quantize(96, dither=Image.Dither.NONE)
        small.save(path, optimize=True)


def held_by_a_bad_sensor(page: Page, plant: Plant) -> bool:
    """Whether the page tells so; the loop is back in AUTO where a busy machine had it hold before the sensor did."""
    spoil(plant, "PV.T", "bad")
    expect(page.locator("#mode")).to_have_text("HOLD")
    expect(page.locator("#reason")).to_contain_text("PV T: BadSensorFailure")
    told = "mode AUTO -> HOLD (PV T: BadSensorFailure)"
    if within(3, lambda: told in (page.locator("#events").text_content() or "")):
        return True
    spoil(plant, "PV.T", "")
    expect(page.locator("#mode")).to_have_text("AUTO")
    return False


def test_an_operator_takes_a_loop_from_the_shadow_through_a_fault_to_another_controller(
    page: Page, loop: RunningLoop, plant: Plant
) -> None:
    mode, answer = page.locator("#mode"), page.locator("#answer")
    expect(mode).to_have_text("SHADOW")
    expect(page.locator("#title")).to_have_text("pid for thiosulfate_cstr")
    expect(page.locator('[data-signal="Law\'s MV T_j"]')).to_contain_text("not written")
    expect(page.locator("#banner")).to_be_hidden()
    expect(page.locator("#change-mv")).to_be_disabled()

    page.click("#modes [data-mode=AUTO]")
    expect(page.locator("#dialog-words")).to_contain_text("Set point: C_A")
    confirm(page, token="forged")
    expect(page.locator("#refusal")).to_contain_text("the token is not the loop's")
    expect(mode).to_have_text("SHADOW")
    confirm(page, why="start of the shift")
    expect(answer).to_contain_text("Done: mode SHADOW -> AUTO")  # or that it will be, where the loop is late
    expect(mode).to_have_text("AUTO")

    page.click("#change-sp")
    # There the plant is stable: about .6 it runs away within some lost scans, and other tests run beside this one.
    page.fill('[data-field="C_A"]', "0.95")
    confirm(page)
    expect(page.locator('[data-signal="SP C_A"] .number')).to_have_text("0.950")
    expect(page.locator('[data-signal="PV C_A"] .number')).to_have_text(re.compile(r"0\.9[45]\d"))
    rows = drawn(page)
    assert within(20, lambda: drawn(page) > rows + 10)
    picture(page, "page_auto")

    assert any(held_by_a_bad_sensor(page, plant) for _ in range(5))
    expect(page.locator('[data-signal="PV T"]')).to_contain_text("BadSensorFailure")
    alarm = page.locator("#alarm-list .alarm", has_text="BadSensorFailure").first
    expect(alarm).to_have_attribute("data-level", "active")
    alarm = page.locator(f'#alarm-list [data-id="{alarm.get_attribute("data-id")}"]')  # there may be more of its words
    expect(page).to_have_title(re.compile(r"^\(\d+\) "))
    events = page.locator("#events")
    picture(page, "page_hold")
    spoil(plant, "PV.T", "")
    expect(mode).to_have_text("AUTO")
    expect(events).to_contain_text("mode HOLD -> AUTO")
    assert events.locator("li").first.evaluate("e => e.querySelector('.what').offsetWidth / e.offsetWidth") > 0.95
    expect(alarm).to_have_attribute("data-level", "past-unseen")
    alarm.locator("button").click()
    confirm(page, why="the sensor was cleaned")
    expect(alarm).to_have_attribute("data-level", "past")
    expect(alarm).to_contain_text("seen by anna")

    page.click('[data-file="inverse_dob.onnx"]')
    page.fill('[data-field="trial"]', "20")
    confirm(page)
    expect(page.locator("#trial-words")).to_contain_text("inverse_dob (inverse_dob.onnx) is on trial")
    expect(page.locator('[data-signal="Successor\'s MV T_j"]')).to_be_visible()
    picture(page, "page_trial")
    # After good scans in a row.
    expect(page.locator("#title")).to_have_text("inverse_dob for thiosulfate_cstr", timeout=60_000)
    expect(page.locator("#put-back")).to_be_visible()
    expect(events).to_contain_text("has the plant, after pid")
    assert any("anna: mode SHADOW -> AUTO" in event for event in loop.events())


def test_a_change_out_of_range_is_refused_by_the_loop_in_its_own_words(page: Page) -> None:
    page.click("#change-sp")
    page.locator('[data-field="C_A"]').evaluate("input => { input.removeAttribute('max'); input.value = '7'; }")
    confirm(page)
    expect(page.locator("#refusal")).to_contain_text("the set point C_A = 7.0 mol/l is outside [0, 1] mol/l")
    page.click("#cancel")
    expect(page.locator("#dialog")).to_be_hidden()


def test_it_is_worked_by_keyboard_alone(page: Page) -> None:
    expect(page.locator("#change-sp")).to_be_enabled()
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.id") == "change-sp":
            break
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keyboard.press("Enter")
    expect(page.locator("#dialog")).to_be_visible()
    assert page.evaluate("document.activeElement.dataset.field") == "C_A"
    page.keyboard.press("Escape")
    expect(page.locator("#dialog")).to_be_hidden()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_shows_all_of_it_in_light_and_dark(browser: Browser, loop: RunningLoop, scheme: str) -> None:
    assert loop.station.page is not None
    phone = browser.new_page(viewport={"width": 360, "height": 780}, color_scheme=scheme, locale="en-GB")  # type: ignore[arg-type]
    phone.goto(loop.station.page.url)
    expect(phone.locator("#mode")).not_to_have_text("…")
    expect(phone.locator('[data-chart="C_A"] canvas')).to_be_visible()
    assert phone.evaluate("document.documentElement.dataset.theme") == scheme
    assert phone.evaluate("document.scrollingElement.scrollWidth") <= 360
    # Words are told from their ground: 4.5 to 1, as WCAG AA wants it.
    for name in ("ink", "ink-2", "alarm", "watch"):
        assert phone.evaluate(CONTRAST, [name, "panel"]) >= 4.5, name
    assert phone.evaluate(CONTRAST, ["alarm", "alarm-ground"]) >= 4.5
    assert phone.evaluate(CONTRAST, ["watch", "watch-ground"]) >= 4.5
    picture(phone, f"page_phone_{scheme}")
    phone.close()


CONTRAST = """([ink, ground]) => {
  const light = (name) => {
    const hex = getComputedStyle(document.documentElement).getPropertyValue('--' + name).trim().slice(1);
    const parts = [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
    const [r, g, b] = parts.map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const [a, b] = [light(ink), light(ground)].sort((x, y) => y - x);
  return (a + 0.05) / (b + 0.05);
}"""


def test_a_closer_look_stops_the_trend_and_a_double_click_goes_on(page: Page) -> None:
    chart = page.locator('[data-chart="C_A"] .u-over')
    expect(chart).to_be_visible()
    assert within(20, lambda: drawn(page) > 20)
    expect(page.locator("#follow")).to_have_text("Live")
    box = chart.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 30, steps=4)
    page.mouse.up()
    expect(page.locator("#follow")).to_have_text("Paused")
    chart.dblclick()
    expect(page.locator("#follow")).to_have_text("Live")


def test_without_its_server_the_page_says_that_it_is_old(page: Page, loop: RunningLoop) -> None:
    page.route("**/api/live", lambda route: route.abort())
    page.reload()
    expect(page.locator("#banner")).to_contain_text("what you see is old")
    expect(page.locator("body")).to_have_class("old")
