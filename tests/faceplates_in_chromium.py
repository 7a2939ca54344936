"""The faceplates of a law that operators steer, in a real browser. Loaded by ``pytest_plugins``, not imported."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from faceplate_steps import Steered, come_in, value
from identified_models import random_model
from operated_page import ModelPlant, served
from predictive_loops import law_of

from loopwright.pipeline.export.explain_graph import export_explanation
from loopwright.serving import Mode

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest_plugins = ["operated_laws", "browser_of_tests"]


@pytest.fixture(scope="module")
def running(operated_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Steered]:
    """The loop and its plant; beside the controller's file lies the graph that explains it."""
    law = law_of(random_model(3, n_y=2, n_mv=2, n_dv=1), horizon=20, operate={})
    export_explanation(law, operated_file)
    made = served(operated_file, tmp_path_factory.mktemp("steered"))
    yield made, ModelPlant.made
    made.end()


@pytest.fixture
def steered(running: Steered) -> Steered:
    """The loop and its plant as they began, whatever the test before this one left."""
    loop, plant = running
    plant.bad = ()
    if loop.commands[-1].mode is not Mode.AUTO:
        loop.does("mode", "AUTO")
    entries = loop.station.controller.manifest.operate
    changed = {e.name: e.default for e in entries if value(loop, e.name) != e.default}
    if changed:
        loop.does("operate", changed)
    return running


@pytest.fixture
def page(browser: Browser, steered: Steered) -> Iterator[Page]:
    made = come_in(browser, steered[0], viewport={"width": 1500, "height": 1200})
    raised: list[str] = []
    made.on("pageerror", lambda error: raised.append(str(error)))
    yield made
    made.close()
    assert raised == []
