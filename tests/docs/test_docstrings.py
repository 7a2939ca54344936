"""How a sentence begins: with its subject or a verb, not with a clause that the reader must carry.

The rule holds for docstrings, for pages, and for comments and messages. Headings, titles and questions are let through.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pages import PAGES, ROOT, without_code
from words_of_code import JINJA, sources, words_of

BEGINNINGS = r"Of|That|What|As|In which|Which|Whose|Who"
# A stop with no space behind it is part of a name or number. The mark ends a question.
INNER = r"[^.!?\n]|[.!?](?=[^\s.!?])"
# To its end: Python 3.11.2 takes a possessive *+ wrongly.
BEGUN = re.compile(rf"(?:^|(?<=[.!?:] )|(?<=\n\n))(?:{BEGINNINGS})\b(?:{INNER})*(?!\?|{INNER})")
UNREAD = re.compile(r"^(?:\{\{ \")?#.*$|^\|.*\n+(?=\|:?--)|<!--.*?-->", re.MULTILINE)  # headings, heads, remarks
APART = re.compile(r"\n\s*\n|\n(?=[ \t]*(?:[-*]|\d+\.) )|(?<!\\)\|")  # paragraphs, list items and cells
# Signs of list items, links and emphasis, which are no words.
MARKS = re.compile(r"^\s*(?:(?:[-*>]|\d+\.) +)?|\]\([^)]*\)|(?<!\w)_|_(?!\w)|[*\"“()\[\]]")
TEMPLATES = sorted((ROOT / "pipeline" / "report" / "templates").glob("*.md.j2"))


def docstrings(text: str) -> Iterator[tuple[int, str]]:
    """(line, text) of the docstrings of modules, classes, functions and constants."""
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for child in body if isinstance(body, list) else ():
            value = child.value.value if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) else None
            if isinstance(value, str):
                yield child.lineno, value


def begun_badly(text: str) -> list[str]:
    """The sentences of a text that break the rule; each of its parts is read as one line without marks."""
    parts = (" ".join(MARKS.sub("", part).split()) for part in APART.split(text))
    return [found[0] for found in BEGUN.finditer("\n\n".join(parts))]


def of_docstrings(text: str) -> list[tuple[int, str]]:
    return [(line, found) for line, words in docstrings(text) for found in begun_badly(words)]


def of_a_page(text: str) -> list[str]:
    return begun_badly(JINJA.sub("", UNREAD.sub("", without_code(text))))


def of_messages(rows: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Words without a stop are a title, but for a part of a sentence, which a space ends."""
    said = [(line, words) for line, words in rows if re.search(r"[.!?:]|\S $", words)]
    return [(line, found) for line, words in said for found in begun_badly(words)]


@pytest.mark.parametrize("folder", ["pipeline", "serving"])
def test_sentences_begin_with_their_subject_or_a_verb(folder: str) -> None:
    files = sorted(Path(ROOT / folder).rglob("*.py"))
    assert len(files) > 50
    found = {str(path.relative_to(ROOT)): of_docstrings(path.read_text(encoding="utf-8")) for path in files}
    assert not {path: rows for path, rows in found.items() if rows}


@pytest.mark.parametrize("page", [*PAGES, *TEMPLATES], ids=lambda p: p.relative_to(ROOT).as_posix())
def test_sentences_of_pages_begin_so_too(page: Path) -> None:
    assert of_a_page(page.read_text(encoding="utf-8")) == []


def test_sentences_of_messages_begin_so_too() -> None:
    found = {str(path.relative_to(ROOT)): of_messages(words_of(path)) for path in sources()}
    assert not {path: rows for path, rows in found.items() if rows}


def test_the_rule_sees_each_kind_of_docstring() -> None:
    module = '"""What a module is."""\nLEAST = 1\n"""Of a part."""\n'
    made = 'class A:\n    """A plant. As it\n    is."""\n'
    made += '    def of(self):\n        """Do.\n\n        Who asks.\n        """\n'
    assert [line for line, _ in of_docstrings(module + made)] == [1, 3, 5, 8]
    assert not of_docstrings('"""Take it as it is, whatever it was."""')


def test_the_rule_sees_each_part_of_a_page() -> None:
    text = "Text. What\nis.\n\n- **What it is**: a part.\n- Two.\n  1. Of [it](a.md).\n"
    table = "\n| a | What |\n|---|---|\n| b | Who |\n"
    assert of_a_page(text + table) == ["What is", "What it is: a part", "Of it", "Who"]
    let_through = "# What it is\n\n**What is `× 1.10`?** More. See [it](a.md), whatever\nit is.\n\n<!-- What -->\n"
    assert not of_a_page(let_through + "```sh\nWhat comes.\n```\n")


def test_the_rule_sees_messages_and_no_titles() -> None:
    rows = [(1, "What to do:"), (2, " left. Of those within "), (3, "Of these, the "), (4, "Not so. That\nsaid.")]
    assert [line for line, _ in of_messages(rows)] == [1, 2, 3, 4]
    assert not of_messages([(1, "What happened"), (2, "What is it?"), (3, "so that ")])
