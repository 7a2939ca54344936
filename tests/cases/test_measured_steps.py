"""An own plant with a measured disturbance is tested with steps of it, which every law is given alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from identified_models import first_order
from own_cases import case_of, section

from loopwright.pipeline.cases.own_plant import GATE, LOAD_AT, MEASURED, OwnCase
from loopwright.pipeline.cases.own_tests import LOAD_ROOM
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.evaluation.trials import close_loop
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models import load_model
from loopwright.pipeline.optimal.model_bounds import SampledHorizon, run_sampled
from loopwright.pipeline.plants.identified import IdentifiedPlant
from loopwright.pipeline.simulation.live import SimulatedPlant
from loopwright.pipeline.simulation.simulate import Trajectory, simulate_closed
from loopwright.pipeline.simulation.timetable import Timetable, parse_event, timetable
from loopwright.serving.controller import Controller

POLES, GAIN = (0.8, 0.78, 0.82), 2.0
INFLOW = {"name": "d0", "unit": "V", "low": -1.0, "high": 1.0}


def heater(answer: float = 1.0, levels: tuple[float, ...] = (-0.4, 0.0, 0.0, 0.5)) -> OwnCase:
    """A lag of the MV, gain 2, and of a measured disturbance that takes ``levels`` in turn."""
    rng = np.random.default_rng(0)
    mv = np.repeat(rng.uniform(-0.6, 0.6, (40, 1)), 20, axis=0)
    dv = np.resize(np.repeat(levels, 50), len(mv))[:, None]
    y = np.zeros((len(mv), 1))
    for k in range(len(mv) - 1):
        y[k + 1] = POLES[0] * y[k] + (1 - POLES[0]) * (GAIN * mv[k] + answer * dv[k])
    models = [first_order(pole, GAIN, disturbance=answer) for pole in POLES]
    return case_of(section(1, 1, dv=[INFLOW]), models, y, mv, dv)


@pytest.fixture
def case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    monkeypatch.chdir(tmp_path)
    return heater()


def test_each_test_steps_within_the_record_and_back(case: OwnCase) -> None:
    tests = case.tests()[MEASURED]
    assert len(tests) == len(case.held_out_seeds)
    low, high = case.record.dv.min(), case.record.dv.max()
    for test in tests:
        assert test.dv is not None
        assert test.plant in case.members
        assert len(test.dv) == test.samples == 2 * case.hold
        away = np.flatnonzero(test.dv[:, 0] != np.median(case.record.dv))
        assert (away[0], away[-1] + 1) == (LOAD_AT, LOAD_AT + case.hold)
        assert low <= test.dv.min() <= test.dv.max() <= high
        assert not test.changes
    assert {float(np.sign(t.dv[LOAD_AT, 0])) for t in tests if t.dv is not None} == {-1.0, 1.0}


def test_the_plant_rests_before_the_step_and_is_moved_by_it(case: OwnCase) -> None:
    for test in case.tests()[MEASURED]:
        assert test.plant is not None
        assert test.dv is not None
        loop = simulate_closed(test.plant, lambda sp, pv, mv: (mv, []), test)
        assert np.ptp(loop.pv[: LOAD_AT + 1]) < 1e-9
        assert loop.pv[LOAD_AT + case.hold, 0] - loop.pv[0, 0] == pytest.approx(test.dv[LOAD_AT, 0], abs=1e-3)
        assert loop.pv[-1, 0] == pytest.approx(loop.pv[0, 0], abs=1e-3)


def test_a_simulation_moves_the_measured_disturbance_that_is_named(case: OwnCase) -> None:
    def run(text: str) -> Timetable:
        moves = [parse_event("y0=0.1", "[NAME=]VALUE[@S]")]
        return timetable(case.plant, set_points=moves, disturbances=[parse_event(text, "NAME=VALUE[@S]")])

    moved = run("d0=0.5@10").dv
    assert moved is not None
    assert np.all(moved[:10, 0] == case.plant.dv_nominal[0])
    assert np.all(moved[10:, 0] == 0.5)
    for text, said in (("d0=5", "outside"), ("d1=0.1", "no measured disturbance or parameter 'd1'")):
        with pytest.raises(ParamsError, match=said):
            run(text)


def test_the_noise_of_a_reading_is_not_felt_by_the_plant(case: OwnCase) -> None:
    moves, quiet = [parse_event("y0=0.1", "[NAME=]VALUE[@S]")], case.plant.dv_nominal
    noise = [parse_event("d0=0.3", "PV=STD")]
    run = timetable(case.plant, set_points=moves, noise=noise, duration_s=2000 * case.plant.period_s, seed=4)
    simulated = SimulatedPlant(case.plant, run)
    read = []
    for _ in range(len(run.sp)):
        read.append(simulated.read().dv)
        simulated.write(run.mv0)
        assert np.array_equal(simulated.dv, quiet)
    assert np.std(np.array(read) - quiet) == pytest.approx(0.3, rel=0.1)
    assert not run.noise.any()


def test_a_step_that_no_mv_could_balance_is_made_smaller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    case = heater(answer=12.0)  # 6 times the MV's gain: half its range would be exceeded three times over
    for test in case.tests()[MEASURED]:
        assert test.dv is not None
        step = test.dv[LOAD_AT, 0]
        assert abs(step) > 0
        assert abs(test.mv0[0] - 6 * step) <= 1 - 2 * LOAD_ROOM + 1e-9
        assert abs(step) < 0.4


def test_a_disturbance_that_never_moves_leaves_the_test_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (test,) = heater(levels=(0.2,)).tests()[MEASURED]
    assert test.dv is not None
    assert np.ptp(test.dv) == 0


def test_the_gate_counts_the_test_where_there_is_one(case: OwnCase, tmp_path: Path) -> None:
    assert case.gate[MEASURED] > 0
    assert sum(case.gate.values()) == pytest.approx(1)
    y = np.random.default_rng(0).normal(size=(400, 1))
    plain = case_of(section(1, 1), [first_order(pole) for pole in POLES], y, np.clip(y, -1, 1))
    assert plain.gate == GATE
    assert MEASURED not in plain.tests()


def test_the_perfect_nmpc_sees_the_step(case: OwnCase) -> None:
    """A plant that answers both alike: what the disturbance does, the MV takes back within the same period."""
    test = case.tests()[MEASURED][0]
    assert isinstance(test.plant, IdentifiedPlant)
    bound = run_sampled(SampledHorizon(test.plant, 20), test, case.score)
    assert bound["mae"] < 1e-4
    assert bound["failures"] == 0


class Noted:
    """A controller that notes the measured disturbances that it is given, and keeps its MV."""

    manifest = SimpleNamespace(info=(), operate=(), inputs=())

    def __init__(self) -> None:
        self.given: list[np.ndarray] = []

    def cold_state(self) -> np.ndarray:
        return np.zeros(0)

    def step(self, *, sp: Any, pv: Any, dv: np.ndarray, mv_applied: np.ndarray, state: np.ndarray) -> Any:
        self.given.append(dv.copy())
        return mv_applied, state, np.zeros(0)


def test_a_controller_is_given_each_sample_of_the_disturbance(case: OwnCase) -> None:
    for name in (MEASURED, "load"):
        test, controller = case.tests()[name][0], Noted()
        close_loop(cast(Controller, controller), case.plant, test, None, 0)
        assert test.plant is not None
        wanted = np.tile(test.plant.dv_nominal, (test.samples, 1)) if test.dv is None else test.dv
        np.testing.assert_array_equal(np.array(controller.given), wanted)


def test_a_law_that_knows_the_disturbance_gains_by_it(case: OwnCase) -> None:
    """The same law, told the disturbance and told that it stays: what it is told is worth most of the error."""
    test, model = case.tests()[MEASURED][0], load_model(case.models / "identified.npz")
    assert test.plant is not None
    settings = Predictive.Params(tuning="given", horizon=12, moves=4)
    law = Predictive.design(settings, {"identified": model}, case.plant.signals, case.plant).eval()
    errors = []
    for told in (test.disturbances(test.plant), np.tile(test.plant.dv_nominal, (test.samples, 1))):
        state, rows = torch.zeros(law.n_state, dtype=torch.float64), iter(torch.from_numpy(told.copy()))

        @torch.no_grad()
        def step(sp: Any, pv: Any, mv: Any, rows: Any = rows) -> Any:
            nonlocal state
            sp, pv, mv = (torch.from_numpy(v) for v in (sp, pv, mv))
            out, state, _ = law(sp, pv, next(rows), mv, state)
            return out.numpy(), []

        errors.append(case.score(test, *_courses(simulate_closed(test.plant, step, test)))["mae"])
    assert errors[0] < 0.3 * errors[1]


def _courses(loop: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    return loop.pv, loop.mv


def test_what_cannot_be_is_named(case: OwnCase) -> None:
    test = case.tests()[MEASURED][0]
    assert test.dv is not None
    with pytest.raises(PlantError, match=r"dv has shape \(3, 1\); give \(n, n_dv\) with a row for each of"):
        replace(test, dv=test.dv[:3])
    with pytest.raises(PlantError, match="has 2 measured disturbances; plant 'it' has 1"):
        replace(test, dv=np.hstack([test.dv, test.dv])).disturbances(case.plant)
    assert replace(test, dv=test.dv + 0.1).digest() != test.digest()
