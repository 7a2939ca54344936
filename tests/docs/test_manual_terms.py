"""One spelling of each term: in the manual, and in the comments and messages of code and pages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pages import DOCS, PAGES, ROOT, without_code
from words_of_code import of_page, of_script, sources, words_of

# What is written -> how it is spelled here. A word in backticks is a name, and stands as it is.
WRONG = {
    r"setpoints?|set-points?(?= is| are| of| at|\.|,)": "set point (set-point before a noun)",
    r"process values?|controlled values?|manipulated values?|control variables?": "process (or such) variable",
    r"anti ?windup|anti-wind-up|wind-up": "anti-windup",
    r"feed-forward|feed forward": "feedforward",
    r"feed-back": "feedback",
    r"dead-?times?": "dead time",
    r"readbacks?": "read-back",
    r"lockups?": "lock-up",
    r"heldout|hold-out": "held-out",
    r"bump-less": "bumpless",
    r"offset free": "offset-free",
    r"sample times?|sampling times?|sampling rates?": "sampling period",
    r"steady-states?(?= of| is|,|\.)": "steady state",
    r"off-line|on-line": "offline, online",
    r"over-?fit(?:s|ting)?-": "overfitting",
    r"optimis\w+|linearis\w+|neutralis\w+|normalis\w+|initialis\w+|vectoris\w+|minimis\w+": "-iz-",
    r"behavior\w*": "behaviour",
    r"Levenberg[–—]Marquardt|Gauss[–—]Newton": "a hyphen",
    r"onnx[ -]runtime": "onnxruntime",
    r"meta-data": "metadata",
}
TITLES = {  # as the papers print them
    "pipeline/cases/bibliography.md": {"on-line"},
}
KEPT = {
    "pipeline/historian/guessing.py": {"setpoint"},  # what people write in their own files
}


def misspelt(text: str) -> list[tuple[str, str]]:
    """(found, right) of each wrong spelling in a text, names left out."""
    plain = re.sub(r"`+[^`]*`+|\]\([^)]*\)|https?://\S+", " ", text)
    return [
        (match[0], right)
        for wrong, right in WRONG.items()
        for match in re.finditer(rf"(?i:\b(?:{wrong}))(?!\w)", plain)
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_pages_spell_terms_as_the_glossary_does(page: Path) -> None:
    allowed = TITLES.get(page.relative_to(ROOT).as_posix(), set())
    assert [m for m in misspelt(without_code(page.read_text(encoding="utf-8"))) if m[0] not in allowed] == []


def test_the_code_spells_terms_as_the_glossary_does() -> None:
    files = sources()
    assert {".py", ".c", ".js", ".mjs", ".html", ".j2"} <= {path.suffix for path in files}
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {found!r}; write {right}"
        for path in files
        for line, text in words_of(path)
        for found, right in misspelt(text)
        if found not in KEPT.get(path.relative_to(ROOT).as_posix(), set())
    ]
    assert not wrong


def test_the_test_sees_a_wrong_spelling() -> None:
    assert misspelt("The setpoint moves, and the dead-time is long.") == [
        ("setpoint", "set point (set-point before a noun)"),
        ("dead-time", "dead time"),
    ]
    assert misspelt("A set-point change of the set point; `setpoint` is a name.") == []


def test_words_of_scripts_are_told_from_their_code() -> None:
    code = r"""
const setpoint = a / 2 / b; // the setpoint of a comment
const s = { readback: 'readback', quote: /["'`]/g }, t = "the deadtime is long"; /* two
 lines of feed-forward */
say(`the setpoint ${x ? `is a ${"bad readback"}` : { windup: 1 }.windup} lies on-line`);
char c = '"', *words = "no normalisation";
"""
    found = {(line, word) for line, text in of_script(code) if " " in text.strip() for word, _ in misspelt(text)}
    assert found == {
        (2, "setpoint"),
        (3, "deadtime"),
        (3, "feed-forward"),
        (5, "setpoint"),
        (5, "on-line"),
        (5, "readback"),
        (6, "normalisation"),
    }
    page = """<p title="the setpoint here">A readback.</p><code>the setpoint</code><style>.setpoint a {}</style>
<script>const setpoint = "on-line words";</script><!-- a deadtime -->"""
    words = {(line, word) for line, text in of_page(page) for word, _ in misspelt(text)}
    assert words == {(1, "setpoint"), (1, "readback"), (2, "on-line"), (2, "deadtime")}


def test_the_glossary_has_the_terms_that_the_tables_use() -> None:
    text = (DOCS / "glossary.md").read_text(encoding="utf-8")
    terms = ("set point", "process variable", "manipulated variable", "measured disturbance", "anti-windup")
    for term in (*terms, "read-back", "lock-up", "held-out", "dead time", "feedforward", "bound", "manifest", "NNARX"):
        assert re.search(rf"^\| {re.escape(term)}", text, re.MULTILINE), term
