"""Stage code: ``python -m pipeline.stages.code`` lists what every other stage runs, file by file.

work/code/<stage>-<case>.json (<stage>.json of a stage over all cases) holds the sha256 of each file
of ``pipeline`` and ``serving`` that the stage imports, at whatever depth. The stage depends on that
one file, so that an edit runs again what it has a part in and nothing else. Named one by one in
dvc.yaml they would be 20 entries a stage, in a dvc.lock that DVC reads and writes again after every
stage.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from pipeline.stages import WORK, write_json

PACKAGES = ("pipeline", "serving")
STAGES = ("excite", "fit", "design", "validate", "report")  # of one case each
LAST = ("overview", "publish")
# What carries a stage's work from place to place and has no part in its result.
CARRIERS = {
    "pipeline",
    "pipeline.command",
    "pipeline.errors",
    "pipeline.parallel",
    "pipeline.params",
    "pipeline.stages",
    "serving",
    "serving.errors",
}
# Stage -> modules that have no part in its result, by what imports them ("" is anything).
APART = {
    # Which tests a case has does not change its plant.
    "excite": {("", "pipeline.cases.base"), ("", "serving.manifest")},
    "fit": {("", "pipeline.cases.base"), ("", "serving.manifest")},
    "design": {
        ("", "pipeline.cases.base"),
        # What trained the models has had its effect.
        *(("pipeline.models", f"pipeline.{name}") for name in ("metrics", "record", "record_file")),
        # The parity gate says whether the runtime agrees with the law, and changes nothing.
        *(("", f"serving.{name}") for name in ("controller", "graph_audit")),
    },
}
# Of these packages, which list the cases, a stage runs its own case's module and what that one is made of.
BY_CASE = {"pipeline.cases", "pipeline.report.claims"}
# Files that are read and not imported.
DATA = {
    "report": ("pipeline/report/templates/*", "pipeline/cases/{case}.bounds.json"),
    "overview": ("pipeline/report/templates/*",),
}


def code() -> None:
    """Write work/code: one file for each stage of each case, one for each of those at the end."""
    root = Path.cwd()
    for stage in LAST:
        write_json(WORK / "code" / f"{stage}.json", listing(root, stage))
    for case in cases(root):
        for stage in STAGES:
            write_json(WORK / "code" / f"{stage}-{case}.json", listing(root, stage, case))


def cases(root: Path) -> list[str]:
    """The cases, by the modules that their list imports."""
    named = (m.removeprefix("pipeline.cases.") for m in imports(root, "pipeline.cases"))
    return sorted(name for name in named if name != "base")


def listing(root: Path, stage: str, case: str = "") -> dict[str, str]:
    """Path -> sha256 of every file that the stage runs or reads (for the case)."""
    found = {path_of(root, module) for module in modules(root, stage, case)}
    for pattern in DATA.get(stage, ()):
        found |= set(root.glob(pattern.format(case=case)))
    return {p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(found)}


def modules(root: Path, stage: str, case: str = "") -> set[str]:
    """The modules that have a part in the stage's result, by what imports what."""
    apart = APART.get(stage, set())
    found: set[str] = set()
    todo = [f"pipeline.stages.{stage}"]
    while todo:
        module = todo.pop()
        found.add(module)
        used = imports(root, module)
        own = {f"{package}.{case}" for package in BY_CASE if package in used}
        used |= {m for m in own if path_of(root, m).exists()}
        left = (
            m
            for m in used - found - CARRIERS - BY_CASE
            if not any(module.startswith(w) and m == what for w, what in apart)
        )
        todo += left
    return found


@cache
def imports(root: Path, module: str) -> frozenset[str]:
    """The modules of this repository that a module imports, wherever in its text."""
    tree = ast.parse(path_of(root, module).read_text(encoding="utf-8"))
    return frozenset(m for m in _named(root, tree) if m.partition(".")[0] in PACKAGES)


def _named(root: Path, tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if path_of(root, inner).exists() else node.module


def path_of(root: Path, module: str) -> Path:
    """The file of a module, whether there or not; of a package its __init__.py."""
    path = root.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


if __name__ == "__main__":
    code()
