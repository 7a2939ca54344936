"""The page of examples/embed/browser with a controller's own WebAssembly module, and without onnxruntime-web."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from chromium import CHROMIUM
from kits import PID, kit_of, verdict_on
from webassembly_modules import MISSING, module_of

if CHROMIUM is None:
    pytest.skip("no chromium is installed (Debian: apt install chromium-headless-shell)", allow_module_level=True)
if MISSING:
    pytest.skip(MISSING, allow_module_level=True)

from kit_on_page import conform
from playwright.sync_api import Page

pytest_plugins = ["embedded_page"]


def test_the_page_plays_a_kit_by_the_module_alone(page: Page, asked: list[str], tmp_path: Path) -> None:
    said = conform(page, kit_of(PID), module_of(PID, tmp_path / "law"))
    assert "0 wrong" in said
    (tmp_path / "answers.json").write_text(json.dumps(page.evaluate("window.answers")))
    verdict = verdict_on(PID, tmp_path / "answers.json")
    assert verdict.passed, verdict.text()
    assert verdict.one_step.rows > 300
    assert any(path.endswith("plain.mjs") for path in asked)
    assert not [path for path in asked if "onnxruntime" in path]
