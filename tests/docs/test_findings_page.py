"""The page of findings has a row for each kind that the program can tell of, and none besides."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]


def kinds_of(source: str) -> Iterator[str]:
    """The kinds of all findings that a module makes: written there, or of a name that it gives texts to."""
    nodes = list(ast.walk(ast.parse(source)))
    for call in nodes:
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Finding"):
            continue
        first = call.args[0]
        given = [n.value for n in nodes if isinstance(n, ast.Assign) and ast.dump(n.targets[0]) == stored(first)]
        for place in given if isinstance(first, ast.Name) else [first]:
            yield from (n.value for n in ast.walk(place) if isinstance(n, ast.Constant))


def stored(name: ast.expr) -> str:
    """The name as the target of an assignment."""
    return ast.dump(name).replace("Load()", "Store()")


def test_every_kind_of_finding_has_a_row() -> None:
    sources = [p.read_text(encoding="utf-8") for p in (ROOT / "pipeline").rglob("*.py")]
    known = {kind for source in sources if "Finding(" in source for kind in kinds_of(source)}
    page = (ROOT / "docs" / "findings.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|(.*)$", page, re.MULTILINE)
    assert len(known) > 30
    assert sorted(kind for kind, _ in rows) == sorted(known)
    assert all(row.count("|") == 3 for _, row in rows)
