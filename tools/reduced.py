"""Write params.yaml again with small numbers and each law once: the same stages, done in a few minutes.

    python tools/reduced.py PARAMS.yaml

For a smoke run of the whole pipeline in a copy of the repository; its controllers are no good.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import yaml

# Key -> its value in a reduced run, wherever it stands in the file and only where it stands; a number only shrinks.
SMALL: dict[str, Any] = {
    "seeds": [0, 1],
    "samples": 3000,
    "batches": 40,
    "restarts": 300,
    "rows": 1500,
    "partitions": 10,
    "sweep": [4, 8],
    "hidden": [6, 6],
    "steps": 20,
    "free_run_iterations": 5,
    "long_run": 200,
    "sizes": [3, 5],
    "orders": [2, 3],
    "units": [4],
    "minutes": 0.1,
}
CERTIFICATE = {"loops": 10}  # of every case
LONG = {"jacket_pulses"}  # experiments whose records determine no model when they are short
TRAINER = {"kind": "lm", "iterations": 15}
TRAINING = {"iterations": 3, "restarts": 1}  # of laws that learn in closed loop
# Of a plant that `loopwright new` added, whose sections leave these to their defaults.
OWN_MODEL = {key: SMALL[key] for key in ("minutes", "rows", "units", "orders")}
# One without a search, the other searched over a few short loops.
OWN_LAW = {"predictive": {"tuning": "given"}, "pid": {"development_seeds": [1], "development_hold": 80}}


def reduced(tree: dict[str, Any]) -> dict[str, Any]:
    """The sections of params.yaml with the numbers of SMALL, and no more controllers than show every law and case."""
    found = fewer(with_small_own_plants(shrunk(tree)))
    for case in found["cases"].values():
        case["certificate"] = CERTIFICATE
    for controller in found["controllers"].values():
        controller["as_printed"] = True  # too small to be good: a lock-up must not end the smoke run
    return found


def with_small_own_plants(tree: dict[str, Any]) -> dict[str, Any]:
    """The sections with short searches for the models and the numbers of the laws of own plants."""
    own = set(tree.get("plants") or {})
    for entry in tree["models"].values():
        if entry["case"] in own:
            for part in entry["parts"].values():
                part |= OWN_MODEL
    for entry in tree["controllers"].values():
        if entry["case"] in own:
            entry |= OWN_LAW.get(entry["law"], {})
    return tree


def shrunk(tree: Any) -> Any:
    """``tree`` with the numbers of SMALL; networks train shortly, of the variants the first stays, of sizes two."""
    if not isinstance(tree, dict):
        return tree
    found = {key: _small(key, value) for key, value in tree.items()}
    if found.get("kind") in LONG:
        found["samples"] = tree["samples"]
    if found.get("kind") == "mlp" or "trainer" in found:
        found["trainer"] = TRAINER
    if "training" in found:
        found["training"] |= TRAINING
    if "search" in found:
        found["search"] = found["search"][:2]
    if "variants" in found:
        found["variants"] = dict(list(found["variants"].items())[:1])
    return found


def _small(key: str, value: Any) -> Any:
    if key not in SMALL:
        return shrunk(value)
    return min(value, SMALL[key]) if isinstance(value, int) else SMALL[key]


def fewer(tree: dict[str, Any]) -> dict[str, Any]:
    """Each law in the first case that has it, the first law of each case, and the model sets and records of these.

    An own plant keeps its controllers.
    """
    laws: set[str] = set()
    cases: set[str] = set()
    controllers, dropped = {}, set()
    for name, entry in tree["controllers"].items():
        own = entry["case"] in (tree.get("plants") or {})
        if entry["law"] in laws and entry["case"] in cases and not own:
            dropped.add((entry["case"], entry["model"]))
            continue
        laws.add(entry["law"])
        cases.add(entry["case"])
        controllers[name] = entry
    used = {(entry["case"], entry["model"]) for entry in controllers.values()}
    models = {
        name: entry
        for name, entry in tree["models"].items()
        if (entry["case"], entry["model"]) in used or (entry["case"], entry["model"]) not in dropped
    }
    data = {entry["data"] for entry in models.values()}
    records = {
        name: entry
        for name, entry in tree["records"].items()
        if f"work/{entry['case']}/records/{entry['record']}" in data
    }
    return {**tree, "records": records, "models": models, "controllers": controllers}


def main() -> None:
    """Rewrite the file named on the command line."""
    if len(sys.argv) != 2:
        sys.exit("usage: python tools/reduced.py PARAMS.yaml")
    path = Path(sys.argv[1])
    path.write_text(yaml.safe_dump(reduced(yaml.safe_load(path.read_text())), sort_keys=False))


if __name__ == "__main__":
    main()
