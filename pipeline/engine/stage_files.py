"""Files that a stage of dvc.yaml reads and writes, so that a worker that has none of them can run it.

``deps`` and ``outs`` are DVC's. Under ``meta`` a stage that runs on the cluster lists what it reads beside them
(``reads``: nothing that decides a result), or replaces without owning it (``replaces``).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

DVC_FILE, PARAMS_FILE = Path("dvc.yaml"), Path("params.yaml")
DATA = Path("work/code/data.json")  # case -> files of own plants that dvc.yaml cannot list
EVERY = "*"  # in place of a case: what the stages of all need
_FIELD = re.compile(r"\$\{([\w.]+)\}")


@dataclass(frozen=True)
class StageFiles:
    """Files that a stage finds in its folder, and those that are new afterwards."""

    reads: tuple[Path, ...]
    writes: tuple[Path, ...]


def on_cluster(kind: str, name: str) -> StageFiles | None:
    """The files of a stage that runs on the cluster; None for one that runs where it was started."""
    if not DVC_FILE.is_file() or not PARAMS_FILE.is_file():
        return None
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    stage = yaml.load(DVC_FILE.read_text(encoding="utf-8"), Loader=loader)["stages"].get(kind)
    if stage is None or "meta" not in stage.get("do", stage):
        return None
    params = yaml.load(PARAMS_FILE.read_text(encoding="utf-8"), Loader=loader) or {}
    items = params.get(_FIELD.fullmatch(stage["foreach"])[1]) if "foreach" in stage else {}  # type: ignore[index]
    if not isinstance(items, dict) or name not in items:
        return None  # the stage says so
    values = {"key": name, "item": items[name]}
    entry = stage.get("do", stage)

    def paths(listed: Any) -> list[Path]:
        names = [next(iter(entry)) if isinstance(entry, dict) else entry for entry in listed or ()]
        return [Path(_FIELD.sub(lambda found: str(_value(values, found[1])), n)) for n in names]

    outs, replaced = paths(entry.get("outs")), paths(entry["meta"].get("replaces"))
    reads = [PARAMS_FILE, *paths(entry.get("deps")), *paths(entry["meta"].get("reads")), *replaced]
    reads += _data(str(items[name].get("case", "")))
    return StageFiles(tuple(reads), tuple(outs))


def _value(values: Mapping[str, Any], name: str) -> Any:
    found: Any = values
    for part in name.split("."):
        found = found[part]
    return found


def _data(case: str) -> list[Path]:
    try:
        found = json.loads(DATA.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return [Path(name) for of in (EVERY, case) for name in found.get(of, ())]
