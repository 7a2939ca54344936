"""How far tests on identified models, and their closed loops, left the record: the grounds of their figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.evidence_basis import Grounds
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED, identified_part
from loopwright.pipeline.evaluation.proof import fit_doubts, sign_doubts
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.simulation.simulate import Trajectory

Ranges = Mapping[str, tuple[float, float]]
"""Signal -> the lowest and the highest value."""

LEAST_BEYOND_RANGE = 0.5  # % of a recorded range: what goes less far beyond it stays within


def grounds_of(case: Case, models: Mapping[str, Any], reached: Mapping[str, Ranges]) -> Grounds | None:
    """Grounds of the tests of a case on models; None for a case that is tested on its plant's equations.

    ``models`` is metrics.json of the law's model set, ``reached`` what closed loops reached, by law; of one
    law alone by "".
    """
    if not case.on_models:
        return None
    parts: Mapping[str, Any] = models.get("parts") or {}
    outputs: Mapping[str, Any] = next(
        (
            row["outputs"]
            for part in parts.values()
            for row in (part.get("per_seed") or {}).values()
            if "outputs" in row
        ),
        {},
    )
    fit = {s.name: (outputs.get(s.name) or {}).get("fit_percent") for s in case.plant.sp_signals}
    asked = np.concatenate([test.sp for tests in case.tests().values() for test in tests if not test.replayed])
    names = [s.name for s in case.plant.sp_signals]
    wanted = dict(zip(names, zip(asked.min(axis=0).tolist(), asked.max(axis=0).tolist(), strict=True), strict=True))
    unproven = (sign_doubts({"": models}), fit_doubts({"": models})) if case.stand_in == IDENTIFIED else ()
    identified = identified_part({"": models})
    left = {law: beyond(ranges, case.recorded) for law, ranges in reached.items()}
    loops = beyond(widest(reached.values()), case.recorded)
    return Grounds(
        fit,
        beyond(wanted, case.recorded),
        loops,
        tuple(why for why in unproven if why),
        case.record_verdict,
        {name: max(left, key=lambda law: left[law].get(name, 0.0)) for name in loops if "" not in left},
        case.stand_in == IDENTIFIED and bool((identified.get("proof") or {}).get("answers")) and not any(unproven),
        (identified.get("structure") or {}).get("rows_ahead"),
    )


def beyond(found: Ranges, recorded: Ranges) -> dict[str, float]:
    """How far values go beyond the recorded ranges, in % of these; signals that stay within are left out."""
    far = {}
    for name, (low, high) in found.items():
        if name in recorded:
            least, most = recorded[name]
            far[name] = 100 * max(least - low, high - most) / max(most - least, 1e-300)
    return {name: float(f"{value:.3g}") for name, value in far.items() if value >= LEAST_BEYOND_RANGE}


def reached_by(loops: Sequence[Trajectory], case: Case) -> dict[str, tuple[float, float]]:
    """The lowest and highest PV and MV of some closed loops, by signal."""
    plant = case.plant
    groups = ((plant.pv_signals, "pv"), (plant.mv_signals, "mv"))
    found: dict[str, tuple[float, float]] = {}
    for signals, name in groups:
        values: Array = np.concatenate([getattr(loop, name) for loop in loops])
        found |= {s.name: (float(v.min()), float(v.max())) for s, v in zip(signals, values.T, strict=True)}
    return found


def widest(several: Iterable[Ranges]) -> dict[str, tuple[float, float]]:
    """Ranges that hold all of several."""
    whole: dict[str, tuple[float, float]] = {}
    for ranges in several:
        for name, (low, high) in ranges.items():
            least, most = whole.get(name, (low, high))
            whole[name] = (min(least, low), max(most, high))
    return whole
