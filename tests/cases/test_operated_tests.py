"""Tests in which operators change a law: what an own plant has of its own accord, and what params.yaml adds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from own_cases import filled_level, two_lags

from loopwright.pipeline.cases.operated_tests import CHANGE_AT, check_operated, operated_tests
from loopwright.pipeline.cases.operated_trials import figures_of
from loopwright.pipeline.cases.operator_asks import best_rest
from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.config.operator_tests import OperatedTestParams
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.operated import LEAST_GAIN, MOST_OUTSIDE, OperatedLoop
from loopwright.pipeline.laws.predictive.operating import entries_of
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory, simulate_closed
from loopwright.serving.manifest import OperateEntry


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def entries(case: OwnCase) -> tuple[OperateEntry, ...]:
    return entries_of(case.plant.signals, len(case.plant.pv_signals), [], [], {})


def best_of(test: Scenario, of: tuple[OperateEntry, ...]):
    course = test.operated(of)
    assert course is not None
    found = best_rest(test, course, test.mv0)
    assert found is not None
    return course, found


def kept_at(test: Scenario, mv: np.ndarray, after: int = CHANGE_AT) -> Trajectory:
    """The plant of a test under MVs that step to ``mv`` once operators have changed something."""
    k = iter(range(test.samples))
    assert test.plant is not None
    return simulate_closed(test.plant, lambda *_: (mv if next(k) >= after else test.mv0, [0.0]), test)


def figures(case: OwnCase, test: Scenario, mv: np.ndarray) -> OperatedLoop:
    course, best = best_of(test, entries(case))
    return figures_of(case, test, course, kept_at(test, mv), best)


def test_a_law_without_operate_has_no_such_test() -> None:
    assert operated_tests(two_lags(), (), {}) == {}


def test_two_pvs_and_two_mvs_have_all_six_on_each_model() -> None:
    case = two_lags()
    tests = operated_tests(case, entries(case), {})
    assert set(tests) == {"narrowed", "taken_out", "costs", "pushed", "at_odds", "resting"}
    for name, test in tests.items():
        assert {id(one.plant) for one in test.sequences} == {id(plant) for plant in case.members}, name
        for one in test.sequences:
            assert min(change.at for change in one.operate) == CHANGE_AT
            best_of(one, entries(case))  # the values are ones that the law takes


def test_a_narrowed_range_shuts_the_plant_out_and_a_steady_state_keeps_it() -> None:
    case = two_lags()
    for test in operated_tests(case, entries(case), {})["narrowed"].sequences:
        course, best = best_of(test, entries(case))
        assert test.plant is not None
        y0 = test.plant.measure(test.x0)
        out = [not course.at(s.name, "low", 0) <= y <= course.at(s.name, "high", 0)
               for s, y in zip(case.plant.pv_signals, y0, strict=True)]  # fmt: skip
        assert any(out)
        assert not best.outside.any()


def test_ranges_at_odds_cannot_both_be_kept_and_the_last_rank_bears_it() -> None:
    case = two_lags()
    for test in operated_tests(case, entries(case), {})["at_odds"].sequences:
        _, best = best_of(test, entries(case))
        assert np.count_nonzero(best.outside) == 1
        loop = figures(case, test, best.mv)
        assert {one.rank for one in loop.ranges} == {1.0, 4.0}
        assert loop.borne == pytest.approx(1.0, abs=1e-3)
        (kept,) = [one for one in loop.ranges if one.allowed]
        assert kept.rank == 1.0
        wrong = figures(case, test, test.mv0)  # a law that keeps the last range instead
        assert wrong.borne == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("noises", [3.0, 12.0, 48.0])
@pytest.mark.parametrize("aside", [-0.9, 0.0, 0.9])
def test_every_test_is_one_that_the_law_takes_within_narrow_ranges_of_its_own(noises: float, aside: float) -> None:
    """A test had asked for a low end beyond the high one that an evaporator's level has by default."""
    case = two_lags()
    signals, half = case.plant.pv_signals, noises * case.noise_std
    middle = case.plant.measure(case.plant.start[0]) + aside * half
    own = {
        f"{s.name}.{end}": float(np.clip(middle[i] + by * half[i], s.low, s.high))
        for i, s in enumerate(signals)
        for end, by in (("low", -1), ("high", 1))
    }
    narrow = entries_of(case.plant.signals, len(signals), [], [], own)
    tests = operated_tests(case, narrow, {})
    assert {"taken_out", "costs"} <= set(tests)
    for test in tests.values():
        for one in test.sequences:
            one.operated(narrow)


def test_the_optimum_gains_all_and_the_start_nothing_and_a_wrong_way_loses() -> None:
    case = two_lags()
    test = operated_tests(case, entries(case), {})["costs"].sequences[0]
    _, best = best_of(test, entries(case))
    assert best.mv.sum() < test.mv0.sum()  # each MV costs
    assert figures(case, test, best.mv).gain == pytest.approx(1.0, abs=1e-3)
    assert figures(case, test, test.mv0).gain == pytest.approx(0.0, abs=1e-3)
    loss = figures(case, test, 2 * test.mv0 - best.mv).gain
    assert loss is not None
    assert loss < 0


def test_resting_values_are_ones_that_the_ranges_allow_and_their_miss_is_told() -> None:
    case = two_lags()
    test = operated_tests(case, entries(case), {})["resting"].sequences[0]
    course, _ = best_of(test, entries(case))
    rests = np.array([course.at(s.name, "rest", np.nan) for s in case.plant.mv_signals])
    assert np.any(np.abs(rests - test.mv0) > 0.01)
    there = figures(case, test, rests)
    assert [one.miss for one in there.mvs] == pytest.approx([0.0, 0.0])
    assert max(one.late for one in there.ranges) == 0.0
    away = figures(case, test, rests + 0.1)
    assert [one.miss for one in away.mvs] == pytest.approx([0.1, 0.1])
    assert [one.miss_share for one in away.mvs] == pytest.approx([0.05, 0.05])


def test_an_mv_that_moves_while_it_is_out_is_told_and_its_first_move_counts() -> None:
    case = two_lags()
    test = operated_tests(case, entries(case), {})["taken_out"].sequences[0]
    out = next(name for name, value in test.operate[0].values.items() if name.endswith(".use") and value == 0)
    place = [f"{s.name}.use" for s in case.plant.mv_signals].index(out)
    for moved in (0.0, 0.2):
        loop = figures(case, test, test.mv0 + moved)
        assert loop.mvs[place].moved_out == pytest.approx(moved / 2)
        assert loop.mvs[1 - place].moved_out is None
        assert loop.mvs[place].travel == pytest.approx(moved)


def test_a_load_pushes_the_variable_out_of_its_range_where_nobody_acts() -> None:
    case = two_lags()
    for test in operated_tests(case, entries(case), {})["pushed"].sequences:
        loop = figures(case, test, test.mv0)
        assert max(one.late for one in loop.ranges) == 1.0
        assert all(one.allowed for one in loop.ranges)


def test_a_level_that_integrates_has_its_tests_too() -> None:
    case = filled_level()
    tests = operated_tests(case, entries(case), {})
    assert {"taken_out", "costs", "pushed"} <= set(tests)
    assert "at_odds" not in tests  # one variable has no other to be at odds with


# ------------------------------------------------------------------------------------------------ tests of params.yaml
NIGHT = {
    "duration_s": 60.0,
    "operate": [{"at_s": 10.0, "y0.low": -0.5, "y0.high": 0.5, "y0.track": 0.0}, {"at_s": 30.0, "u1.use": 0.0}],
    "set_points": [{"at_s": 20.0, "y1": 0.3}],
    "changes": [{"at_s": 5.0, "load_y0": 0.1}],
}


def params(**other: object) -> OperatedTestParams:
    return parse(OperatedTestParams, NIGHT | other, "night")


def test_a_test_of_params_runs_on_each_model_with_what_it_says() -> None:
    case = two_lags()
    test = operated_tests(case, entries(case), {"night": params(most_outside=10)})["night"]
    assert (test.limits.most_outside, test.limits.least_gain) == (0.1, LEAST_GAIN)
    assert len(test.sequences) == len(case.members)
    one = test.sequences[0]
    assert one.samples == 60
    assert one.sp[[19, 20], 1].tolist() == [one.sp[0, 1], 0.3]
    assert one.changes["load_y0"][[4, 5]].tolist() == [0.0, 0.1]
    assert [change.at for change in one.operate] == [10, 30]
    assert operated_tests(case, entries(case), {"night": params()})["night"].limits.most_outside == MOST_OUTSIDE


def test_a_test_of_params_takes_the_place_of_one_of_its_name() -> None:
    case = two_lags()
    assert operated_tests(case, entries(case), {"costs": params()})["costs"].sequences[0].samples == 60


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"duration_s": 0.0}, "duration_s"),
        ({"operate": []}, "operate is empty"),
        ({"operate": [{"y0.low": 1.0}]}, "at_s"),
        ({"operate": [{"at_s": 60.0, "y0.low": 1.0}]}, "60 s"),
        ({"most_outside": 101.0}, "most_outside"),
        ({"operat": []}, "operat"),
    ],
)
def test_a_test_of_params_that_cannot_be_is_one_error(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ParamsError, match=r"^night") as found:
        params(**wrong)
    assert said in str(found.value)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"operate": [{"at_s": 0.0, "y0.lov": 1.0}]}, "y0.low"),
        ({"set_points": [{"at_s": 0.0, "y2": 1.0}]}, "y2"),
        ({"measured": [{"at_s": 0.0, "d0": 1.0}]}, "d0"),
    ],
)
def test_a_name_that_the_plant_has_not_is_found_before_a_law_is_designed(wrong: dict[str, object], said: str) -> None:
    case = two_lags()
    with pytest.raises(ParamsError, match=r"^cases.it.operated.night\.") as found:
        check_operated(case, {"night": params(**wrong)})
    assert said in str(found.value)
    check_operated(case, {"night": params()})
    with pytest.raises(ParamsError, match="load_y9"):
        operated_tests(case, entries(case), {"night": params(changes=[{"at_s": 0.0, "load_y9": 1.0}])})
