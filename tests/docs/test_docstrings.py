"""How a sentence of a docstring begins: with its subject or a verb, not with a clause that the reader must carry."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pages import ROOT

BEGINNINGS = r"Of|That|What|As|In which|Which|Whose|Who"
BEGUN = re.compile(rf"(?:^|(?<=[.!?] )|(?<=\n\n))(?:{BEGINNINGS})\b[^.!?\n]*")


def docstrings(text: str) -> Iterator[tuple[int, str]]:
    """(line, text) of the docstrings of modules, classes, functions and constants; each paragraph on one line."""
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for child in body if isinstance(body, list) else ():
            value = child.value.value if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) else None
            if isinstance(value, str):
                yield child.lineno, "\n\n".join(" ".join(p.split()) for p in re.split(r"\n\s*\n\s*", value))


def begun_badly(text: str) -> list[tuple[int, str]]:
    return [(line, found[0]) for line, words in docstrings(text) for found in BEGUN.finditer(words)]


@pytest.mark.parametrize("folder", ["pipeline", "serving"])
def test_sentences_begin_with_their_subject_or_a_verb(folder: str) -> None:
    files = sorted(Path(ROOT / folder).rglob("*.py"))
    assert len(files) > 50
    found = {str(path.relative_to(ROOT)): begun_badly(path.read_text(encoding="utf-8")) for path in files}
    assert not {path: rows for path, rows in found.items() if rows}


def test_the_rule_sees_each_kind_of_docstring() -> None:
    module = '"""What a module is."""\nLEAST = 1\n"""Of a part."""\n'
    made = 'class A:\n    """A plant. As it\n    is."""\n'
    made += '    def of(self):\n        """Do.\n\n        Who asks.\n        """\n'
    assert [line for line, _ in begun_badly(module + made)] == [1, 3, 5, 8]
    assert not begun_badly('"""Take it as it is, whatever it was."""')
