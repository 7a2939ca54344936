"""Records that no controller may come of: how many slip through what `loopwright new` and the proof of the fit say.

``regulation``: the old loop at one set point, nobody touches it. ``follower``: the MV moves with the PV and with
nothing else, and moves nothing (its valve is shut by hand). ``wrong tags``: the PV of another plant. ``shuffled``:
the rows in random order under rising times.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from closed_benchmark import kept, product_digest, yardstick_of
from closed_development import CLOSED_DEVELOPMENT
from closed_plant import ClosedPlant
from closed_product import read
from closed_product import verdict as carries
from closed_record import ClosedRecord, closed_record_of, recorded, roles, write_export
from numpy.typing import NDArray
from store import FOLDER

from loopwright.pipeline.errors import PipelineError
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.workbench import identify

ROWS = 4_000
MINUTES = 0.3  # of the search: the proof looks at answers, which are there early
SINGLE = tuple(p for p in CLOSED_DEVELOPMENT if len(p.loops) == 1)


def regulation(plant: ClosedPlant, rows: int, seed: int) -> ClosedRecord:
    """One set point, no time in manual."""
    return recorded(plant, *_untouched(plant, rows), np.random.default_rng(seed))


def follower(plant: ClosedPlant, rows: int, seed: int) -> ClosedRecord:
    """The PV wanders by the loads alone; the MV is what the old loop makes of it."""
    sp, manual, hand = _untouched(plant, rows)
    return recorded(plant, sp, manual, hand, np.random.default_rng(seed), plant.rest(sp[0])[1])


def _untouched(plant: ClosedPlant, rows: int) -> tuple[Array, NDArray[np.bool_], Array]:
    """Set points at their middle, and nobody's hand."""
    shape = (rows, len(plant.mv_signals))
    return np.tile([s.middle for s in plant.sp_signals], (rows, 1)), np.zeros(shape, dtype=np.bool_), np.zeros(shape)


def wrong_tags(plant: ClosedPlant, rows: int, seed: int) -> ClosedRecord:
    """SP, OP and mode of the plant, the PV of the next one, in the range of this."""
    others = [p() for p in SINGLE if p is not type(plant)]
    other = others[seed % len(others)]
    own, strange = closed_record_of(plant, rows, seed), closed_record_of(other, rows, seed + 1_000)
    mine, theirs = plant.sp_signals[0], other.sp_signals[0]
    scale = (mine.high - mine.low) / (theirs.high - theirs.low)
    pv, true = (mine.low + scale * (v - theirs.low) for v in (strange.pv, strange.true))
    return replace(own, pv=pv, true=true)


def shuffled(plant: ClosedPlant, rows: int, seed: int) -> ClosedRecord:
    """Every row somewhere else in time."""
    own, order = closed_record_of(plant, rows, seed), np.random.default_rng(seed).permutation(rows)
    parts = {name: getattr(own, name)[order] for name in ("sp", "pv", "op", "manual", "dv", "true")}
    return replace(own, **parts, loads={name: values[order] for name, values in own.loads.items()})


KINDS: dict[str, Callable[[ClosedPlant, int, int], ClosedRecord]] = {
    "regulation": regulation, "follower": follower, "wrong tags": wrong_tags, "shuffled": shuffled,
}  # fmt: skip


def verdict(plant: ClosedPlant, record: ClosedRecord, folder: Path, minutes: float = MINUTES) -> dict[str, Any]:
    """What is said of a record, and by whom: ``new``, ``proof``; ``slips`` where nobody refuses it."""
    file, began = folder / f"{plant.name}.csv", time.process_time()
    write_export(plant, record, file)
    try:
        found = read(file, roles(plant))
        if found.refused:
            return {"by": "new", "why": found.refused, "seconds": time.process_time() - began}
        doubts = identify(found, minutes=minutes).doubts
    except PipelineError as error:
        return {"by": "error", "why": str(error), "seconds": time.process_time() - began}
    by = "proof" if doubts else "slips"
    return {"by": by, "why": doubts or f"new said {carries(found)}", "seconds": time.process_time() - began}


def refused_main(kinds: Sequence[str], count: int, minutes: float) -> int:
    """Print how many of each kind are refused by whom, and which slip through."""
    code = product_digest()
    for kind in kinds:
        found: dict[str, list[str]] = {"new": [], "proof": [], "error": [], "slips": []}
        for seed in range(count):
            plant = SINGLE[seed % len(SINGLE)]()
            name = f"{plant.name}-{kind.replace(' ', '-')}-{seed}-{minutes:g}-{yardstick_of(plant)}-{code}"
            said = kept(name, partial(_said, plant, kind, seed, minutes, FOLDER / f"{name}-export"))
            found[said["by"]].append(f"{plant.name} {seed}: {said['why']}")
        by = ", ".join(f"{who} {len(rows)}" for who, rows in found.items() if who != "slips")
        print(f"{kind}: {len(found['slips'])} of {count} slip through (refused by {by})", flush=True)
        for row in found["slips"]:
            print(f"  {row}")
    return 0


def _said(plant: ClosedPlant, kind: str, seed: int, minutes: float, folder: Path) -> dict[str, Any]:
    return verdict(plant, KINDS[kind](plant, ROWS, seed), folder, minutes)
