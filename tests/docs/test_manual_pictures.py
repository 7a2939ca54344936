"""Block diagrams and formulas of the manual: what the text says is in the picture, a mistake is named."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest
from manual.diagram import drawn
from manual.markdown import prose, table
from pages import PAGES, blocks

SVG = "{http://www.w3.org/2000/svg}"
DIAGRAMS = [block for page in PAGES for block in blocks(page) if block.language == "{diagram}"]
LOOP = """
r | e = (+) | [PID] | ((plant)) | y
--
r > e
e > PID
PID > plant : u
plant > y
y > e below : - y
"""


def test_a_loop_is_drawn_as_its_text_says() -> None:
    picture = ElementTree.fromstring(drawn(LOOP, "a loop"))
    assert picture.find(f"{SVG}title").text == "a loop"
    assert len(picture.findall(f"{SVG}rect")) == 2
    assert len(picture.findall(f"{SVG}circle")) == 1
    assert len(picture.findall(f"{SVG}polyline")) == 5
    assert {t.text for t in picture.findall(f"{SVG}text")} == {"r", "+", "PID", "plant", "y", "u", "- y"}


def test_an_arrow_to_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="'e > Pid'"):
        drawn(LOOP.replace("e > PID", "e > Pid"), "a loop")


@pytest.mark.parametrize("block", DIAGRAMS, ids=lambda b: b.where)
def test_every_arrow_of_a_page_is_drawn_within_the_picture(block) -> None:
    picture = ElementTree.fromstring(drawn(block.text, "words"))
    _, _, width, height = map(float, picture.get("viewBox").split())
    arrows = block.text.split("--\n")[1].strip().splitlines()
    lines = picture.findall(f"{SVG}polyline")
    assert len(lines) == len(arrows)
    points = [tuple(map(float, p.split(","))) for line in lines for p in line.get("points").split()]
    assert all(0 <= x <= width and 0 <= y <= height for x, y in points)
    texts = [t for t in picture.findall(f"{SVG}text") if t.text]
    assert all(0 < float(t.get("x")) < width for t in texts)


def test_docstrings_become_markdown_that_shows_what_they_say() -> None:
    text = prose("Adds ``a`` [mv/pv] to x_1 * y_2.\n\n        y = a x\n\n    As said.")
    assert text == "Adds `a` \\[mv/pv\\] to x\\_1 \\* y\\_2.\n\n```text\ny = a x\n```\n\nAs said."
    assert table(["a"], [["x | y"]]).splitlines()[2] == "| x \\| y |"
    assert re.search(r"\| {2,}\|", table(["a", "b"], [["", "1"]]).splitlines()[2]) is not None
