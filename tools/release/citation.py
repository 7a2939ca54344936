"""Check CITATION.cff against the schema of its format: ``python citation.py``."""

from __future__ import annotations

import json
import sys
from importlib.metadata import files
from pathlib import Path

import jsonschema
import yaml

ROOT = Path(__file__).parents[2]


def main() -> int:
    """2 after a line on standard error for each entry that the format does not allow."""
    entries = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    end = f"{entries['cff-version']}/schema.json"
    schema = next(f for f in files("cffconvert") or () if f.as_posix().endswith(end))
    checks = jsonschema.Draft7Validator(json.loads(schema.read_text()))
    wrong = [f"CITATION.cff: {error.json_path}: {error.message}" for error in checks.iter_errors(entries)]
    for line in wrong:
        print(line, file=sys.stderr)
    return 2 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
