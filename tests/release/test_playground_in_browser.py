"""The playground in a real browser: what it computes is what Python computes, and a person can act on it.

With LOOPWRIGHT_PICTURES=FOLDER the picture of docs/ is taken there.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import CHROMIUM

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.commands.playground import page_of
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.playground.site import file_server, write_folder, write_one_file
from loopwright.pipeline.playground.web_runtime import kept
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving import Controller, ControlLoop, Mode, Sample

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)
if not kept().exists():
    pytest.skip(
        "onnxruntime-web is not here (python -m loopwright.pipeline.playground.web_runtime)", allow_module_level=True
    )

from playwright.sync_api import Browser, Page, expect

pytest_plugins = ["browser_of_tests"]
ARTIFACTS = Path(__file__).parents[2] / "artifacts"
PICTURES = os.environ.get("LOOPWRIGHT_PICTURES")
CASE = "henson_seborg_cstr"
WIDE = {"width": 1500, "height": 1000}
SAMPLES = 500
RECOVER_AFTER = 5
WITHIN = 1e-6  # of a signal's range
expect.set_options(timeout=30_000)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("site") / "playground"
    write_folder(made, [page_of(case, ARTIFACTS) for case in CASES.values()], kept())
    return made


@pytest.fixture(scope="module")
def site(folder: Path) -> Iterator[str]:
    with file_server(folder, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    made = browser.new_page(viewport=WIDE, locale="en-GB", color_scheme="light")
    said: list[str] = []
    made.on("console", lambda message: said.append(message.text) if message.type in {"error", "warning"} else None)
    made.on("pageerror", lambda error: said.append(str(error)))
    yield made
    made.close()
    assert said == []


def opened(page: Page, url: str) -> Page:
    page.goto(url)
    expect(page.locator("body")).to_have_attribute("data-ready", "yes")
    return page


def steps(page: Page, n: int) -> None:
    page.evaluate("n => playground.steps(n)", n)


def enter(page: Page, field: str, value: float) -> None:
    box = page.locator(f'[data-field="{field}"]')
    for around in page.locator("details:not([open])", has=box).all():
        around.evaluate("box => { box.open = true; }")
    box.fill(repr(value))
    box.press("Enter")


# ---------------------------------------------------------------------- the same numbers as Python's
@dataclass
class Hand:
    """What is done by hand in a run: sample -> act, in the page and in Python alike."""

    sp: float
    parameter: str
    changed: float
    mv: tuple[float, ...]
    noise = 0.5
    at_sp, at_parameter, at_noise = 40, 120, 180
    stuck, broken, manual = (260, 285), (330, 336), (390, 420)

    @classmethod
    def of(cls, case: str, test: Scenario) -> Hand:
        plant = CASES[case].plant
        sp, signals = plant.sp_signals[0], plant.mv_signals
        tested = [p["name"] for p in page_of(CASES[case], ARTIFACTS).about["parameters"] if p["tested"]]
        parameter = tested[0] if tested else plant.parameter_names()[0]
        value = float(plant.parameters()[plant.parameter_names().index(parameter)])
        start = float(test.sp[0, 0])
        middle = (sp.low + sp.high) / 2
        target = start + (0.2 if middle > start else -0.2) * min(sp.high - sp.low, 2 * abs(middle - start) + 1e-3)
        mv = tuple(float(m) if s.values else float(m) + 0.02 * (s.high - s.low)
                   for s, m in zip(signals, test.mv0, strict=True))  # fmt: skip
        return cls(round(target, 6), parameter, round(1.01 * value, 9), mv)

    def acts(self, page: Page, k: int, case: str) -> None:
        """What is done in the page before sample ``k``."""
        plant = CASES[case].plant
        if k == self.at_sp:
            enter(page, f"SP {plant.sp_signals[0].name}", self.sp)
        if k == self.at_parameter:
            enter(page, f"p {self.parameter}", self.changed)
        if k == self.at_noise:
            enter(page, "noise", self.noise)
        if k in self.stuck:
            page.locator(f'[data-tick="stuck {plant.mv_signals[0].name}"]').click()
        if k in self.broken:
            page.locator(f'[data-tick="broken {plant.pv_signals[0].name}"]').click()
        if k == self.manual[0]:
            page.locator('.faceplate[data-lane=A] button[data-mode="MANUAL"]').click()
            for signal, value in zip(plant.mv_signals, self.mv, strict=True):
                box = page.locator(f'[data-field="MV A {signal.name}"]')
                expect(box).to_be_enabled()
                if signal.values:
                    box.select_option(f"{value:g}")
                else:
                    enter(page, f"MV A {signal.name}", value)
        if k == self.manual[1]:
            page.locator('.faceplate[data-lane=A] button[data-mode="AUTO"]').click()

    def moments(self) -> list[int]:
        return sorted({self.at_sp, self.at_parameter, self.at_noise, *self.stuck, *self.broken, *self.manual})


def replayed(case: str, controller: Controller, test: Scenario, hand: Hand, noise: Array, lane: str) -> dict[str, Any]:
    """The same run in Python: the runtime's loop over the plant."""
    plant = CASES[case].plant
    loop = ControlLoop(controller, sp=test.sp[0], mv=test.mv0, mode=Mode.AUTO, recover_after=RECOVER_AFTER)
    x, mv, sp = test.x0.copy(), test.mv0.copy(), test.sp[0].copy()
    p = plant.parameters()
    places = {name: plant.parameter_names().index(name) for name in (*test.changes, hand.parameter)}
    found: dict[str, list[Any]] = {name: [] for name in ("pv", "mv", "sp", "mode")}
    for k in range(SAMPLES):
        # A hand's change stays until the test moves the same thing again.
        if k == hand.at_sp:
            sp = np.array([hand.sp])
        if k == hand.at_parameter:
            p[places[hand.parameter]] = hand.changed
        if k < test.samples and (k == 0 or test.sp[k, 0] != test.sp[k - 1, 0]):
            sp = test.sp[k].copy()
        for name, course in test.changes.items():
            if k < test.samples and (k == 0 or course[k] != course[k - 1]):
                p[places[name]] = course[k]
        loop.set_sp(sp)
        if lane == "A" and k == hand.manual[0]:
            loop.set_mode(Mode.MANUAL)
            loop.set_mv(hand.mv)
        if lane == "A" and k == hand.manual[1]:
            loop.set_mode(Mode.AUTO)
        measured = plant.measure(x) + noise[k]
        if hand.broken[0] <= k < hand.broken[1]:
            measured[0] = np.nan
        command = loop.scan(Sample(pv=measured, mv_applied=mv, dv=plant.dv_nominal))
        applied = command.mv.copy()
        if hand.stuck[0] <= k < hand.stuck[1]:
            applied[0] = mv[0]
        for name, value in (("pv", plant.measure(x)), ("mv", applied), ("sp", sp), ("mode", command.mode.value)):
            found[name].append(value)
        x, mv = plant.step(x, applied, plant.dv_nominal, p), applied
    return found


@pytest.mark.parametrize("case", CASES)
def test_the_page_computes_what_python_computes(page: Page, site: str, case: str) -> None:
    plant = CASES[case].plant
    opened(page, f"{site}{case}/").select_option("#test", index=1)  # behind "by hand"
    test = next(iter(CASES[case].scenarios().values()))[0]
    hand, k = Hand.of(case, test), 0
    for moment in [*hand.moments(), SAMPLES]:
        steps(page, moment - k)
        k = moment
        hand.acts(page, k, case)
    columns = page.evaluate("playground.simulation.columns")
    noise = np.array([columns[f"noise {s.name}"] for s in plant.pv_signals]).T
    assert (noise[: hand.at_noise] == 0).all()
    assert (noise[hand.at_noise :] != 0).all()
    largest = 0.0
    for lane, law in zip("AB", page.evaluate("playground.simulation.chosen"), strict=True):
        ours = replayed(case, Controller(ARTIFACTS / case / f"{law}.onnx"), test, hand, noise, lane)
        assert columns[f"mode {lane}"] == ours["mode"]
        assert {"AUTO", "HOLD"} <= set(ours["mode"])
        kinds = (("pv", "true", plant.pv_signals), ("mv", "mv", plant.mv_signals), ("sp", "sp", plant.sp_signals))
        for kind, label, signals in kinds:
            for i, s in enumerate(signals):
                theirs = np.array(columns[f"sp {s.name}" if kind == "sp" else f"{label} {lane} {s.name}"], dtype=float)
                off = np.abs(theirs - np.array(ours[kind])[:, i]).max() / (s.high - s.low)
                largest = max(largest, off)
                assert theirs.shape == (SAMPLES,)
                assert off <= WITHIN, (lane, law, kind, s.name)
    print(f"{case}: {largest:.1e} of a range over {SAMPLES} samples")
    assert "HOLD" not in columns["mode A"][-20:]


# ---------------------------------------------------------------------- what a person does
def rows(page: Page) -> int:
    """The samples that the trend of C shows."""
    return int(page.locator('[data-chart="C"]').get_attribute("data-rows") or 0)


def test_it_runs_pauses_steps_and_begins_anew_by_mouse_and_by_keyboard(page: Page, site: str) -> None:
    opened(page, f"{site}{CASE}/")
    expect(page).to_have_title("Exothermic CSTR under coolant flow · Loopwright playground")
    page.select_option("#speed", "50")
    page.click("#go")
    expect(page.locator("#go")).to_have_text("Pause")
    expect(page.locator('[data-chart="C"]')).to_have_attribute("data-rows", re.compile(r"\d\d+"))
    page.click("#go")
    expect(page.locator("#go")).to_have_text("Run")
    page.click("#step")  # it waits for the step that was under way
    expect(page.locator("#step")).to_be_enabled()
    before = rows(page)
    page.evaluate("document.activeElement.blur()")  # on a button, space presses that
    page.locator("body").press("ArrowRight")
    expect(page.locator("#clock")).to_contain_text(f"sample {before + 1}")
    page.locator("body").press(" ")
    expect(page.locator("#go")).to_have_text("Pause")
    page.locator("body").press(" ")
    expect(page.locator("#go")).to_have_text("Run")
    enter(page, "SP C", 0.05)
    page.locator('[data-field="SP C"]').press("r")  # in a field it is a letter, not a reset
    expect(page.locator("#events")).to_contain_text("C = 0.05 mol/l")
    page.evaluate("document.activeElement.blur()")
    page.locator("body").press("r")
    expect(page.locator("#clock")).to_have_text("00:00:00, sample 0")
    expect(page.locator('[data-field="SP C"]')).to_have_value("0.02")
    expect(page.locator("#events li")).to_have_count(0)


def test_every_control_is_reached_by_tab_and_shows_its_focus(page: Page, site: str) -> None:
    opened(page, f"{site}{CASE}/")
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.dataset.field || document.activeElement.id"))
        if page.evaluate("document.activeElement.id") == "go":
            assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    assert {"go", "step", "reset", "speed", "test", "SP C", "p T_f", "noise", "scale", "theme"} <= reached


def test_what_the_runtime_refuses_the_page_refuses_in_the_same_words(page: Page, site: str) -> None:
    opened(page, f"{site}{CASE}/")
    refusal = page.locator("#setpoints .refusal")
    enter(page, "SP C", 7.0)
    expect(refusal).to_have_text("the set point C = 7 mol/l is outside [0.005, 0.14] mol/l")
    enter(page, "SP C", 0.1)
    expect(refusal).to_have_text("")
    page.locator('[data-field="SP C"]').fill("")
    page.locator('[data-field="SP C"]').press("Enter")
    expect(refusal).to_have_text("the set point C is no finite number; give one from 0.005 to 0.14 mol/l")
    assert page.evaluate("playground.simulation.sp") == [0.1]
    assert (
        page.evaluate("""() => {
      const loop = playground.simulation.lanes[0].loop;
      try { loop.setMv([30]); } catch (error) { return error.message; }
    }""")
        == "the MV is set by hand in MANUAL only; the loop is in AUTO"
    )


def test_a_sensor_without_a_value_holds_the_mv_and_good_samples_end_it(page: Page, site: str) -> None:
    opened(page, f"{site}{CASE}/")
    steps(page, 10)
    enter(page, "SP C", 0.06)
    page.click('[data-tick="broken C"]')
    steps(page, 3)
    for lane in "AB":
        face = page.locator(f'.faceplate[data-lane="{lane}"]')
        expect(face.locator(".mode")).to_have_text("HOLD")
        expect(face.locator(".reason")).to_have_text("▲ PV C is nan")
        expect(face.locator(f'[data-signal="PV {lane} C"]')).to_contain_text("no value")
        mv = page.evaluate(f"playground.simulation.columns['mv {lane} q_c']")
        assert len(set(mv[10:])) == 1
    page.click('[data-tick="broken C"]')
    steps(page, RECOVER_AFTER)
    expect(page.locator('.faceplate[data-lane="A"] .mode')).to_have_text("AUTO")
    expect(page.locator("#events")).to_contain_text("AUTO → HOLD: PV C is nan")
    expect(page.locator("#events")).to_contain_text("HOLD → AUTO")


def test_another_controller_takes_over_and_the_law_tells_where_it_knows_nothing(page: Page, site: str) -> None:
    opened(page, f"{site}thiosulfate_cstr/")
    page.select_option('[data-choose="A"]', "incad")
    expect(page.locator("#events")).to_contain_text("INCAD takes over, with no past")
    steps(page, 20)
    enter(page, "p T_in", 320.0)
    expect(page.locator('[data-chart="T_in"]')).to_be_visible()
    steps(page, 20)
    face = page.locator('.faceplate[data-lane="A"]')
    expect(face.locator(".notes .watch")).to_contain_text("outside its applicability domain (leverage")
    assert page.evaluate("playground.simulation.columns['info A in_domain']")[-1] == 0
    expect(page.locator('.faceplate[data-lane="B"] .notes .watch')).to_have_count(0)
    page.click('[data-back="p T_in"]')
    assert page.evaluate("playground.simulation.p")[3] == 275


def test_a_plant_beyond_what_it_can_compute_stops_with_words(page: Page, site: str) -> None:
    opened(page, f"{site}{CASE}/")
    enter(page, "p V", 0.0)
    steps(page, 3)
    expect(page.locator("#banner")).to_contain_text("has left what it can compute")
    expect(page.locator("#go")).to_be_disabled()
    page.click("#reset")
    expect(page.locator("#banner")).to_be_hidden()
    steps(page, 3)
    expect(page.locator("#clock")).to_contain_text("sample 3")


def test_nothing_is_asked_of_another_machine(page: Page, site: str) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    opened(page, f"{site}{CASE}/")
    steps(page, 5)
    assert len(asked) > 10
    assert [url for url in asked if not url.startswith((site, "data:", "blob:"))] == []


def test_one_file_runs_without_any_server_and_computes_the_same(page: Page, site: str, tmp_path: Path) -> None:
    path = tmp_path / "cstr.html"
    write_one_file(path, page_of(CASES[CASE], ARTIFACTS), kept())
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    found = []
    for url in (path.as_uri(), f"{site}{CASE}/"):
        opened(page, url).select_option("#test", index=1)
        steps(page, 150)
        found.append(page.evaluate("playground.simulation.columns"))
        if url == path.as_uri():
            assert {u.partition(":")[0] for u in asked} <= {"file", "data", "blob"}
    assert found[0] == found[1]
    assert path.stat().st_size < 8 * 2**20


def test_a_folder_that_is_opened_as_a_file_says_what_to_do(browser: Browser, folder: Path) -> None:
    page = browser.new_page()
    page.goto((folder / CASE / "index.html").as_uri())
    expect(page.locator("#banner")).to_contain_text(
        "Put its folder on a file server, or write the page with --one-file"
    )
    page.close()


def test_a_controller_that_was_changed_after_the_page_is_refused(
    browser: Browser, folder: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "site"
    shutil.copytree(folder, copy)
    file = copy / CASE / "pid.onnx"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with file_server(copy, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_port}/{CASE}/")
        expect(page.locator("#banner")).to_contain_text("pid.onnx: the file's SHA-256 is")
        expect(page.locator("body")).to_have_attribute("data-ready", "no")
        page.close()
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_shows_the_playground_in_light_and_dark(browser: Browser, site: str, scheme: str) -> None:
    phone = browser.new_page(viewport={"width": 360, "height": 780}, color_scheme=scheme)  # type: ignore[arg-type]
    for case in (CASE, "jacketed_batch_reactor"):
        opened(phone, f"{site}{case}/")
        steps(phone, 30)
        assert phone.evaluate("document.documentElement.dataset.theme") == scheme
        assert phone.evaluate("document.scrollingElement.scrollWidth") <= 360
        expect(phone.locator(".chart canvas").first).to_be_visible()
    phone.click("#theme")
    assert phone.evaluate("document.documentElement.dataset.theme") != scheme
    phone.close()


def test_the_list_of_cases_leads_to_each(page: Page, site: str) -> None:
    page.goto(site)
    expect(page.locator(".list a")).to_have_count(len(CASES))
    page.click(f'a[href="{CASE}/"]')
    expect(page.locator("body")).to_have_attribute("data-ready", "yes")


def test_a_picture_of_a_changed_set_point_a_warmer_feed_and_noise(page: Page, site: str) -> None:
    opened(page, f"{site}{CASE}/")
    steps(page, 40)
    enter(page, "SP C", 0.1)
    steps(page, 90)
    enter(page, "p T_f", 353.0)
    steps(page, 80)
    enter(page, "noise", 1.0)
    steps(page, 60)
    expect(page.locator('[data-chart="T_f"]')).to_be_visible()
    expect(page.locator("#events li")).to_have_count(3)
    assert rows(page) == 270
    mean = [float(page.locator(f'[data-mean="{lane}"] .number').inner_text()) for lane in "AB"]
    assert 0 < mean[0] < mean[1]  # predictive control beats the PID
    if PICTURES:
        page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
        page.screenshot(path=Path(PICTURES) / "playground.png", full_page=True)


def test_the_command_serves_the_page_until_it_is_interrupted(page: Page) -> None:
    code = "import sys; from loopwright.pipeline.__main__ import main; sys.exit(main(sys.argv[1:]))"
    words = ["playground", CASE, "--port", "0", "--artifacts", str(ARTIFACTS)]
    process = subprocess.Popen([sys.executable, "-c", code, *words], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = re.search(r"http://127\.0\.0\.1:\d+/\w+/", process.stdout.readline())
        assert url is not None
        opened(page, url[0])
        steps(page, 2)
        expect(page.locator("#clock")).to_contain_text("sample 2")
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        process.stdout.close()
