"""The numbers that the code was tuned to: each module's constants, with the unit and reason that stand beside them."""

from __future__ import annotations

import ast
import importlib
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from loopwright.pipeline.stages.code import PACKAGES
from manual.markdown import code, prose, table


class Threshold(NamedTuple):
    """A module-level number, as it is written, and what stands beside it."""

    name: str
    value: str
    why: str


def thresholds_of(source: str) -> Iterator[Threshold]:
    """The module-level numbers of a module, in the order of its lines."""
    body, remarks = ast.parse(source).body, _remarks(source)
    lines = source.splitlines()
    for i, node in enumerate(body):
        pairs = list(_pairs(node))
        if not pairs:
            continue
        after = body[i + 1] if i + 1 < len(body) else None
        text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
        own = [remarks[k] for k in range(node.lineno, (node.end_lineno or node.lineno) + 1) if k in remarks]
        above, k = list[str](), node.lineno - 1
        while k in remarks and lines[k - 1].lstrip().startswith("#") and not own:
            above.insert(0, remarks[k])
            k -= 1
        why = " ".join(" ".join(own or above or [str(text)]).split())
        yield from (Threshold(name, ast.unparse(value), why) for name, value in pairs)


def _pairs(node: ast.stmt) -> Iterator[tuple[str, ast.expr]]:
    """The names that a statement binds to numbers: one, or as many as a line has."""
    target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
    value = getattr(node, "value", None)
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        found = list(zip(target.elts, value.elts, strict=True))
    else:
        found = [(target, value)]
    for name, number in found:
        if isinstance(name, ast.Name) and name.id.isupper() and number is not None and _number(number):
            yield name.id, number


def thresholds() -> str:
    """A heading for each folder, a table for each of its modules that has numbers."""
    parts = []
    for package in PACKAGES:
        root = Path(importlib.import_module(package).__path__[0])
        folders = dict[Path, list[str]]()
        for file in sorted(root.rglob("*.py"), key=lambda file: (file.parent, file.name)):
            if file.parent.parent.name == "cases":  # these are its paper's
                continue
            numbers = thresholds_of(file.read_text(encoding="utf-8"))
            rows = [(code(t.name), code(t.value), prose(t.why)) for t in numbers]
            if rows:
                heading = f"### {file.stem}\n\n{table(['number', 'value', 'unit and reason'], rows)}"
                folders.setdefault(file.parent, []).append(heading)
        for folder, tables in folders.items():
            name = "/".join((root.name, *folder.relative_to(root).parts))
            parts.append("\n\n".join([f"## {name}/", *tables]))
    return "\n\n".join(parts)


def _remarks(source: str) -> dict[int, str]:
    """Line -> the comment on it; a title after dashes begins a section, and is no reason for a number."""
    found = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {t.start[0]: t.string.lstrip("# ") for t in found if t.type == tokenize.COMMENT}
    return {line: text for line, text in comments.items() if not text.startswith("---")}


def _number(value: ast.expr) -> bool:
    """Whether an expression is made of numbers alone."""
    if isinstance(value, ast.Constant):
        return isinstance(value.value, (int, float)) and not isinstance(value.value, bool)
    if isinstance(value, ast.UnaryOp):
        return _number(value.operand)
    if isinstance(value, ast.BinOp):
        return _number(value.left) and _number(value.right)
    return isinstance(value, (ast.Tuple, ast.List)) and bool(value.elts) and all(map(_number, value.elts))
