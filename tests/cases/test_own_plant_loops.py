"""An own plant with several controlled variables, and one whose level never settles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from identified_models import scaled_model

from pipeline.cases.own_plant import PERCENT, OwnCase, own_case
from pipeline.errors import ParamsError
from pipeline.evaluation.closed_loop import locked_up
from pipeline.laws.predictive.predictive import Predictive
from pipeline.models.base import load_model
from pipeline.plants.signals import Signals
from pipeline.records.record import Record
from pipeline.simulation.scenario import Scenario
from pipeline.simulation.simulate import Trajectory, simulate_closed
from pipeline.simulation.timetable import parse_event, timetable
from serving.manifest import Signal

GAINS = np.array([[2.0, -0.8], [0.6, 1.5]])
POLES = (np.array([0.9, 0.8]), np.array([0.88, 0.82]), np.array([0.91, 0.78]))
RATE = 0.06  # of the level, a period at full MV


def section(n_y: int, n_mv: int, **more: Any) -> dict[str, Any]:
    pv = [{"name": f"y{i}", "unit": "m", "low": -3.0, "high": 3.0} for i in range(n_y)]
    mv = [{"name": f"u{i}", "unit": "V", "low": -1.0, "high": 1.0} for i in range(n_mv)]
    return {"period_s": 1.0, "pv": pv, "mv": mv, "dv": [], "data": "data/it/record.parquet", "source": [], **more}


def case_of(entry: dict[str, Any], models: list[Any], pv: np.ndarray, mv: np.ndarray) -> OwnCase:
    """The case in the present folder with a record and models, the first of them the law's."""
    Path("params.yaml").write_text(yaml.safe_dump({"plants": {"it": entry}, "cases": {}}))
    groups = {k: tuple(Signal(**s) for s in entry[k]) for k in ("pv", "mv")}
    signals = Signals(1.0, groups["pv"], groups["pv"], (), groups["mv"])
    Path("data/it").mkdir(parents=True, exist_ok=True)
    Record.of(signals, pv, mv).write(Path(entry["data"]))
    folder = Path("work/it/models/identified/seed0")
    folder.mkdir(parents=True, exist_ok=True)
    for name, model in zip(("identified", "plant1", "plant2"), models, strict=True):
        model.save(folder / f"{name}.npz")
    case = own_case("it")
    assert isinstance(case, OwnCase)
    return case


@pytest.fixture
def two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    """Two lags that both MVs move."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    mv = np.repeat(rng.uniform(-0.6, 0.6, (40, 2)), 25, axis=0)
    y = np.zeros((len(mv), 2))
    for k in range(len(mv) - 1):
        y[k + 1] = y[k] + (1 - POLES[0]) * (GAINS @ mv[k] - y[k])
    rest = np.eye(2, 5)
    models = [scaled_model(2, 2, 0, 2, a=np.diag(p), b=(1 - p)[:, None] * GAINS, rest=rest) for p in POLES]
    return case_of(section(2, 2), models, y, mv)


@pytest.fixture
def level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    """A level that the valve fills through a lag, and that does not stand still at the valve's median."""
    monkeypatch.chdir(tmp_path)
    rng, mv, y = np.random.default_rng(0), np.zeros((900, 1)), np.zeros((900, 1))
    a, b, c = np.array([[1.0, RATE], [0.0, 0.5]]), np.array([[0.0], [0.5]]), np.array([-0.2 * RATE, 0.0])
    x = np.zeros(2)
    for k in range(900):
        y[k] = x[0]
        if k % 15 == 0:
            mv[k:] = np.clip(0.2 - 0.5 * x[0] + rng.uniform(-0.7, 0.9), -1, 1)
        x = a @ x + b @ mv[k] + c
    rest = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    models = [scaled_model(1, 1, 0, 2, a=a, b=b * s, c=c, rest=rest) for s in (1.0, 0.9, 1.1)]
    return case_of(section(1, 1), models, y, mv)


def closed(case: OwnCase, test: Scenario) -> Trajectory:
    model = load_model(case.models / "identified.npz")
    settings = Predictive.Params(tuning="given", horizon=15, moves=4)
    law = Predictive.design(settings, {"identified": model}, case.plant.signals, case.plant).eval()
    state = torch.zeros(law.n_state, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.float64)

    @torch.no_grad()
    def step(sp: np.ndarray, pv: np.ndarray, mv: np.ndarray) -> tuple[np.ndarray, list[float]]:
        nonlocal state
        out, state, _ = law(*(torch.from_numpy(v) for v in (sp, pv)), none, torch.from_numpy(mv), state)
        return out.numpy(), []

    assert test.plant is not None
    return simulate_closed(test.plant, step, test)


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
    for name in ("held_out", "spoilt", "load"):
        test = two.scenarios()[name][0]
        loop = closed(two, test)
        assert not locked_up(test.sp, loop.pv, loop.mv, test.hold, low=[-1, -1], high=[1, 1], span=[6, 6])
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
    # At the median MV and without a load it stays; at full speed it needs width / (rate x MV's way) samples.
    low, high = np.quantile(level.record.pv, (0.01, 0.99))
    bottom, top = np.quantile(level.record.mv, (0.1, 0.9))
    needed = (high - low) / (RATE * (top - bottom))
    assert level.hold == pytest.approx(3 * needed, abs=9)


def test_a_law_holds_a_level_against_a_load(level: OwnCase) -> None:
    for name in ("held_out", "spoilt", "load"):
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
    assert locked_up(np.zeros((20, 2)), pv, mv, 0, low=[-1, -1], high=[1, 1], span=[2, 2]) is said


def test_a_simulation_moves_the_set_point_that_is_named(two: OwnCase) -> None:
    run = timetable(two.plant, set_points=[parse_event("y1=0.5@10", "[NAME=]VALUE[@S]")])
    assert np.ptp(run.sp[:, 0]) == 0
    assert run.sp[9, 1] != 0.5
    assert np.all(run.sp[10:, 1] == 0.5)
    for text, said in (("0.5", "name one: y0=VALUE"), ("y2=0.5", "no set point 'y2'"), ("y0=5", "outside")):
        with pytest.raises(ParamsError, match=said):
            timetable(two.plant, set_points=[parse_event(text, "[NAME=]VALUE[@S]")])
