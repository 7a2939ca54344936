"""A name means one thing: no two public classes of the project share one, and no two modules one of a number."""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "_ext"))

from manual.thresholds import thresholds_of  # noqa: E402

# The light controller, and the one that also judges whom to trust: who uses one need not know which.
SHARED = {"Controller"}
# A day's seconds: the runtime and the reading of dates know them, and the runtime may not import the pipeline.
SHARED_NUMBERS = {"DAY_S"}


def places_of(names: Callable[[str], Iterator[str]], *, cases: bool) -> dict[str, list[str]]:
    """Name -> the files of pipeline and serving that define it; those of papers' cases only with ``cases``."""
    found: dict[str, list[str]] = defaultdict(list)
    for file in (f for folder in ("pipeline", "serving") for f in sorted((ROOT / folder).rglob("*.py"))):
        if cases or file.parent.parent.name != "cases":
            for name in names(file.read_text(encoding="utf-8")):
                found[name].append(str(file.relative_to(ROOT)))
    return found


def public_classes(source: str) -> Iterator[str]:
    nodes = ast.parse(source).body
    return (node.name for node in nodes if isinstance(node, ast.ClassDef) and not node.name.startswith("_"))


def numbers(source: str) -> Iterator[str]:
    return iter({number.name for number in thresholds_of(source)})


@pytest.mark.parametrize(
    ("names", "cases", "least", "shared"),
    [(public_classes, True, 300, SHARED), (numbers, False, 900, SHARED_NUMBERS)],
    ids=["classes", "numbers"],
)
def test_no_two_modules_define_one_name(
    names: Callable[[str], Iterator[str]], cases: bool, least: int, shared: set[str]
) -> None:
    found = places_of(names, cases=cases)
    assert len(found) > least
    assert {name for name, files in found.items() if len(files) > 1} == shared
