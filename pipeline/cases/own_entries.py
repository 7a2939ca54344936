"""What params.yaml holds for an own plant: `loopwright new` writes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.cases.own_ensemble import LAW_PART, MODEL_SET
from pipeline.config.exports import ExportParams, screened_record

MEMBER_NUMBERS = (1, 2)


def entries_of(name: str, plant: Mapping[str, Any], export: ExportParams | None = None) -> dict[str, dict[str, Any]]:
    """The entries of params.yaml for an own plant: its section, its tests, its models, and two controllers.

    With ``export`` its files too, of which stage `screen` makes the record; without, ``plant`` says where that is.
    """
    from pipeline.models.identified.structure_search import MINUTES  # here, because torch takes seconds to load

    # The default, written out: all members share one search, so that they must have the same number.
    minutes = {"minutes": MINUTES * min(len(plant["pv"]), len(plant["mv"]))}
    members = {f"plant{k}": {"kind": LAW_PART, "member": k, **minutes} for k in MEMBER_NUMBERS}
    parts = {LAW_PART: {"kind": LAW_PART, **minutes}, **members}
    own = {"case": name, "model": MODEL_SET}
    data = screened_record(name).as_posix() if export else plant["data"]
    return {
        **({"exports": {name: export.to_dict()}} if export else {}),
        "plants": {name: dict(plant)},
        "cases": {name: {"held_out_seeds": [9001, 9002, 9003], "noise_seed": 1}},
        "models": {f"{name}-{MODEL_SET}": {**own, "data": data, "parts": parts}},
        "controllers": {
            f"{name}-predictive": {**own, "name": "predictive", "law": "predictive", "tuning": "search"},
            f"{name}-pid": {**own, "name": "pid", "law": "pid"},
        },
    }
