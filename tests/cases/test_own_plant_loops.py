"""An own plant with several controlled variables, and one whose level never settles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from own_cases import GAINS, POLES, RATE, filled_level, loop_of, section, two_lags

from loopwright.pipeline.cases.own_plant import PERCENT, OwnCase, own_case
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.evaluation.closed_loop import lock_ups
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models import load_model
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import Trajectory
from loopwright.pipeline.simulation.timetable import parse_event, timetable


@pytest.fixture
def two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    monkeypatch.chdir(tmp_path)
    return two_lags()


@pytest.fixture
def level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    monkeypatch.chdir(tmp_path)
    return filled_level()


def closed(case: OwnCase, test: Scenario) -> Trajectory:
    model = load_model(case.models / "identified.npz")
    settings = Predictive.Params(tuning="given", horizon=15, moves=4)
    law = Predictive.design(settings, {"identified": model}, case.plant.signals, case.plant).eval()
    return loop_of(law, test)


def test_all_variables_that_have_an_mv_are_controlled(two: OwnCase) -> None:
    assert [s.name for s in two.plant.sp_signals] == ["y0", "y1"]
    for pvs, mvs, more, wanted in ((2, 1, {}, 1), (1, 2, {}, 1), (3, 2, {}, 2), (2, 2, {"controlled": 1}, 1)):
        Path("params.yaml").write_text(yaml.safe_dump({"plants": {"it": section(pvs, mvs, **more)}, "cases": {}}))
        assert len(own_case("it").plant_class.sp_signals) == wanted


def test_set_points_can_be_held_jointly_by_mvs_that_the_record_visited(two: OwnCase) -> None:
    low, high = np.quantile(two.record.mv, (0.1, 0.9), axis=0)
    for test in two.scenarios()["held_out"]:
        needed = np.linalg.solve(GAINS, test.sp.T).T
        assert np.all((needed >= low - 1e-6) & (needed <= high + 1e-6))
        assert len(np.unique(test.sp, axis=0)) == len(test.sp) // two.hold == 6


def test_set_points_stay_where_the_record_was(two: OwnCase) -> None:
    visited = np.quantile(two.record.pv, (0.01, 0.99), axis=0)
    sp = np.concatenate([t.sp for name in ("held_out", "spoilt") for t in two.scenarios()[name]])
    assert np.all((sp >= visited[0] - 1e-9) & (sp <= visited[1] + 1e-9))


def test_every_variable_has_its_load(two: OwnCase) -> None:
    loads = [{name for name, v in t.changes.items() if v.any()} for t in two.scenarios()["load"]]
    assert loads == [{"load_y0"}] * 3 + [{"load_y1"}] * 3


def test_errors_of_several_variables_count_in_shares_of_their_ranges(two: OwnCase) -> None:
    test = two.scenarios()["load"][0]
    off = two.score(test, test.sp + np.array([0.06, 0.3]), np.zeros((len(test.sp), 2)))
    assert (off["mae_y0"], off["mae_y1"]) == pytest.approx((0.06, 0.3))
    assert off["mae"] == pytest.approx((1.0 + 5.0) / 2)
    assert two.cv_unit == PERCENT
    assert two.noise_level == pytest.approx(100 * 0.01 / 6)


def test_a_law_for_two_variables_holds_them(two: OwnCase) -> None:
    for name in ("spoilt", "load"):
        test = two.scenarios()[name][0]
        loop = closed(two, test)
        assert not lock_ups(test.sp, loop.pv, loop.mv, test.hold, low=[-1, -1], high=[1, 1], span=[6, 6])
        assert np.abs(test.sp - loop.pv)[-5:].max() < 0.02
        assert two.score(test, loop.pv, loop.mv)["mae"] < 4


def test_a_level_begins_at_rest_and_its_set_points_are_what_the_record_visited(level: OwnCase) -> None:
    assert level.reach.integrates == (0,)
    low, high = np.quantile(level.record.pv, (0.01, 0.99))
    for plant in (level.plant, *level.members):
        x, mv = plant.start
        assert plant.step(x, mv, plant.dv_nominal, plant.parameters()) == pytest.approx(x, abs=1e-6)
    sp = np.concatenate([t.sp for t in level.scenarios()["held_out"]])
    assert low <= sp.min() < sp.max() <= high
    assert np.ptp(sp) > 0.6 * (high - low)


def test_a_level_has_time_to_cross_its_range(level: OwnCase) -> None:
    # At full speed it needs width / (rate x the MV's whole range) samples, and a few for the lag.
    low, high = np.quantile(level.record.pv, (0.01, 0.99))
    needed = (high - low) / (RATE * 2.0)
    assert 3 * needed <= level.hold <= 3 * needed + 9


def test_a_law_holds_a_level_against_a_load(level: OwnCase) -> None:
    for name in ("spoilt", "load"):
        test = level.scenarios()[name][0]
        loop = closed(level, test)
        assert np.abs(test.sp - loop.pv)[-5:].max() < 0.05


@pytest.mark.parametrize(
    ("stuck", "far", "said"), [((1, 1), (1, 0), True), ((1, 0), (0, 0), False), ((0, 0), (1, 1), False)]
)
def test_one_mv_at_its_end_and_one_variable_far_away_are_a_lock_up(
    stuck: tuple[int, int], far: tuple[int, int], said: bool
) -> None:
    pv, mv = np.tile(np.array(far, float), (20, 1)), np.tile(np.array(stuck, float), (20, 1))
    assert bool(lock_ups(np.zeros((20, 2)), pv, mv, 0, low=[-1, -1], high=[1, 1], span=[2, 2])) is said


def test_a_simulation_moves_the_set_point_that_is_named(two: OwnCase) -> None:
    run = timetable(two.plant, set_points=[parse_event("y1=0.5@10", "[NAME=]VALUE[@S]")])
    assert np.ptp(run.sp[:, 0]) == 0
    assert run.sp[9, 1] != 0.5
    assert np.all(run.sp[10:, 1] == 0.5)
    for text, said in (("0.5", "name one: y0=VALUE"), ("y2=0.5", "no set point 'y2'"), ("y0=5", "outside")):
        with pytest.raises(ParamsError, match=said):
            timetable(two.plant, set_points=[parse_event(text, "[NAME=]VALUE[@S]")])


def test_halfway_is_the_slower_variable_s_half_time(two: OwnCase) -> None:
    assert two.reach.halfway == np.ceil(np.log(0.5) / np.log(POLES[0].max()))
