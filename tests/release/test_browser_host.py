"""The browser host in a real browser: shipped controllers of every case within the kit's tolerance, and its loop.

`npm ci` in examples/embed/browser brings onnxruntime-web, Debian's chromium is the browser; without them it is skipped.
"""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from chromium import CHROMIUM, launched
from kits import DAMAGES, EMBED, PID, SOME, an_old_version, kit_of, name, spoilt, verdict_on

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)
if not (EMBED / "browser" / "node_modules").is_dir():
    pytest.skip("onnxruntime-web is missing (npm ci in examples/embed/browser)", allow_module_level=True)

from playwright.sync_api import Page, expect

expect.set_options(timeout=30_000)


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *words: object) -> None:
        pass


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """The page from a server of files alone; whatever it says of errors fails the tests."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=EMBED))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    said: list[str] = []
    with launched() as browser:
        made = browser.new_page()
        made.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        made.on("pageerror", lambda error: said.append(str(error)))
        made.goto(f"http://127.0.0.1:{server.server_port}/browser/")
        expect(made.locator("body")).to_have_attribute("data-ready", "yes")
        yield made
    server.shutdown()
    server.server_close()
    thread.join()
    assert said == []


def conform(page: Page, kit: Path) -> str:
    page.set_input_files("#files", [str(file) for file in kit.iterdir()])
    page.click("#conform")
    expect(page.locator("#conform")).to_be_enabled()
    expect(page.locator("#said")).not_to_be_empty()
    return page.locator("#said").text_content() or ""


@pytest.mark.parametrize("file", SOME, ids=name)
def test_the_browser_passes_the_kit(page: Page, file: Path, tmp_path: Path) -> None:
    assert "0 wrong" in conform(page, kit_of(file))
    (tmp_path / "answers.json").write_text(json.dumps(page.evaluate("window.answers")))
    verdict = verdict_on(file, tmp_path / "answers.json")
    assert verdict.passed, verdict.text()
    assert verdict.one_step.rows > 300
    assert verdict.chained.largest < 1e-8  # measured: 4e-10


@pytest.mark.parametrize("damage", DAMAGES)
def test_the_browser_does_not_pass_a_damaged_kit(page: Page, damage: str, tmp_path: Path) -> None:
    said = conform(page, spoilt(PID, tmp_path, DAMAGES[damage]))
    assert "FAILED" in said
    larger = {
        "mv": "difference 0.00100, chained 0.00100, 0 wrong",
        "state": "difference 0.00100, chained 0.00100, 0 wrong",
        "given": ", 0 wrong",
        "refusal": ", 2 wrong",
        "moved": "chained 0.800, 0 wrong",
    }
    assert larger.get(damage, ", 1 wrong") in said


def test_the_browser_refuses_an_old_kit(page: Page, tmp_path: Path) -> None:
    said = conform(page, spoilt(PID, tmp_path, an_old_version))
    assert said == "error: the kit has the version 3, not 4: write it again with loopwright conformance FILE.onnx KIT\n"


def test_the_browser_s_loop_scans_once_a_period(page: Page) -> None:
    page.set_input_files("#files", [str(kit_of(PID) / f"pid{suffix}") for suffix in (".onnx", ".json")])
    page.fill("#period", "0.1")
    page.click("#control")
    expect(page.locator("#control")).to_be_enabled()
    rows = [line.split() for line in (page.locator("#said").text_content() or "").splitlines()]
    places = [int(row[0]) for row in rows]
    assert places == sorted(set(places))  # a busy machine leaves some out, also at the start
    assert places[0] >= 0
    assert len(places) > 1
    assert all(0 <= float(row[1]) < 100 for row in rows)
    assert {row[4] for row in rows} == {"AUTO"}


def test_a_missing_file_is_named_in_the_browser(page: Page, tmp_path: Path) -> None:
    page.set_input_files("#files", [str(kit_of(PID) / "pid.onnx")])
    page.click("#conform")
    expect(page.locator("#said")).to_have_text("error: pid.json is not among the chosen files\n")
    shutil.copy(kit_of(PID) / "pid.json", tmp_path)
    (tmp_path / "pid.onnx").write_bytes(PID.read_bytes() + b"x")
    page.set_input_files("#files", [str(file) for file in tmp_path.iterdir()])
    page.click("#control")
    expect(page.locator("#said")).to_contain_text("error: the file's SHA-256 is")
