"""A name means one thing: no two public classes of the project share one, and no two modules one of a number."""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "_ext"))

from manual.thresholds import thresholds_of  # noqa: E402

# The light controller, and the one that also judges whom to trust: who uses one need not know which.
SHARED = {"Controller"}
# A day's seconds: the runtime and the reading of dates know them, and the runtime may not import the pipeline.
SHARED_NUMBERS = {"DAY_S"}


def test_no_two_public_classes_share_a_name() -> None:
    found: dict[str, list[str]] = defaultdict(list)
    for folder in ("pipeline", "serving"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.parse(file.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found[node.name].append(str(file.relative_to(ROOT)))
    twice = {name: files for name, files in found.items() if len(files) > 1 and name not in SHARED}
    assert len(found) > 300
    assert not twice


def test_no_two_modules_name_a_number_alike() -> None:
    found: dict[str, list[str]] = defaultdict(list)
    for folder in ("pipeline", "serving"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            if file.parent.parent.name != "cases":  # these are its paper's
                for number in thresholds_of(file.read_text(encoding="utf-8")):
                    found[number.name].append(str(file.relative_to(ROOT)))
    twice = {name: files for name, files in found.items() if len(set(files)) > 1 and name not in SHARED_NUMBERS}
    assert len(found) > 900
    assert not twice
    assert all(len(found[name]) > 1 for name in SHARED_NUMBERS)
