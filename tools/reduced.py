"""Write params.yaml again with small numbers: the same stages, done in a few minutes.

    python tools/reduced.py PARAMS.yaml

For a smoke run of the whole pipeline in a copy of the repository; its controllers are no good.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import yaml

# Key -> its value in a reduced run, wherever it stands in the file and only where it stands.
SMALL: dict[str, Any] = {
    "seeds": [0, 1],
    "samples": 3000,
    "restarts": 300,
    "rows": 1500,
    "partitions": 10,
    "sweep": [4, 8],
    "hidden": [6, 6],
}
TRAINER = {"kind": "lm", "iterations": 15}


def reduced(tree: Any) -> Any:
    """``tree`` with the numbers of SMALL; networks train for a few iterations only."""
    if isinstance(tree, dict):
        found = {key: SMALL.get(key, reduced(value)) for key, value in tree.items()}
        if found.get("kind") == "mlp":
            found["trainer"] = TRAINER
        if "variants" in found:
            found["variants"] = dict(list(found["variants"].items())[:1])
        return found
    return tree


def main() -> None:
    """Rewrite the file named on the command line."""
    if len(sys.argv) != 2:
        sys.exit("usage: python tools/reduced.py PARAMS.yaml")
    path = Path(sys.argv[1])
    path.write_text(yaml.safe_dump(reduced(yaml.safe_load(path.read_text())), sort_keys=False))


if __name__ == "__main__":
    main()
