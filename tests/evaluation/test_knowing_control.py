"""What a control that knows the plant of a test gets to, and holds that count as no lock-up because it does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from own_cases import controllers_of_a_lag, filled_level, two_lags

from loopwright.pipeline.cases import own_plant
from loopwright.pipeline.cases.own_model import SLOW, GoneWrong
from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.evaluation.knowing_control import gets_there, reached
from loopwright.pipeline.evaluation.stuck_loops import seized
from loopwright.pipeline.evaluation.trials import close_loop, repeated
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.simulation.scenario import Scenario, held
from loopwright.serving.manifest import OperateEntry

HOLD = 40


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


class AtEnd:
    """A controller that has one MV for ever."""

    class manifest:  # noqa: N801
        info: tuple[str, ...] = ()
        operate: tuple[str, ...] = ()
        inputs: tuple[str, ...] = ()

    def __init__(self, mv: float) -> None:
        self.mv = mv

    def cold_state(self) -> np.ndarray:
        return np.zeros(0)

    def step(self, **_: Any) -> Any:
        return np.array([self.mv]), np.zeros(0), np.zeros(0)


def a_test(case: OwnCase, levels: list[float], **changed: float) -> Scenario:
    """Set points of a lag of gain 2 with its MV within +-1, from its rest."""
    assert isinstance(case.plant, IdentifiedPlant)
    changes = {name: np.full(HOLD * len(levels), value) for name, value in changed.items()}
    return Scenario("t", "", held(levels, HOLD), *case.plant.start, changes, HOLD, plant=case.plant)


def near(case: OwnCase, level: float, **changed: float) -> bool:
    test = a_test(case, [level], **changed)
    assert isinstance(test.plant, IdentifiedPlant)
    return reached(test.plant, test, slice(0, HOLD), test.x0, test.mv0, case.asked).near


def test_what_can_be_reached_and_what_cannot() -> None:
    case = controllers_of_a_lag({})
    assert near(case, 1.9)
    assert not near(case, 2.5)  # the MVs hold 2 at most
    assert near(case, 2.5, gain_u0=1.4)
    assert near(case, 1.9, time_constant=1.8)
    assert not near(case, 1.9, time_constant=100.0)  # a rest, but not within the hold
    assert near(case, 0.3, time_constant=100.0)
    assert not near(case, 1.9, load_y0=-1.0)


def test_an_mv_that_may_move_slowly_only_gets_less_far() -> None:
    case = controllers_of_a_lag({})
    (mv,) = case.signals.mv
    test = a_test(case, [1.9])
    assert isinstance(test.plant, IdentifiedPlant)
    vars(test.plant)["mv_signals"] = (replace(mv, max_move=0.001),)
    assert not reached(test.plant, test, slice(0, HOLD), test.x0, test.mv0, case.asked).near


@pytest.mark.parametrize("make", [two_lags, filled_level])
def test_every_set_point_of_ordinary_tests_is_reached(make: Any) -> None:
    case = make()
    for name in ("held_out", "spoilt"):
        for test in case.scenarios()[name]:
            assert gets_there(test.plant, test, case.asked)
            assert test.title.count("; ") == int(name == "spoilt")  # all of the errors


def test_a_lock_up_is_told_by_what_set_points_move_not_by_the_range() -> None:
    """Set points go 1.74 from one to another, the range is 6 wide: at an end, .06 short of a set point."""
    case = controllers_of_a_lag({})
    test = a_test(case, [1.94])
    assert 0.02 * case.asked[0] < 0.06 < 0.02 * 6
    assert seized(case, test, close_loop(AtEnd(1.0), case.plant, test, None, 0)) == (True, 0)  # type: ignore[arg-type]
    assert not near(case, 2.06)
    assert near(case, 2.02)


def test_a_hold_beyond_reach_is_no_lock_up_and_is_counted() -> None:
    case = controllers_of_a_lag({})
    controller: Any = AtEnd(1.0)
    full = a_test(case, [1.9, 1.9, -1.9], time_constant=100.0)
    loop = close_loop(controller, case.plant, full, None, 0)
    assert seized(case, full, loop) == (False, 3)
    found = repeated(controller, case, full, False, 0)
    assert (found.lock_ups, found.beyond_reach) == (0, 3)
    quick = a_test(case, [1.9, -1.9])  # the other way the plant would get there
    assert seized(case, quick, close_loop(controller, case.plant, quick, None, 0)) == (True, 0)
    both = a_test(case, [2.5, -1.9])
    assert seized(case, both, close_loop(controller, case.plant, both, None, 0)) == (True, 1)


def ranged(high: float) -> tuple[OperateEntry, ...]:
    """What a law has of ``operate`` that follows the lag's set point within a range up to ``high``."""
    values = {"use": 1.0, "track": 1.0, "rank": 1.0, "low": -3.0, "high": high}
    ends = {"use": (0.0, 1.0), "track": (0.0, 1.0), "rank": (1.0, 4.0)}
    return tuple(
        OperateEntry("cv", "y0", what, "", value, *ends.get(what, (-3.0, 3.0)))  # type: ignore[arg-type]
        for what, value in values.items()
    )


def test_the_best_rest_keeps_ranges_before_set_points() -> None:
    case = controllers_of_a_lag({})
    test, mv = a_test(case, [1.0, 1.5]), np.zeros(1)
    assert case.rest_within_ranges(test, (), 10, mv) is None
    for high, row, best in ((0.5, 10, 0.5), (1.2, 10, 1.0), (1.2, HOLD + 10, 1.2), (3.0, HOLD + 10, 1.5)):
        found = case.rest_within_ranges(test, ranged(high), row, mv)
        assert found == pytest.approx([best], abs=1e-4)


@pytest.mark.parametrize(("best", "stuck"), [(2.0, False), (1.2, True), (1.49, True)])
def test_a_loop_at_the_best_rest_within_ranges_is_not_stuck_and_another_is(best: float, stuck: bool) -> None:
    """An MV at its end, the CV at 2 and its set point at 1.5: as it must be where ranges ask for it, and only there."""
    case, controller = controllers_of_a_lag({}), AtEnd(1.0)
    test = a_test(case, [1.5])
    loop = close_loop(controller, case.plant, test, None, 0)  # type: ignore[arg-type]
    with mock.patch.object(type(case), "rest_within_ranges", return_value=np.array([best])):
        assert seized(case, test, loop, ranged(3.0)) == (stuck, int(not stuck))


def test_where_tests_run_on_equations_every_such_hold_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    case = controllers_of_a_lag({})
    monkeypatch.setattr(type(case), "on_models", False)
    full = a_test(case, [1.9], time_constant=100.0)
    loop = close_loop(AtEnd(1.0), case.plant, full, None, 0)  # type: ignore[arg-type]
    assert seized(case, full, loop)[0]


def test_errors_that_no_control_copes_with_are_lessened_and_the_title_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case, whole = controllers_of_a_lag({}), controllers_of_a_lag({}).scenarios()["spoilt"]
    slowest = max(float(t.changes["time_constant"][0]) for t in whole)

    def able(plant: Any, test: Scenario, span: Any) -> bool:
        """A quarter of the errors, of plants that are slower."""
        tau = float(test.changes["time_constant"][0])
        return tau < 1 + 0.4 * (slowest - 1) or not gets_there(plant, test, span)

    monkeypatch.setattr(own_plant, "gets_there", able)
    found = case.scenarios()["spoilt"]
    slow = [float(t.changes["time_constant"][0]) for t in whole]
    assert [float(t.changes["time_constant"][0]) for t in found] == pytest.approx(
        [s**0.25 if s > 1 else s for s in slow]
    )
    late = [float(t.changes["dead_time"][0]) for t in whole]
    assert [float(t.changes["dead_time"][0]) for t in found] == pytest.approx([0.25 * d for d in late])
    assert all("; in " in t.title and t.title.endswith("by 25 % of that") for t in found)
    monkeypatch.setattr(own_plant, "gets_there", lambda *_: False)
    same = controllers_of_a_lag({}).scenarios()["spoilt"]
    assert [t.digest() for t in same] == [t.digest() for t in whole]  # the errors are not to blame
    assert [t.title for t in same] == [t.title for t in whole]


def test_a_share_of_errors() -> None:
    errors = {"gain_u": 4.0, "time_constant": 0.25, "dead_time": 3.0}
    assert GoneWrong(SLOW, errors).lessened(0.5).parameters == {"gain_u": 2.0, "time_constant": 0.5, "dead_time": 1.5}
    assert GoneWrong(SLOW, errors).lessened(1.0).parameters == errors


def test_set_points_say_whether_the_plant_rests_at_each(monkeypatch: pytest.MonkeyPatch) -> None:
    case = controllers_of_a_lag({})
    member = case.members[0]
    sp, rests = case.reach.drawn(member, 9001)
    assert rests
    assert np.array_equal(sp, case.reach.set_points(member, 9001))
    monkeypatch.setattr(
        "loopwright.pipeline.cases.operating_range.inside", lambda values, *_: np.zeros(values.shape[:-1], dtype=bool)
    )
    monkeypatch.setattr("loopwright.pipeline.cases.operating_range.held_at", lambda *_: None)
    sp, rests = case.reach.drawn(member, 9001)
    assert not rests
    assert np.ptp(sp) == 0
