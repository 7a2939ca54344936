"""The page of a loop that only answers, in a real browser (a pytest plugin)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from chromium import come_in
from fake_loop import BEGIN, THIRDS, FakeLoop, opened

from serving import Controller

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


pytest_plugins = ["browser_of_tests"]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, pi_file: Path) -> Iterator[tuple[FakeLoop, str, str]]:
    made = FakeLoop(tmp_path_factory.mktemp("loop"), Controller(pi_file))
    page, _ = opened(made, [])
    yield made, page.url, page.token
    page.close()
    made.close()


@pytest.fixture
def loop(served: tuple[FakeLoop, str, str]) -> Iterator[FakeLoop]:
    """Two set points with more digits than are shown, and an MV of three values."""
    made = served[0]
    about, state = json.dumps(made.about), dict(made.state)
    sp = [{"name": name, "unit": "K", "low": 0.0, "high": 1.0} for name in ("a", "b")]
    made.about["signals"] = {"sp": sp, "pv": sp, "dv": [], "mv": [{**sp[0], "name": "u", "values": THIRDS}]}
    made.state.update(sp=[0.6123456, 0.3456789], pv=[0.5, 0.4], mv=[1 / 3], applied=[1 / 3], time=BEGIN + 100)
    made.changes.clear()
    yield made
    made.about = json.loads(about)
    made.state.clear()
    made.state.update(state)


@pytest.fixture
def page(browser: Browser, loop: FakeLoop, served: tuple[FakeLoop, str, str]) -> Iterator[Page]:
    made = come_in(browser, served)
    raised: list[str] = []
    made.on("pageerror", lambda error: raised.append(str(error)))
    yield made
    made.close()
    assert raised == []
