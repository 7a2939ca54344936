"""Figures that pages written by hand state of the code, and no line that was left to be filled in."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pages import DOCS, PAGES, ROOT

from loopwright.serving.monitor.cusum import blocks, pooled
from loopwright.serving.monitor.monitor import BLOCK_SETTLINGS, LEARN_BLOCKS, LEARN_MODEL, LEARN_RESTS


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_nothing_is_left_to_be_filled_in(page: Path) -> None:
    assert re.findall(r"^@\w+@$", page.read_text(encoding="utf-8"), re.MULTILINE) == []


@pytest.mark.parametrize("name", ["on_the_plant.md", "howto/into_service.md"])
def test_the_monitor_learns_as_long_as_the_pages_say(name: str) -> None:
    """For plants that settle in 26 s and in half an hour: periods of rest, then time in AUTO."""
    rests, autos = [], []
    for settle_s in (26.0, 1800.0):
        rests.append(pooled(LEARN_RESTS, settle_s)[0] * settle_s)
        block_s, times = blocks(LEARN_MODEL + LEARN_BLOCKS, BLOCK_SETTLINGS * settle_s)
        autos.append(block_s * times * (LEARN_MODEL + LEARN_BLOCKS))
    text = (DOCS / name).read_text(encoding="utf-8").replace("\n", " ")
    paragraph = text[text.index("300 periods of rest" if name == "on_the_plant.md" else "300 settling times") :][:700]
    hours = {int(h) for h in re.findall(r"(\d+) h\b", paragraph)}
    assert hours == {round(s / 3600) for s in rests + autos}
