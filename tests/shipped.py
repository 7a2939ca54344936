"""The numbers that params.yaml gives a law: what a law needs without a default comes from there."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

from loopwright.pipeline.config.params import parse, read_section, sections
from loopwright.pipeline.laws import LAWS

PARAMS = Path(__file__).parents[1] / "params.yaml"


@cache
def required(law: str) -> dict[str, Any]:
    """The parameters without a default, as the first controller of this law has them."""
    cls = LAWS[law].Params
    names = {
        f.name
        for f in dataclasses.fields(cls)
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    }
    if not names:
        return {}
    every = {n: read_section("controllers", n, PARAMS) for n in sections("controllers", PARAMS)}
    name = next((n for n, section in every.items() if section["law"] == law and names <= set(section)), None)
    assert name, f"law {law!r} needs {sorted(names)}, and no controller of params.yaml gives them; add a section"
    section = every[name]
    found = parse(cls, {key: section[key] for key in names}, name)
    return {key: getattr(found, key) for key in names}
