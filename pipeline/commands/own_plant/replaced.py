"""``loopwright new --replace``: what an earlier `loopwright new` wrote for the plant, and what goes with it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.own_entries import entries_of
from loopwright.pipeline.commands.own_plant.from_simulator import SIMULATOR
from loopwright.pipeline.commands.own_plant.knowledge import Stated, checked
from loopwright.pipeline.config.known import Known, together
from loopwright.pipeline.config.params import read_section, sections
from loopwright.pipeline.config.plants import PlantParams
from loopwright.pipeline.errors import RecordError
from loopwright.pipeline.historian.cleaning.tags import COMMANDS, Tag
from loopwright.pipeline.records.old_loops import OldController

REFUSED = {"screening.json", "screening.html", "step_test.csv"}  # all that is left of an export that was not added
OWN = {*REFUSED, "record.parquet", "first_test.json"}  # what is written for a plant, beside its simulator


def check_replaceable(name: str, folder: Path) -> None:
    """RecordError where --replace would take more away than an earlier `loopwright new` wrote."""
    if name in CASES:
        raise RecordError(f"{name} is a case of this project, which --replace never replaces; choose another name")
    foreign = sorted(p.name for p in folder.glob("*") if p.name not in OWN and p.name.partition(".")[0] != SIMULATOR)
    if foreign:
        raise RecordError(f"{folder} holds {foreign[0]}, which `new` did not write; move it, then --replace works")


def limits_kept(plant: str, tags: Sequence[Tag]) -> tuple[tuple[Tag, ...], list[str]]:
    """The tags, MVs with the limits of commands that params.yaml has of them, and these limits in words.

    A limit that a person gives anew prevails. Without this, a new record would let the next controller command all.
    """
    if plant not in sections("plants"):
        return tuple(tags), []
    old = {str(mv["name"]): mv for mv in read_section("plants", plant).get("mv", ())}
    kept, words = [], []
    for tag in tags:
        earlier = {key: old.get(tag.name, {}).get(key) for key in COMMANDS if tag.role == "mv"}
        taken = {key: value for key, value in earlier.items() if value is not None and getattr(tag, key) is None}
        kept.append(replace(tag, **taken))
        words += [f"{tag.name}: {key}: {value:g}" for key, value in taken.items()]
    return tuple(kept), words


def known_kept(plant: str, said: Stated, tags: Sequence[Tag]) -> tuple[tuple[Known, ...], list[str]]:
    """The statements on pairs, with those of params.yaml on pairs that are still there, and the latter in words.

    A statement on a pair that a person gives anew prevails as a whole.
    """
    if plant not in sections("plants"):
        return said.known, []
    old = together(PlantParams.read(plant).known)
    names = {role: {t.name for t in tags if t.role in roles} for role, roles in (("pv", {"pv"}), ("in", {"mv", "dv"}))}
    anew = {(one.pv, one.input) for one in said.known} | said.forgotten
    kept = [k for k in old if (k.pv, k.input) not in anew and k.pv in names["pv"] and k.input in names["in"]]
    return checked((*kept, *said.known), tags), [
        f"known: {k.pair}={k.says} (--known '{k.pair}=' takes it back)" for k in kept
    ]


def wishes_lost(plant: str, entries: Mapping[str, Mapping[str, Any]], screening: Path) -> list[str]:
    """Settings that a person may have written and the new ``entries`` lack, as ``SECTION.NAME: key: value``.

    Keys of a plant's controllers, where they may have other values too, and of how its export files are read. The
    numbers of the old loop that `new` wrote itself, from the ``screening`` of the record before, are nobody's wish.
    """
    if plant not in sections("plants"):
        return []
    found = []
    earlier = json.loads(screening.read_text(encoding="utf-8")) if screening.exists() else {}
    old_loops = [OldController(**law) for law in earlier.get("old_controllers", ())]
    written = entries_of(plant, {"data": "", **read_section("plants", plant)}, old=old_loops)["controllers"]
    for section in ("controllers", "exports"):
        for name, new in entries.get(section, {}).items():
            old = read_section(section, name) if name in sections(section) else {}
            own = written.get(name, {}) if section == "controllers" else {}
            lost = [key for key in old if key not in new or (section == "controllers" and old[key] != new[key])]
            lost = [key for key in lost if key not in own or own[key] != old[key]]
            found += [f"{section}.{name}: {key}: {old[key]}" for key in lost]
    return found
