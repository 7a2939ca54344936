"""MVs in hand or local, and courses, where something else happens at the same time: swaps, misses, recoveries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from operated_law import PLANT, T

from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.base import ControlLaw
from loopwright.serving import Controller, ControlLoop, LoopError, Mode, Sample
from loopwright.serving.modes import Fallback
from loopwright.serving.monitor.signal_use import UseOfSignals
from loopwright.serving.opcua.analysers import Analysers
from loopwright.serving.opcua.settings import AnalyserNode
from loopwright.serving.station.control import LONGEST_REQUEST, asked
from loopwright.serving.station.last_run import Steered

pytest_plugins = ["small_laws", "operated_files"]


def sample(t: float = 300.0, valve: float = 40.0, heat: float = 0.5, local: str = "") -> Sample:
    return Sample(np.array([t, 5.0, 0.5]), np.array([valve, heat]), local=(local, "") if local else ())


def loop_of(controller: Controller, **options: Any) -> ControlLoop:
    return ControlLoop(controller, **{"sp": [300.0, 5.0], "mv": [40.0, 0.5], "mode": Mode.AUTO, **options})


@pytest.mark.parametrize("local", ["", "in local"])
def test_no_law_takes_over_an_mv_that_it_cannot_leave_out(
    operated: Controller, not_operated: Controller, local: str
) -> None:
    loop = loop_of(operated, operate={} if local else {"valve.use": 0.0})
    loop.swap(not_operated, 2)
    for _ in range(6):
        command = loop.scan(sample(290.0, 40.0, loop.mv[1], local))
        assert command.mv[0] == 40.0
    assert loop.controller is operated
    assert loop.successor is not None
    assert "valve" in loop.successor.reason
    if not local:
        loop.set_operate({"valve.use": 1.0})
        for _ in range(3):
            loop.scan(sample(290.0, loop.mv[0], loop.mv[1]))
        assert loop.controller is not_operated


def test_an_mv_that_is_taken_in_hand_while_nothing_is_read_stays(operated: Controller) -> None:
    loop = loop_of(operated, fallback=Fallback(2.0, (0.0, 0.0), (5.0, 0.1)))
    loop.scan(sample())
    for _ in range(4):
        loop.miss("down")
    stands = loop.mv[0]
    assert stands < 40.0
    loop.set_operate({"valve.use": 0.0})
    assert [loop.miss("down").mv[0] for _ in range(4)] == [stands] * 4


def test_a_recovery_does_not_believe_an_mv_that_is_elsewhere(operated: Controller) -> None:
    loop = loop_of(operated, recover_after=2, local_s=5.0)
    while not loop.local:
        loop.scan(sample(290.0, 20.0))
    assert loop.miss("gone").mode is Mode.HOLD
    found = [loop.scan(sample(290.0, 20.0)) for _ in range(6)]
    assert found[-1].mode is Mode.AUTO
    assert all("valve" in command.local for command in found)
    assert all(command.mv[0] == 20.0 for command in found)


def test_a_course_ends_where_it_leaves_the_range_of_the_law_in_charge(
    operated: Controller, make_formula: Callable[..., ControlLaw], tmp_path: Path
) -> None:
    narrow = replace(PLANT, sp=(replace(T, low=280.0, high=320.0), PLANT.sp[1]))

    def formula(law: ControlLaw, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
        return law.limited(mv_applied, mv_applied), state, pv[..., :0]

    export(make_formula(formula, signals=narrow).eval(), tmp_path / "narrow.onnx", case="plant", provenance={})
    loop = loop_of(operated)
    loop.courses.give({"T": [(4.0, 390.0)]})
    loop.swap(Controller(tmp_path / "narrow.onnx"), 1)
    for _ in range(7):
        command = loop.scan(sample(300.0, *loop.mv))
        assert command.sp[0] == 300.0
    assert not loop.courses.ends
    loop.set_sp([301.0, 5.0])


def test_what_a_course_makes_of_a_set_point_is_not_kept_as_the_operators(operated: Controller) -> None:
    loop = loop_of(operated)
    before = Steered.of(loop)
    loop.courses.give({"T": [(0.0, 300.0), (50.0, 350.0)]}, ["T"])
    for _ in range(5):
        loop.scan(sample(300.0, *loop.mv))
    assert loop.sp[0] > 300.0
    assert Steered.of(loop, before) == before


def test_an_mv_that_the_plant_has_is_not_moved_for_the_monitor(operated: Controller) -> None:
    loop, use = loop_of(operated), UseOfSignals(operated.manifest)
    seen = [sample(valve=40.0), sample(valve=40.0, local="in local")]
    moved = [use.of(s, loop.scan(s), np.array(loop.operate)).moved for s in seen]
    assert moved == [(True, True), (False, True)]


def test_a_bad_status_between_two_results_of_an_analyser_is_no_fault(operated: Controller) -> None:
    analysers = Analysers(operated.manifest, {"x": AnalyserNode(100.0)})
    found = []
    for k, bad in ((0, ""), (1, "bad"), (2, ""), (150, "bad")):
        given = replace(sample(), bad_pv=("", "", bad) if bad else ())
        seen = analysers.look(given, float(k))
        assert seen.fresh is not None
        found.append((seen.fresh[2], bool(seen.bad_pv and seen.bad_pv[2])))
    assert found == [(1.0, False), (0.0, False), (0.0, False), (0.0, True)]


def test_a_request_that_is_too_long_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(LoopError, match=str(LONGEST_REQUEST)):
        asked(tmp_path / "nobody", {"do": "course", "value": [[k, 1.0] for k in range(20_000)]})


def test_a_number_of_some_hundred_digits_is_none(operated: Controller) -> None:
    with pytest.raises(LoopError, match="course of T"):
        loop_of(operated).courses.give({"T": [(10**400, 300.0)]})
