"""How laws and tests are called in front of a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.pictures.numbers import number, ratio
from pipeline.simulation.scenario import NOISE_SUFFIX

__all__ = [
    "law_label",
    "law_name",
    "number",
    "ratio",
    "scenario_name",
    "setting_text",
]

WORDS = frozenset({"two"})
"""Short words in the names of laws that are no abbreviations."""


def law_name(law: str) -> str:
    """``linearized_pid`` as linearized PID, ``inc`` as INC: a law's abbreviations are upper-case."""
    parts = law.split("_")
    return " ".join(p.upper() if (len(p) <= 3 or len(parts) == 1) and p not in WORDS else p for p in parts)


def law_label(law: str, setting: Mapping[str, Any]) -> str:
    """A law with its setting: INCAD (r=2.5)."""
    return law_name(law) + (f" ({setting_text(setting)})" if setting else "")


def setting_text(setting: Mapping[str, Any]) -> str:
    """``r=2.5, correction=back_calculation``: how params.yaml names a variant."""
    return ", ".join(
        key if value is True else f"{key}={value:g}" if isinstance(value, int | float) else f"{key}={value}"
        for key, value in setting.items()
    )


def scenario_name(scenario: str, recipe: bool, own: Mapping[str, str] | None = None) -> str:
    """A test inside a sentence: held-out set points, set point with noise; ``own`` is ``Case.test_words``."""
    bare = scenario.removesuffix(NOISE_SUFFIX)
    if own and bare in own:
        words = own[bare]
    elif bare == "held_out":
        words = "held-out recipes" if recipe else "held-out set points"
    else:
        words = bare.replace("_", " ")
    return words + (" with noise" if scenario != bare else "")
