"""The playground in a real browser: what it computes is what Python computes, and a person can act on it.

With LOOPWRIGHT_PICTURES=FOLDER the picture of docs/ is taken there.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.cases import CASES
from pipeline.commands.playground import page_of
from pipeline.plants.simulator import Array
from pipeline.playground.server import file_server
from pipeline.playground.site import write_folder
from pipeline.playground.web_runtime import kept
from pipeline.simulation.scenario import Scenario
from serving import Controller, ControlLoop, Mode, Sample

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if CHROMIUM is None:
    pytest.skip("no chromium is installed (apt install chromium)", allow_module_level=True)
if not kept().exists():
    pytest.skip("onnxruntime-web is not here (python -m pipeline.playground.web_runtime)", allow_module_level=True)

from playwright.sync_api import Browser, Page, expect, sync_playwright  # noqa: E402

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


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as p:
        # Containers have no user namespaces; the page is our own.
        made = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield made
        made.close()


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
    opened(page, f"{site}{case}/")
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
