"""What each extra of loopwright brings, read from the packages installed here: ``python closure.py > closure.json``.

A row is a package with its version, the extras that bring it ("runtime" is no extra), and what its metadata says of its
licence. The extras dev and docs are left out: they are for who works on the repository.
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

NAME, RUNTIME, DEVELOPERS = "loopwright", "runtime", ("dev", "docs")
LICENCE = "License :: "


def closure() -> list[dict[str, Any]]:
    """A row for each package, by name. Raises SystemExit where one that an extra asks for is not installed here."""
    ours = distribution(NAME)
    extras = [e for e in ours.metadata.get_all("Provides-Extra") or [] if e not in DEVELOPERS]
    brought = {name: brings(ours, extra) for name, extra in ((RUNTIME, ""), *((e, e) for e in extras))}
    return [
        {"name": package, "by": [extra for extra, names in brought.items() if package in names], **_said(package)}
        for package in sorted(set().union(*brought.values()))
    ]


def brings(of: Distribution, extra: str) -> set[str]:
    """The packages that come with ``of`` and one of its extras, at whatever depth."""
    found: set[tuple[str, str]] = set()
    todo = _asked(of, extra)
    while todo:
        package, extra = pair = todo.pop()
        if pair not in found:
            found.add(pair)
            todo += _asked(_installed(package), extra)
    return {package for package, _ in found}


def _asked(of: Distribution, extra: str) -> list[tuple[str, str]]:
    """Package and extra of each requirement that holds here; "" for no extra."""
    asked = []
    for line in of.requires or []:
        wanted = Requirement(line)
        if wanted.marker is None or wanted.marker.evaluate({"extra": extra}):
            name = canonicalize_name(wanted.name)
            asked += [(name, ""), *((name, e) for e in wanted.extras)]
    return asked


def _installed(package: str) -> Distribution:
    try:
        return distribution(package)
    except PackageNotFoundError:
        raise SystemExit(f"closure: {package} is not installed here; `make setup` installs every extra") from None


def _said(package: str) -> dict[str, Any]:
    metadata = _installed(package).metadata
    return {
        "version": metadata["Version"],
        "expression": metadata.get("License-Expression"),
        "classifiers": [c.removeprefix(LICENCE) for c in metadata.get_all("Classifier") or [] if c.startswith(LICENCE)],
        "licence": (metadata.get("License") or "").strip(),
    }


if __name__ == "__main__":
    json.dump(closure(), sys.stdout, indent=1)
