"""Courses on the operator's page, in a real browser: by hand, by a file, refused, drawn, listed and taken back."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from chromium import CHROMIUM
from identified_models import random_model
from operated_page import TOKEN, served
from plant_servers import RunningLoop
from predictive_loops import law_of

from loopwright.pipeline.export.explain_graph import export_explanation
from loopwright.pipeline.export.gate import export

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)

from playwright.sync_api import Browser, Page, expect

pytest_plugins = ["browser_of_tests"]
SOME = re.compile(r"^[1-9]\d*$")
FAR = 3000  # seconds of the loop from now: ten minutes of the clock, longer than these tests


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLoop]:
    """A loop on its own model whose law reads what is to come."""
    folder = tmp_path_factory.mktemp("recipe")
    law = law_of(random_model(3, n_y=2, n_mv=2, n_dv=1), horizon=10, preview="course", operate={})
    export(law, folder / "law.onnx", case="made", provenance={})
    export_explanation(law, folder / "law.onnx")
    made = served(folder / "law.onnx", folder)
    yield made
    made.end()


def come_in(browser: Browser, loop: RunningLoop, **how: Any) -> Page:
    assert loop.station.page is not None
    made = browser.new_page(**{"locale": "en-GB", "timezone_id": "Asia/Tokyo", **how})
    made.add_init_script(f"sessionStorage.setItem('token', '{TOKEN}'); sessionStorage.setItem('who', 'anna')")
    made.goto(loop.station.page.url)
    expect(made.locator("#courses")).to_be_visible()
    expect(made.locator('[data-chart="y0"]')).to_have_attribute("data-rows", SOME)
    return made


@pytest.fixture
def page(browser: Browser, recipe: RunningLoop) -> Iterator[Page]:
    made = come_in(browser, recipe, viewport={"width": 1500, "height": 1200})
    raised: list[str] = []
    made.on("pageerror", lambda error: raised.append(str(error)))
    yield made
    made.close()
    assert raised == []
    if courses(recipe):
        recipe.does("course", None)


def courses(loop: RunningLoop) -> dict[str, Any]:
    assert loop.station.loop is not None
    return loop.station.loop.courses.standing


def confirmed(page: Page) -> None:
    page.click("#confirm")
    expect(page.locator("#dialog")).to_be_hidden()


def test_steps_by_hand_stand_are_drawn_listed_and_taken_back_by_one_button(page: Page, recipe: RunningLoop) -> None:
    expect(page.locator("#course-list")).to_contain_text("none")
    page.click("#course-by-hand")
    page.select_option("#course-signal", "y1")
    page.select_option("#course-times", "s")
    page.fill('[data-field="y1.1"]', "0.5")
    page.locator('[data-what="time"]').first.fill(str(FAR))
    page.click("#course-more")
    page.keyboard.type("0.25")  # the new step's value has the focus
    expect(page.locator("#dialog-moves")).to_contain_text("0.250")
    page.fill("#why", "batch 7")
    confirmed(page)
    course = courses(recipe)["y1"]
    assert course.values.tolist() == [0.5, 0.25]
    assert round(float(course.times_s[1] - course.times_s[0])) == 600  # each further step, until it is changed
    assert (course.straight, course.who) == (False, "anna")
    row = page.locator('[data-course-of="y1"]')
    expect(row).to_contain_text("by anna")
    expect(row).to_contain_text("0.500")
    expect(row).to_contain_text("0.250")
    expect(page.locator('[data-chart="y1"]')).to_have_attribute("data-course", "2")
    expect(page.locator('[data-chart="y0"]')).to_have_attribute("data-course", "0")
    expect(page.locator("#events")).to_contain_text("batch 7")
    page.click("#earlier")  # nothing of what is to come stands beside what is past
    expect(page.locator('[data-chart="y1"]')).to_have_attribute("data-course", "0")
    page.click("#follow")
    row.get_by_role("button", name="End the course of y1").click()
    confirmed(page)
    expect(row).to_have_count(0)
    assert courses(recipe) == {}
    expect(page.locator('[data-chart="y1"]')).to_have_attribute("data-course", "0")
    assert page.evaluate("document.activeElement.closest('section')?.id") == "courses"


def test_a_refused_step_is_told_beside_it_and_nothing_is_changed(page: Page, recipe: RunningLoop) -> None:
    page.click("#course-by-hand")
    page.fill('[data-field="y0.1"]', "0.5")
    page.click("#course-more")
    page.fill('[data-field="y0.2"]', "7")
    page.click("#confirm")
    wrong = page.locator('[data-field="y0.2"]')
    expect(page.locator('[id="wrong-y0.2"]')).to_contain_text("y0")
    expect(wrong).to_have_attribute("aria-invalid", "true")
    expect(wrong).to_have_attribute("aria-describedby", "wrong-y0.2")
    expect(wrong).to_be_focused()
    expect(page.locator('[id="wrong-y0.1"]')).to_be_empty()
    assert courses(recipe) == {}
    page.get_by_role("button", name="Remove step 1").click()
    expect(page.locator(".step")).to_have_count(1)
    page.fill('[data-field="y0.1"]', "0.1")  # the step that is left has the first one's name now
    confirmed(page)
    assert courses(recipe)["y0"].values.tolist() == [0.1]


def test_a_time_by_the_clock_is_one_of_the_loop_which_runs_faster(page: Page, recipe: RunningLoop) -> None:
    page.click("#course-by-hand")
    page.select_option("#course-signal", "d0")
    expect(page.locator("#course-way")).to_be_hidden()  # a forecast always runs straight
    page.select_option("#course-times", "clock")
    time = page.locator('[data-what="time"]')
    expect(time).to_have_attribute("type", "datetime-local")
    in_an_hour = "new Date(Date.now() + 3600e3 - new Date().getTimezoneOffset() * 60e3).toISOString().slice(0, 19)"
    time.fill(page.evaluate(in_an_hour))
    page.fill('[data-field="d0.1"]', "0.2")
    confirmed(page)
    course, loop = courses(recipe)["d0"], recipe.station.loop
    assert loop is not None
    left = float(course.times_s[-1] - loop.courses.now_s)
    speed = recipe.settings.speed
    assert 3500 * speed < left <= 3600 * speed + 10
    assert course.straight


def foreseen(page: Page, signal: str) -> list[float]:
    """Where a signal would be in the end: as it is, and with what is asked for."""
    row = page.locator("#dialog-foreseen tbody tr").filter(has=page.get_by_role("rowheader", name=signal))
    expect(row).to_have_count(1)
    return [float(text.split()[0]) for text in row.locator("td").all_text_contents()[:2]]


def test_a_course_is_looked_at_before_it_is_given_and_before_it_is_ended(page: Page, recipe: RunningLoop) -> None:
    page.click("#course-by-hand")
    page.select_option("#course-times", "s")
    page.locator('[data-what="time"]').first.fill("30")
    page.fill('[data-field="y0.1"]', "0.5")
    expect(page.locator("#dialog-foreseen caption")).to_contain_text("40 s")  # the step, and the law's ten samples
    expect(page.locator("#dialog-foreseen tbody svg polyline")).to_have_count(2 * 4)
    without, given = foreseen(page, "y0")
    assert abs(given - 0.5) < 0.1 < abs(without - 0.5)
    page.fill('[data-field="y0.1"]', "7")
    expect(page.locator('[id="wrong-y0.1"]')).to_contain_text("y0")  # before anybody confirms it
    expect(page.locator("#dialog-foreseen table")).to_have_count(0)
    page.fill('[data-field="y0.1"]', "0.5")
    page.locator('[data-what="time"]').first.fill(str(FAR))
    expect(page.locator("#dialog-foreseen [data-note]").last).to_contain_text("50 min")  # goes on beyond what is shown
    assert courses(recipe) == {}
    page.locator('[data-what="time"]').first.fill("100")
    confirmed(page)
    page.locator('[data-course-of="y0"]').get_by_role("button").click()
    expect(page.locator("#dialog-foreseen table")).to_be_visible()
    page.click("#cancel")
    page.click("#course-by-file")
    file: Any = {"name": "recipe.csv", "mimeType": "text/csv", "buffer": b"time,y1\n5,-0.3\n"}
    page.set_input_files("#course-file", files=[file])
    expect(page.locator("#dialog-foreseen table")).to_be_visible()
    without, given = foreseen(page, "y1")
    assert abs(given + 0.3) < abs(without + 0.3)
    page.click("#cancel")


def test_a_file_gives_several_and_what_is_wrong_in_it_stands_beside_it(page: Page, recipe: RunningLoop) -> None:
    page.click("#course-by-file")

    def choose(text: str) -> None:
        file: Any = {"name": "recipe.csv", "mimeType": "text/csv", "buffer": text.encode()}
        page.set_input_files("#course-file", files=[file])

    choose("time,y0\nsoon,0.5\n")
    page.click("#confirm")
    expect(page.locator("#wrong-csv")).to_contain_text("line 2")
    choose("time,y0\n" + f"{FAR},0.5\n" * 12_000)
    page.click("#confirm")
    expect(page.locator("#wrong-csv")).to_contain_text("bytes")
    assert courses(recipe) == {}
    choose(f"time,y0,y1,d0\n0,,,0\n{FAR},0.5,0.25,0.1\n{2 * FAR},0,,\n")
    expect(page.locator("#dialog-moves")).to_contain_text("time,y0,y1,d0; 3 lines")
    page.locator("#dialog").get_by_label("y0").check()
    confirmed(page)
    assert {name: of.straight for name, of in courses(recipe).items()} == {"y0": True, "y1": False, "d0": True}
    for name in ("y0", "y1", "d0"):
        expect(page.locator(f'[data-course-of="{name}"]')).to_contain_text("by anna")
    page.click("#course-end-all")
    confirmed(page)
    expect(page.locator("#course-list")).to_contain_text("none")
    assert courses(recipe) == {}


def test_all_of_it_has_names_for_a_screen_reader_and_goes_by_keyboard(page: Page, recipe: RunningLoop) -> None:
    page.locator("#course-by-hand").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#course-signal")).to_be_focused()
    page.get_by_label("Value of step 1").focus()
    page.keyboard.type("0.5")
    page.keyboard.press("Enter")
    expect(page.locator("#dialog")).to_be_hidden()
    assert list(courses(recipe)) == ["y0"]
    expect(page.locator("#course-by-hand")).to_be_focused()
    expect(page.get_by_role("button", name="End the course of y0")).to_have_count(1)
    expect(page.get_by_role("region", name="Course")).to_have_count(1)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_gives_one_without_scrolling_sideways(browser: Browser, recipe: RunningLoop, scheme: Any) -> None:
    how: dict[str, Any] = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    phone = come_in(browser, recipe, color_scheme=scheme, **how)
    phone.locator("#course-by-hand").tap()
    phone.select_option("#course-times", "clock")
    phone.fill('[data-field="y0.1"]', "0.1")
    dialog = phone.locator("#dialog")
    expect(phone.locator("#dialog-foreseen table")).to_be_visible()
    assert dialog.evaluate("e => e.scrollWidth <= e.clientWidth + 1 && e.offsetWidth <= 390")
    assert phone.locator('[data-what="time"]').evaluate("e => e.scrollWidth <= e.clientWidth + 1")
    phone.locator("#confirm").tap()
    expect(dialog).to_be_hidden()
    expect(phone.locator('[data-course-of="y0"]')).to_be_visible()
    assert phone.evaluate("document.scrollingElement.scrollWidth") <= 390
    recipe.does("course", None)
    phone.close()
