"""How laws and tests are called in front of a person."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from loopwright.pipeline.evaluation.case import Curve, Setting
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import BASE
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

WORDS = frozenset({"old", "predictive", "two"})
"""Words in the names of laws that are no abbreviations."""


def law_name(law: str) -> str:
    """``linearized_pid`` as linearized PID, ``inc`` as INC: a law's abbreviations are upper-case."""
    parts = law.split("_")
    return " ".join(p.upper() if (len(p) <= 3 or len(parts) == 1) and p not in WORDS else p for p in parts)


def law_label(law: str, words: str) -> str:
    """A law with its setting in words: INCAD (r=2.5)."""
    return law_name(law) + (f" ({words})" if words else "")


def curve_label(evidence: Evidence, curve: Curve) -> str:
    """A form of a law, by the variant's name in params.yaml; by its setting, where that is the shipped one or none."""
    law = evidence.laws.get(curve.law)
    form = None if law is None else law.form_of(curve.setting)
    return law_label(curve.law, setting_text(curve.setting) if form in (None, BASE) else str(form))


def setting_text(setting: Setting) -> str:
    """``r=2.5, correction=back_calculation, adaptive``."""
    return ", ".join(
        key if value is True else f"{key}={value}" if isinstance(value, str) else f"{key}={value:g}"
        for key, value in setting.items()
    )


def given_text(settings: Mapping[str, Any]) -> str:
    """``tuning = search, cv_high = [80, null]``: settings as params.yaml has them, each of them."""
    return ", ".join(f"{k} = {v if isinstance(v, str) else json.dumps(v)}" for k, v in settings.items())


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
