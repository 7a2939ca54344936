"""The architecture as the code has it: the floors of pyproject.toml, and who imports whom by grimp."""

from __future__ import annotations

import importlib
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import grimp

from loopwright.pipeline.stages.code import PIPELINE, SERVING
from manual.markdown import code, first_sentence, prose, table

ROOT = Path(__file__).parents[3]


@cache
def linted() -> dict[str, Any]:
    """The import contracts of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]


def layers() -> list[list[str]]:
    """The floors from the top down, names side by side on one floor."""
    (contract,) = (c for c in linted()["contracts"] if c["type"] == "layers")
    return [[name.strip() for name in line.split("|")] for line in contract["layers"]]


@cache
def imports() -> dict[str, set[str]]:
    """Folder of ``pipeline`` -> the folders, and ``serving``, that its modules import."""
    graph = grimp.build_graph(PIPELINE, SERVING, cache_dir=None)
    found: dict[str, set[str]] = {}
    for module in graph.modules:
        if module.startswith(f"{PIPELINE}."):
            own = module.split(".")[2]
            for other in graph.find_modules_directly_imported_by(module):
                parts = other.split(".")[1:]
                target = "serving" if parts[0] == "serving" else parts[1] if len(parts) > 1 else ""
                if target and target != own:
                    found.setdefault(own, set()).add(target)
    return found


def modules_of(name: str) -> int:
    """Number of Python files of a folder."""
    path = ROOT / "pipeline" / name
    return sum(1 for _ in path.rglob("*.py")) if path.is_dir() else 1


def _words(name: str) -> str:
    module = f"{PIPELINE}.{name}"
    return first_sentence(importlib.import_module(module).__doc__)


def floors() -> str:
    """The picture of the floors, and a row for each: words, size, what it imports."""
    names = [name for floor in layers() for name in floor]
    order = {name: i for i, name in enumerate([*names, "serving"])}
    rows = [
        (
            code(name),
            _words(name),
            str(modules_of(name)),
            ", ".join(code(n) for n in sorted(imports().get(name, ()), key=lambda n: order[n])) or "nothing",
        )
        for name in names
    ]
    picture = "\n".join(
        ["```{diagram} The floors of the pipeline, the upper ones import from the lower ones", "floors"]
    )
    picture += "\n" + "\n".join(" | ".join(floor) for floor in layers()) + "\n```"
    return "\n\n".join([picture, table(["folder", "what lives there", "files", "imports"], rows)])


def contracts() -> str:
    """The import contracts in words."""
    rows = []
    for c in linted()["contracts"]:
        about = {
            "forbidden": lambda c: (
                f"no module of {_names(c['source_modules'])} imports {_names(c['forbidden_modules'])}"
            ),
            "protected": lambda c: f"{_names(c['protected_modules'])}: only by {_names(c['allowed_importers'])}",
            "independence": lambda c: f"none of {_names(c['modules'])} imports another one",
            "layers": lambda c: "a folder imports only from floors below its own",
        }[c["type"]]
        rows.append((prose(c["name"]), about(c)))
    return table(["rule", "in full"], rows)


def _names(names: list[str]) -> str:
    return ", ".join(code(n) for n in names)
