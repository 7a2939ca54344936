"""The stored bounds of a case: what ``pipeline.oracle`` computed, as long as it still applies."""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.cases import NOISE_SUFFIX, Case
from pipeline.errors import LawError
from pipeline.plants.base import Plant

SCHEMA = 1


def bounds_path(case: Case) -> Path:
    """Where the figures of a case are stored."""
    return Path(__file__).parent / "cases" / f"{case.name}.bounds.json"


def plant_digest(plant: Plant) -> str:
    """sha256 of the plant's equations, parameters and sampling; comments and layout do not count."""
    source = ast.parse(textwrap.dedent(inspect.getsource(type(plant).derivative)))
    function = source.body[0]
    if isinstance(function, ast.FunctionDef) and ast.get_docstring(function) is not None:
        function.body = function.body[1:]
    names = dict(zip(plant.parameter_names(), plant.parameters().tolist(), strict=True))
    what = [ast.unparse(source), names, plant.period_s, plant.time_unit_s, plant.substeps]
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def read_stored(path: Path) -> dict[str, Any]:
    """The file's content; empty where it is missing, damaged or of another schema."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return stored if isinstance(stored, dict) and stored.get("schema") == SCHEMA else {}


def load_bounds(case: Case, path: Path | None = None) -> dict[str, dict[str, dict[str, float]]]:
    """The bounds by scenario: ``{"sp_a": {"nmpc": {"mae": ...}, "offline": {...}}, "sp_a_noise": {"nmpc": ...}}``.

    Figures of several sequences are their means, ``max_asse`` and ``step_ms_p99`` their largest,
    ``failures`` their sum. Raises LawError where figures are missing or belong to another plant
    or scenario than the case has now.
    """
    path = path or bounds_path(case)
    stored = read_stored(path)
    remedy = f"run `python -m pipeline.oracle {case.name}` (about ten minutes on an idle core)"
    if not stored:
        raise LawError(f"{path} holds no bounds of case {case.name!r}; {remedy}")
    if stored.get("plant") != plant_digest(case.plant):
        raise LawError(f"the bounds in {path} belong to other equations or parameters of the plant; {remedy}")
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name, scenarios in case.scenarios().items():
        for kind in ("nmpc", "offline", "nmpc_noise"):
            rows = [stored["figures"].get(name, {}).get(s.digest(), {}).get(kind) for s in scenarios]
            missing = [s.seed for s, row in zip(scenarios, rows, strict=True) if row is None]
            if missing:
                which = f" (seeds {missing})" if missing[0] is not None else ""
                raise LawError(f"{path} has no {kind} figures of scenario {name!r}{which} as it is now; {remedy}")
            key = name + NOISE_SUFFIX if kind == "nmpc_noise" else name
            found.setdefault(key, {})[kind.removesuffix("_noise")] = _together(rows)
    return found


def _together(rows: list[dict[str, float]]) -> dict[str, float]:
    how: dict[str, Callable[[list[float]], float]] = {"max_asse": max, "step_ms_p99": max, "failures": sum}
    return {key: float(how.get(key, np.mean)([row[key] for row in rows])) for key in rows[0]}
