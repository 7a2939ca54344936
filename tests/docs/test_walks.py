"""The walks of docs/walks.md lead through files and functions that are there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "walks.md"
STEP = re.compile(r"\[[\w.]+\]\((\.\./[\w/]+\.py)\)\s+`(\w+)`")


def test_every_walk_has_a_drawing_and_steps() -> None:
    walks = PAGE.read_text(encoding="utf-8").split("\n## ")[1:]
    assert len(walks) == 4
    for walk in walks:
        assert "```{diagram}" in walk
        assert len(re.findall(r"^\d\. ", walk, re.MULTILINE)) >= 5


@pytest.mark.parametrize(("file", "name"), STEP.findall(PAGE.read_text(encoding="utf-8")))
def test_a_step_names_what_its_file_defines(file: str, name: str) -> None:
    tree = ast.parse((PAGE.parent / file).read_text(encoding="utf-8"))
    defined = {node.name for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    assert name in defined
