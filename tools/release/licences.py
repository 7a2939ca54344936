"""Licences of packages: from what their metadata says to an SPDX expression, and how far it is copyleft.

The kinds of licence come from the database of the package ``license_expression``. Of a choice (OR) the least demanding
part counts, of parts that all hold (AND) the most demanding one.
"""

from __future__ import annotations

import json
import tomllib
from enum import IntEnum
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from license_expression import ExpressionError, LicenseExpression, LicenseWithExceptionSymbol, get_spdx_licensing

REVIEWED = Path(__file__).with_name("reviewed.toml")
BSD = "BSD, clauses not stated"
# Words of metadata that state one licence.
WORDS = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "BSD": BSD,
    "OSI Approved :: Apache Software License": "Apache-2.0",
    "OSI Approved :: BSD License": BSD,
    "OSI Approved :: GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
    "OSI Approved :: MIT License": "MIT",
    "OSI Approved :: Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "OSI Approved :: Python Software Foundation License": "PSF-2.0",
}
SPDX = get_spdx_licensing()


class Kind(IntEnum):
    """How much a licence asks of who passes the package on."""

    PERMISSIVE = 0
    WEAK = 1  # copyleft of the package's own files, or of the library
    STRONG = 2  # copyleft of the whole program
    OTHER = 3  # neither: proprietary, or not for every use


CATEGORIES = {
    "Permissive": Kind.PERMISSIVE,
    "Public Domain": Kind.PERMISSIVE,
    "Copyleft Limited": Kind.WEAK,
    "Copyleft": Kind.STRONG,
}


class UnclearError(Exception):
    """The metadata of a package states no licence, or several in words that leave open how they go together."""


def licence(package: dict[str, Any], reviewed: dict[str, Any]) -> str:
    """The SPDX expression of a package of closure.py, or ``BSD``. Raises UnclearError."""
    name, own = package["name"], stated(package)
    if name in reviewed:
        if own is not None:
            raise UnclearError(f"{name} {package['version']} states {own} itself: drop it from {REVIEWED.name}")
        return str(reviewed[name]["expression"])
    if own is None:
        raise UnclearError(
            f"{name} {package['version']}: its metadata leaves the licence open; read its text, "
            f"and write what it says into tools/release/{REVIEWED.name}"
        )
    return own


def stated(package: dict[str, Any]) -> str | None:
    """What the metadata itself states; None where it leaves the licence open."""
    for text in (package["expression"], package["licence"]):
        if text and parsed(text) is not None:
            return str(text)
    named = [c for c in package["classifiers"] if c != "OSI Approved"]
    if len(named) == 1 and "|" not in package["licence"] and named[0] in WORDS:
        return WORDS[named[0]]
    return WORDS.get(package["licence"]) if not named else None


def parsed(text: str) -> LicenseExpression | None:
    """The expression, if the text is one of SPDX."""
    try:
        return SPDX.parse(text, validate=True) if len(text) < 500 else None
    except ExpressionError:
        return None


def kind(text: str) -> Kind:
    """How far a licence is copyleft."""
    if text == BSD:
        return Kind.PERMISSIVE
    expression = parsed(text)
    if expression is None:
        raise UnclearError(f"{text!r} is no SPDX expression")
    return _kind(expression)


def has_choice(text: str) -> bool:
    """Whether one may choose among licences, some of them more demanding than the choice that counts."""
    expression = parsed(text)
    return expression is not None and any(
        _kind(s) > _kind(expression) for s in SPDX.license_symbols(expression, decompose=False)
    )


def _kind(expression: LicenseExpression) -> Kind:
    parts = [_kind(part) for part in getattr(expression, "args", ())]
    if parts:
        return min(parts) if isinstance(expression, SPDX.OR) else max(parts)
    if isinstance(expression, LicenseWithExceptionSymbol):  # which takes some of the demands back
        return min(_kind(expression.license_symbol), Kind.WEAK)
    return _categories().get(expression.key.lower(), Kind.OTHER)


@cache
def _categories() -> dict[str, Kind]:
    rows = json.loads((resources.files("license_expression") / "data/scancode-licensedb-index.json").read_text())
    found = {}
    for row in rows:
        for key in (row["spdx_license_key"], *row["other_spdx_license_keys"]):
            if key:
                found[key.lower()] = CATEGORIES.get(row["category"], Kind.OTHER)
    return found


def reviewed_of(packages: list[dict[str, Any]]) -> dict[str, Any]:
    """The entries of reviewed.toml. Raises UnclearError for one whose package is not brought."""
    entries = tomllib.loads(REVIEWED.read_text())
    gone = sorted(entries.keys() - {package["name"] for package in packages})
    if gone:
        raise UnclearError(f"{', '.join(gone)}: no extra brings it: drop it from {REVIEWED.name}")
    return entries
