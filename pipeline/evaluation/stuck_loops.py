"""Closed loops that get stuck: at an end of an MV, far beyond a range, at a refused step, or swinging to the end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.closed_loop import UNREACHED_ERROR, left_limits, lock_ups, swings
from loopwright.pipeline.evaluation.knowing_control import reached
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.serving.manifest import OperateEntry


def seized(case: Case, test: Scenario, loop: Trajectory, entries: Sequence[OperateEntry] = ()) -> tuple[bool, int]:
    """(whether the loop locked up, holds in which it is at an end because its set point is beyond reach).

    It locks up at an end of an MV, or where the controller refused a step: one refuses to give an MV beyond its range.
    Where the tests run on models, a CV far beyond its range counts too: equations hold far from where they were meant,
    a model of a record does not.

    On a model of a record a hold counts only where a control that knows the model comes near the set point within the
    hold, from the same state: a plant gone wrong may not get there at all. Nor does one in which ranges that the law
    keeps, by its ``entries`` of ``operate``, lead away from the set point, and the loop to the best rest within them.
    """
    n = test.sp.shape[1]
    # As many MVs as set points; a further one may have a part that rests at an end.
    mvs = case.plant.mv_signals[:n]
    limits = {end: [getattr(s, end) for s in mvs] for end in ("low", "high")}
    jammed = lock_ups(loop.sp, loop.pv[:, :n], loop.mv[:, :n], test.hold, **limits, span=case.asked)
    plant, beyond = test.plant or case.plant, list[slice]()
    if case.on_models and isinstance(plant, IdentifiedPlant):
        before = np.vstack([test.mv0, loop.mv])  # the MVs at the beginning of each sample
        beyond = [
            of
            for of in jammed
            if kept_by_ranges(case, test, loop, entries, of)
            or not reached(plant, test, of, loop.x[of.start], before[of.start], case.asked).near
        ]
    ends = {end: [getattr(s, end) for s in case.plant.sp_signals] for end in ("low", "high")}
    left = case.on_models and left_limits(loop.pv[:, :n], test.hold, **ends)
    return len(jammed) > len(beyond) or left or bool(loop.info[:, -1].any()), len(beyond)


def kept_by_ranges(case: Case, test: Scenario, loop: Trajectory, entries: Sequence[OperateEntry], part: slice) -> bool:
    """Whether no rest within the ranges is near the set points of a hold, and the loop comes near the best one."""
    last, near = part.stop - 1, UNREACHED_ERROR * case.asked
    best = case.rest_within_ranges(test, entries, last, loop.mv[last])
    if best is None or not (np.abs(best - test.sp[last]) > near).any():
        return False
    late = loop.pv[(part.start + part.stop) // 2 : part.stop, : len(best)]
    return bool(np.all(np.abs(late - best) <= near, axis=1).any())


def swings_on(case: Case, test: Scenario, loop: Trajectory) -> bool:
    """Whether a controlled variable swings about its set point to the end of the test; a replayed load may swing."""
    if test.replayed:
        return False
    return bool(swings(loop.sp, loop.pv[:, : test.sp.shape[1]], case.spans).any())
