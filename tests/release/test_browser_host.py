"""The browser host in a real browser: shipped controllers of every case within the kit's tolerance, and its loop.

`npm ci` in examples/embed/browser brings onnxruntime-web, Debian's chromium is the browser; without them it is skipped.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from chromium import CHROMIUM
from kits import DAMAGES, EMBED, PID, SOME, an_old_version, kit_of, name, spoilt, verdict_on

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)
if not (EMBED / "browser" / "node_modules").is_dir():
    pytest.skip("onnxruntime-web is missing (npm ci in examples/embed/browser)", allow_module_level=True)

from kit_on_page import conform
from playwright.sync_api import Page, expect

pytest_plugins = ["embedded_page"]


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
    assert said == "error: the kit has the version 3, not 6: write it again with loopwright conformance FILE.onnx KIT\n"


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
