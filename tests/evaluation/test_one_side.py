"""The side of a turn on which controllers stay."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.evaluation.one_side import before_turns, on_one_side, side_of
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.manifest import Signal

PV, MV = Signal("y", "K", 0.0, 100.0), Signal("u", "%", 0.0, 100.0)
ONE = Signals(10.0, (PV,), (PV,), (), (MV,))


def region(start: float, end: float, model: float, *, small: bool = False, verdict: str = "proven") -> dict[str, Any]:
    """A region of the MV's range as the model's figures hold it."""
    return {"from": start, "to": end, "model": model, "small": small, "verdict": verdict}


HILL = [region(10, 30, 2.0), region(30, 60, 1.0), region(60, 90, -3.0)]
VALLEY = [region(10, 40, -2.0), region(40, 50, 0.1, small=True), region(50, 90, 3.0)]


@pytest.mark.parametrize(
    ("regions", "median", "side"),
    [
        (HILL, 45.0, (None, 60.0)),
        (HILL, 80.0, (60.0, None)),
        (HILL, 5.0, (None, 60.0)),
        (VALLEY, 20.0, (None, 40.0)),
        (VALLEY, 45.0, (None, 45.0)),
        (VALLEY, 47.0, (47.0, None)),
        (VALLEY, 70.0, (50.0, None)),
        ([region(10, 30, -1.0), region(30, 60, 1.0), region(60, 90, -3.0)], 45.0, (30.0, 60.0)),
        ([region(10, 60, 1.0), region(60, 90, 0.1, small=True)], 45.0, (None, None)),
        ([region(10, 60, 1.0), region(60, 90, -1.0, verdict="uncertain")], 45.0, (None, None)),
        ([region(10, 60, 1.0, verdict="uncertain"), region(60, 90, -1.0, verdict="uncertain")], 45.0, (None, None)),
        ([], 45.0, (None, None)),
    ],
)
def test_a_side_ends_where_the_gain_turns_and_the_record_proves_both_signs(
    regions: list[dict[str, Any]], median: float, side: tuple[float | None, float | None]
) -> None:
    assert side_of(regions, median) == side


def test_the_mv_of_a_plant_ends_at_the_turn_and_nothing_else_changes() -> None:
    proof = {"answers": {"y": {"u": {"regions": HILL}}}}
    found = on_one_side(ONE, proof, 45.0)
    assert (found.mv[0].low, found.mv[0].high) == (0.0, 60.0)
    assert (found.sp, found.pv, found.period_s) == (ONE.sp, ONE.pv, ONE.period_s)
    assert on_one_side(ONE, {}, 45.0) == ONE


def test_a_narrower_range_that_a_person_gave_stays_and_no_side_of_it_means_no_change() -> None:
    proof = {"answers": {"y": {"u": {"regions": HILL}}}}
    given = Signals(10.0, (PV,), (PV,), (), (Signal("u", "%", 20.0, 50.0),))
    assert on_one_side(given, proof, 45.0) == given
    beyond = Signals(10.0, (PV,), (PV,), (), (Signal("u", "%", 59.0, 100.0),))
    assert on_one_side(beyond, proof, 45.0) == beyond  # a sliver would be left
    assert on_one_side(beyond, proof, 75.0).mv[0].low == 60.0


def test_a_plant_of_several_mvs_keeps_its_ranges() -> None:
    several = Signals(10.0, (PV,), (PV,), (), (MV, Signal("w", "%", 0.0, 100.0)))
    assert on_one_side(several, {"answers": {"y": {"u": {"regions": HILL}}}}, 45.0) == several


def test_an_mv_ends_at_the_first_turn_of_a_model_and_keeps_what_was_visited() -> None:
    u = np.linspace(0.0, 100.0, 101)
    rises, hill, valley = u, -((u - 70.0) ** 2), (u - 20.0) ** 2
    flat, dips = np.minimum(u, 80.0) - 0.01 * np.maximum(u - 80.0, 0.0), u + 2.0 * np.exp(-((u - 62.0) ** 2))
    for curves, ends in [
        ([rises, hill, valley], (20.0, 70.0)),
        ([-rises, -hill, -valley], (20.0, 70.0)),
        ([rises, flat, dips], (0.0, 100.0)),
        ([rises, -((u - 55.0) ** 2)], (0.0, 60.0)),
        ([-((u - 70.0) ** 4)], (0.0, 70.0)),  # it falls farther behind its top than it rose before it
        ([np.interp(u, [0, 60, 80, 100], [0, 60, 20, 70])], (0.0, 60.0)),  # the first turn
    ]:
        found = before_turns(ONE, u, np.array(curves), np.array(curves), (30.0, 60.0)).mv[0]
        assert (found.low, found.high) == ends
    for visited, ends in [((75.0, 95.0), (0.0, 100.0)), ((0.0, 100.0), (0.0, 100.0))]:  # flat is flat from anywhere
        found = before_turns(ONE, u, np.array([flat]), np.array([flat]), visited).mv[0]
        assert (found.low, found.high) == ends
    rested = before_turns(ONE, u, np.array([hill]), np.array([hill]), (50.2, 50.2)).mv[0]
    assert rested.high == 70.0


def test_an_mv_ends_where_a_model_leaves_what_it_had_reached() -> None:
    """It answers, and then goes on by a third of its way; a slow one goes on too, a little more with each step."""
    u = np.linspace(0.0, 100.0, 101)
    falls, slow = 100.0 - u, 100.0 - 1.06 * u
    runs = falls + 40.0 * (u < 8.0)
    for rests, ends in [
        ([falls, runs], (8.0, 100.0)),
        ([falls, falls - 40.0 * (u > 88.0)], (0.0, 88.0)),
        ([falls, slow], (0.0, 100.0)),
        ([falls, runs + 20.0], (0.0, 100.0)),  # it does so where the record judges, too
    ]:
        found = before_turns(ONE, u, np.array([falls, falls]), np.array(rests), (30.0, 60.0)).mv[0]
        assert (found.low, found.high) == ends
    slow = before_turns(ONE, u, np.array([0.7 * (u - 50.0)]), np.array([u - 50.0]), (45.0, 55.0)).mv[0]
    assert (slow.low, slow.high) == (0.0, 100.0)
    visited = before_turns(ONE, u, np.array([falls]), np.array([runs]), (7.5, 60.0)).mv[0]
    assert visited.low == 7.5  # what was visited remains
