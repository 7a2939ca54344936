"""What people read of a program: comments and messages of Python, C and JavaScript, and the text of HTML pages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

from pages import ROOT

FOREIGN = {"serving/page/static/uPlot.iife.min.js"}  # written by others
SCRIPTS, MARKUP = {".c", ".js", ".mjs"}, {".html", ".j2"}
SAID = {"alt", "aria-label", "content", "placeholder", "title"}  # attributes that a page shows or reads aloud
# A slash after one of these signs begins a regular expression, and elsewhere it divides.
TOKEN = re.compile(
    r"""(?P<comment>/\*.*?\*/|//[^\n]*)
    |(?P<text>"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')
    |(?P<regex>[(,=:!&|?]\s*/(?![/*])(?:\\.|\[(?:\\.|[^\]\\\n])*\]|[^/\\\n])+/)
    |(?P<template>`)|(?P<open>\{)|(?P<close>\})""",
    re.DOTALL | re.VERBOSE,
)
TEMPLATE = re.compile(r"(?P<end>`)|(?P<code>\$\{)|\\.|[^`$\\]+|\$", re.DOTALL)
JINJA = re.compile(r"\{%.*?%\}|\{\{.*?\}\}|\{#.*?#\}", re.DOTALL)


def sources() -> list[Path]:
    """Files of ours whose words people read, beside the manual; not what npm fetched."""
    kinds = ("*.py", "*.c", "*.js", "*.mjs", "*.html", "*.html.j2")
    folders = ("serving", "pipeline", "examples", "docs/_ext")
    found = sorted({path for folder in folders for kind in kinds for path in (ROOT / folder).rglob(kind)})
    ours = [path for path in found if "node_modules" not in path.parts and not path.is_symlink()]
    return [path for path in ours if path.relative_to(ROOT).as_posix() not in FOREIGN]


def words_of(path: Path) -> list[tuple[int, str]]:
    """(line, text) of every comment and message of a file; single words are keys and names."""
    text = path.read_text(encoding="utf-8")
    if path.suffix in SCRIPTS:
        found = list(of_script(text))
    elif path.suffix in MARKUP:
        found = list(of_page(JINJA.sub(lambda m: "\n" * m[0].count("\n"), text)))
    else:
        found = of_python(text)
    return [(line, words) for line, words in found if " " in words.strip()]


def of_python(text: str) -> list[tuple[int, str]]:
    """Its docstrings and messages."""
    return [
        (node.lineno, node.value)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]


def of_script(text: str) -> Iterator[tuple[int, str]]:
    """Comments and texts of C or JavaScript, also those of code inside template texts."""
    yield from ((text.count("\n", 0, at) + 1, words) for at, words in _code(text, [0]))


def _code(text: str, place: list[int]) -> Iterator[tuple[int, str]]:
    """Up to the end, or to the brace that closes the code of a template; ``place`` moves along."""
    depth = 0
    while (found := TOKEN.search(text, place[0])) is not None:
        place[0] = found.end()
        kind = found.lastgroup
        if kind in {"comment", "text"}:
            yield found.start(), found[0].strip("\"'/*")
        elif kind == "template":
            yield from _template(text, place)
        elif kind in {"open", "close"}:
            depth += 1 if kind == "open" else -1
            if depth < 0:
                return
    place[0] = len(text)


def _template(text: str, place: list[int]) -> Iterator[tuple[int, str]]:
    begin, plain = place[0], ""
    while (found := TEMPLATE.match(text, place[0])) is not None:
        place[0] = found.end()
        if found["code"]:
            plain += " 0 "  # some value
            yield from _code(text, place)
        elif found["end"]:
            break
        else:
            plain += found[0]
    yield begin, plain


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[int, str]] = []
        self.within = ""  # a script, styles, or a name in code

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.within = tag if tag in {"script", "style", "code", "pre"} else self.within
        self.found += [(self.getpos()[0], value) for name, value in attrs if value and name in SAID]

    def handle_endtag(self, tag: str) -> None:
        self.within = "" if tag == self.within else self.within

    def handle_data(self, data: str) -> None:
        line = self.getpos()[0]
        if self.within == "script":
            self.found += [(line + at - 1, words) for at, words in of_script(data)]
        elif not self.within:
            self.found.append((line, data))

    def handle_comment(self, data: str) -> None:
        self.found.append((self.getpos()[0], data))


def of_page(text: str) -> list[tuple[int, str]]:
    """The text, titles and comments of a page, and those of its scripts."""
    page = _Page()
    page.feed(text)
    page.close()
    return page.found
