"""The stored bounds of a case: what ``loopwright.pipeline.stages.bounds`` computed, as long as it still applies."""

from __future__ import annotations

import inspect
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.evaluation.case import Case, Effort
from loopwright.pipeline.evaluation.metric import together
from loopwright.pipeline.plants.equations import EquationPlant, equations
from loopwright.pipeline.plants.plant_digest import equations_digest
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario

Bounds = dict[str, dict[str, dict[str, float]]]
BOUNDS_SCHEMA = 1  # of the file: a reader refuses another
DEFAULTS: dict[str, Any] = {
    "metric": "mae",
    "recipe": False,
    "unforeseen": False,
    "limits": {},
    "effort": json.loads(json.dumps(asdict(Effort()))),
}
"""The values of entries that a file leaves out."""


def bounds_path(case: Case) -> Path:
    """Where the figures of a case are stored: bounds.json beside its case.py, bounds_15s.json beside case_15s.py."""
    module = Path(inspect.getfile(type(case)))
    return module.with_name(module.stem.replace("case", "bounds", 1) + ".json")


def kinds(case: Case) -> tuple[str, ...]:
    """The figures to compute: nmpc, offline, and nmpc_noise where the measured states are worth stepping on.

    Elsewhere the NMPC is given the state itself, which noise on the measurement does not reach: an
    observer for it would be one more controller, and no bound. So it is where samples follow
    one another quickly, and an NMPC without a filter is busy with the noise (``Effort.noisy``).
    """
    noisy = isinstance(case.plant, EquationPlant) and case.plant.measures_states and case.effort.noisy
    return ("nmpc", "offline", "nmpc_noise") if noisy else ("nmpc", "offline")


def problem(case: Case) -> dict[str, Any]:
    """Everything that a case's bounds depend on, beside the scenarios: stored, and compared with what is stored."""
    aim = {key: getattr(case, key) for key in DEFAULTS} | {"limits": dict(case.limits), "effort": asdict(case.effort)}
    as_read: dict[str, Any] = json.loads(json.dumps(aim))
    return {"plant": equations_digest(equations(case.plant, f"a bound of case {case.name!r}")), **as_read}


def bounded(case: Case, scenarios: Sequence[Scenario]) -> bool:
    """Whether a test has bounds: not where it runs on a map from sample to sample, which no solver here plans over."""
    plants = (type(s.plant or case.plant) for s in scenarios)
    return all(issubclass(p, EquationPlant) and p.transition is EquationPlant.transition for p in plants)


def read_stored(path: Path) -> dict[str, Any]:
    """The file's content; empty where it is missing, damaged or of another schema."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return stored if isinstance(stored, dict) and stored.get("schema") == BOUNDS_SCHEMA else {}


def stored_bounds(case: Case, path: Path | None = None) -> tuple[Bounds, list[str]]:
    """The bounds that are there, and a sentence for each figure that is missing.

    By scenario: ``{"held_out": {"nmpc": {"mae": ...}, "offline": {...}}, ...}``.
    Figures of several sequences are put ``together``; where one sequence's are missing, so is the test's.
    Where ``kinds`` has no ``nmpc_noise``, the NMPC's figures with noise are those without. Tests without
    bounds (``bounded``) are left out. Raises LawError where the file holds no bounds, or those of another
    plant, metric or effort than the case has now.
    """
    path = path or bounds_path(case)
    stored = read_stored(path)
    remedy = f"run `loopwright bounds {case.name}` (some minutes on an idle core)"
    if not stored:
        raise LawError(f"{path} holds no bounds of case {case.name!r}; {remedy}")
    current = problem(case)
    if stored.get("plant") != current["plant"]:
        raise LawError(f"the bounds in {path} belong to other equations or parameters of the plant; {remedy}")
    for key, default in DEFAULTS.items():
        if stored.get(key, default) != current[key]:
            was = f"{key} {stored.get(key, default)!r}, and the case has {current[key]!r}"
            raise LawError(f"the bounds in {path} were computed for the {was}; {remedy}")
    bounds: Bounds = {}
    absent: list[str] = []
    for name, scenarios in case.scenarios().items():
        for kind in kinds(case) if bounded(case, scenarios) else ():
            rows = [stored["figures"].get(name, {}).get(s.digest(), {}).get(kind) for s in scenarios]
            missing = [s.seed for s, row in zip(scenarios, rows, strict=True) if row is None]
            if missing:
                which = f" (seeds {missing})" if missing[0] is not None else ""
                absent.append(f"{path} has no {kind} figures of scenario {name!r}{which} as it is now; {remedy}")
                continue
            key = name + NOISE_SUFFIX if kind == "nmpc_noise" else name
            bounds.setdefault(key, {})[kind.removesuffix("_noise")] = together(rows, case.metrics)
        if "nmpc" in bounds.get(name, {}):
            bounds.setdefault(name + NOISE_SUFFIX, {"nmpc": dict(bounds[name]["nmpc"])})
    return bounds, absent
