"""Entries of params.yaml for an own plant: `loopwright new` writes them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from loopwright.pipeline.cases.own_model import LAW_PART, MODEL_SET
from loopwright.pipeline.config.exports import ExportParams, screened_record
from loopwright.pipeline.config.params import read_section, sections_of
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.records.old_loops import OldController

MEMBER_NUMBERS = (1, 2)  # of the models beside the law's own, on which its tests run
OLD_LOOP = "old_loop"
"""The plant's own controller, as its record shows it, among the controllers of params.yaml."""


def entries_of(
    name: str,
    plant: Mapping[str, Any],
    export: ExportParams | None = None,
    old: Sequence[OldController] = (),
    operate: Mapping[str, float] | None = None,
) -> dict[str, dict[str, Any]]:
    """The entries of params.yaml for an own plant: its section, its tests, its models, and its controllers.

    These are two of ours, or predictive control alone where a controlled variable is an analyser, and with believed
    ``old`` ones of all controlled variables the loop that they make up. With ``export`` its files too, of which stage
    `screen` makes the record; without, ``plant`` says where that is. With the defaults of ``operate``, which may be
    none, operators change the predictive law while it runs, and its model has all process variables as outputs.
    """
    from loopwright.pipeline.models.identified.structure_search import (
        MINUTES,  # here, because torch takes seconds to load
    )

    # The default, written out: all members share one search, so that they must have the same number.
    n_cv = plant.get("controlled") or min(len(plant["pv"]), len(plant["mv"]))
    ranged = operate is not None and n_cv < len(plant["pv"])
    minutes = {"minutes": MINUTES * (len(plant["pv"]) if ranged else n_cv)}
    search = {"kind": LAW_PART, **({"outputs": "measured"} if ranged else {})}
    members = {f"plant{k}": {**search, "member": k, **minutes} for k in MEMBER_NUMBERS}
    parts = {LAW_PART: {**search, **minutes}, **members}
    steered = {} if operate is None else {"operate": dict(operate)}
    own = {"case": name, "model": MODEL_SET}
    data = screened_record(name).as_posix() if export else plant["data"]
    loops = loops_of(plant, old)
    # A PID winds up on a number that stands: none is built for an analyser.
    seldom = any(s.get("every", 1) > 1 for s in plant["pv"][:n_cv])
    pid = {} if seldom else {f"{name}-pid": {**own, "name": "pid", "law": "pid", **_pairs(loops)}}
    believed = bool(loops) and all(law.believed for law in loops)
    before = {f"{name}-{OLD_LOOP}": {**own, "name": OLD_LOOP, **_as_pid(loops), **_pairs(loops)}} if believed else {}
    return {
        **({"exports": {name: export.to_dict()}} if export else {}),
        "plants": {name: dict(plant)},
        "cases": {name: {"held_out_seeds": [9001, 9002, 9003], "noise_seed": 1}},
        "models": {f"{name}-{MODEL_SET}": {**own, "data": data, "parts": parts}},
        "controllers": {
            f"{name}-predictive": {**own, "name": "predictive", "law": "predictive", "tuning": "search", **steered},
            **pid,
            **before,
        },
    }


def loops_of(plant: Mapping[str, Any], old: Sequence[OldController]) -> tuple[OldController, ...]:
    """The old loop of each controlled variable, in their order; none unless each is known and has an MV of its own.

    Its MV is known by the names of the tags, or where its law is believed.
    """
    n = plant.get("controlled") or min(len(plant["pv"]), len(plant["mv"]))
    known = {law.pv: law for law in old if law.same_name or law.believed}
    loops = tuple(known[s["name"]] for s in plant["pv"][:n] if s["name"] in known)
    return loops if len({law.mv for law in loops}) == n else ()


def _pairs(loops: Sequence[OldController]) -> dict[str, dict[str, str]]:
    """The pairs of several loops; a mapping of its own each time, or YAML would write a reference to the first."""
    return {"pairs": {law.mv: law.pv for law in loops}} if len(loops) > 1 else {}


def _as_pid(loops: Sequence[OldController]) -> dict[str, Any]:
    """Settings of law `pid`: a number for one loop, a list for several."""
    fields = ("kc", "ti_s", "td_s", "set_point_weight")
    numbers = {name: [float(f"{getattr(law, name):.4g}") for law in loops] for name in fields}
    return {"law": "pid", "tuning": "manual", **{k: v[0] if len(v) == 1 else v for k, v in numbers.items()}}


# ---------------------------------------------------------------------------------- what a case reads of these entries
def sign_held(name: str, params: PlantParams) -> dict[str, int]:
    """PV -> sign of the gain of its old PI, of a plant of one loop; empty where that is not known.

    An integral part that held its PV has the sign of the plant's own steady gain: with the other one the loop would
    have run away. With several loops it is the sign with the others at work, which need not be that of the plant.
    """
    if len(params.mv) > 1 or f"{name}-{OLD_LOOP}" not in sections_of("controllers", name):
        return {}
    kc = read_section("controllers", f"{name}-{OLD_LOOP}").get("kc")
    return {params.pv[0].name: 1 if kc > 0 else -1} if isinstance(kc, int | float) and kc else {}


def kept_ranges(name: str, params: PlantParams) -> dict[str, tuple[float, float]]:
    """PV -> the range that the laws of the plant keep from their start, by their ``operate`` in params.yaml.

    A set point that asks for a rest beyond it would have to be missed, by the bound's control as well. An entry that is
    no number is left to the law's design, which says so; a PV for which two laws have ranges apart has none here.
    """
    found = {s.name: (-math.inf, math.inf) for s in params.pv}
    for key in sections_of("controllers", name):
        operate = read_section("controllers", key).get("operate")
        given = {
            k: v for k, v in (operate if isinstance(operate, Mapping) else {}).items() if isinstance(v, int | float)
        }
        for pv, (low, high) in found.items():
            if given.get(f"{pv}.use", 1):
                found[pv] = max(low, given.get(f"{pv}.low", low)), min(high, given.get(f"{pv}.high", high))
    return {pv: ends for pv, ends in found.items() if ends != (-math.inf, math.inf) and ends[0] < ends[1]}
