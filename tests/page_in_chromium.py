"""The page of a loop that only answers, in a real browser (a pytest plugin)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from chromium import come_in
from fake_loop import BEGIN, THIRDS, FakeLoop, opened
from fake_loop import Browser as Knocking
from processes import within

from loopwright.serving import Controller

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


@pytest.fixture(scope="module")
def bare(served: tuple[FakeLoop, str, str]) -> tuple[str, str]:
    """What the loop is and how it stands, before any test."""
    return json.dumps(served[0].about), json.dumps(served[0].state)


@pytest.fixture
def loop(served: tuple[FakeLoop, str, str], bare: tuple[str, str]) -> FakeLoop:
    """Two set points with more digits than are shown, and an MV of three values.

    It stands so from one moment to the next: a loop that stood in between at its first scan would have a page draw the
    trend up to there. The server answers with a state that is up to half a second old, so it is asked until it has this
    one: else a page shows the mode that the test before had set.
    """
    made, (about, state) = served[0], map(json.loads, bare)
    sp = [{"name": name, "unit": "K", "low": 0.0, "high": 1.0} for name in ("a", "b")]
    signals = {"sp": sp, "pv": sp, "dv": [], "mv": [{**sp[0], "name": "u", "values": THIRDS}]}
    stands = {"sp": [0.6123456, 0.3456789], "pv": [0.5, 0.4], "mv": [1 / 3], "applied": [1 / 3], "time": BEGIN + 100}
    fixture = made.state.get("fixture", 0) + 1  # which of them this is; the page shows nothing of it
    made.about, made.state = {**about, "signals": signals}, {**state, **stands, "fixture": fixture}
    made.unproven = ""
    made.changes.clear()
    knocking = Knocking(int(served[1].rpartition(":")[2]), served[2])
    assert within(20, lambda: knocking.json("/api/state").get("fixture") == fixture)
    return made


@pytest.fixture
def page(browser: Browser, loop: FakeLoop, served: tuple[FakeLoop, str, str]) -> Iterator[Page]:
    made = come_in(browser, served)
    raised: list[str] = []
    made.on("pageerror", lambda error: raised.append(str(error)))
    yield made
    made.close()
    assert raised == []
