"""Stress tests: draws, and loops that are those of the controller step by step."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identified_models import first_order, made_signals, random_model
from own_cases import controllers_of_a_lag

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.engine.cluster import connected, local_cluster
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.stress.batches import outcomes_of
from loopwright.pipeline.evaluation.stress.draws import KINDS, LATE_LOOPS, NOISE, Actuators, Draw, Drawing
from loopwright.pipeline.evaluation.stress.loops import Stress, advance_rows, swings
from loopwright.pipeline.evaluation.stress.summary import Summary, table
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.serving import ContractError, Controller, LoopwrightError, Signal

ROOT = Path(__file__).parents[2]
PH = ROOT / "artifacts/ph_neutralization/pid.onnx"
PH_CASE = CASES["ph_neutralization"]
VALVE = (Signal("valve", "%", 0.0, 100.0),)


@pytest.fixture(scope="module")
def stress() -> Stress:
    return Stress(Drawing(PH_CASE, seed=3), PH.read_bytes())


def own_stress(folder: Path, **options: Any) -> Stress:
    """A PID on the lag of ``own_cases``, in the present folder."""
    case = controllers_of_a_lag({})
    law = LAWS["pid"]
    params = law.Params(tuning="manual", kc=0.2, ti_s=3.0)
    export(law.design(params, {}, case.plant.signals, case.plant), folder / "it.onnx", case="it", provenance={})
    return Stress(Drawing(case, **options), (folder / "it.onnx").read_bytes())


# ---------------------------------------------------------------------- draws
def same(one: Draw, other: Draw) -> bool:
    numbers = (one.quantities(), one.fault, one.test) == (other.quantities(), other.fault, other.test)
    return numbers and np.array_equal(one.scenario.sp, other.scenario.sp)


def test_a_draw_depends_on_seed_and_number_alone() -> None:
    first = Drawing(PH_CASE, seed=3).draws(range(8))
    again = Drawing(PH_CASE, seed=3)
    assert all(same(first[i], again.draw(i)) for i in (7, 0, 4))
    assert not any(same(a, Drawing(PH_CASE, seed=4).draw(a.index)) for a in first)
    std = PH_CASE.noise_std
    assert np.array_equal(first[2].deviation(PH_CASE.plant, std), again.draw(2).deviation(PH_CASE.plant, std))


def test_draws_lie_within_the_stated_ranges() -> None:
    drawing = Drawing(CASES["henson_seborg_cstr"], spread=0.03)
    plant = drawing.case.plant
    ranges = drawing.ranges(plant)
    assert ranges["E_R"] == CASES["henson_seborg_cstr"].ranges["E_R"]
    assert ranges["V"] == pytest.approx((97.0, 103.0))
    assert not {"T_f", "C_f"} & set(ranges)  # its tests disturb these
    for draw in drawing.draws(range(40)):
        assert set(draw.parameters) == set(ranges)
        assert all(ranges[k][0] <= v <= ranges[k][1] for k, v in draw.parameters.items())
        assert NOISE[0] <= draw.noise <= NOISE[1]
        course = draw.scenario.changes.get("T_f", np.array([350.0]))
        assert 340.0 <= course.min() <= course.max() <= 360.0
        assert 0.005 <= draw.scenario.sp.min() <= draw.scenario.sp.max() <= 0.14


def test_the_share_of_faults_is_the_one_asked_for() -> None:
    assert all(d.fault is None for d in Drawing(PH_CASE, faults=0.0).draws(range(20)))
    draws = Drawing(PH_CASE, faults=1.0).draws(range(60))
    assert {d.fault.kind for d in draws if d.fault} == set(KINDS)
    assert abs(np.mean([d.late for d in draws]) - LATE_LOOPS) < 0.25
    held = [replace(d, fault=None) for d in draws[:3]]
    assert all(same(a, b) for a, b in zip(held, Drawing(PH_CASE, faults=0.0).draws(range(3)), strict=True))


def test_an_own_plant_is_drawn_within_the_doubts_of_its_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drawing = own_stress(tmp_path).drawing
    assert isinstance(drawing.case, OwnCase)
    doubts = drawing.case._doubts
    plants = set()
    for draw in drawing.draws(range(60)):
        assert set(draw.parameters) == {"gain_u0", "time_constant", "dead_time"}
        assert 1 / (1 + doubts.gain[0]) <= draw.parameters["gain_u0"] <= 1 + doubts.gain[0]
        assert 1 / (1 + doubts.pace) <= draw.parameters["time_constant"] <= 1 + doubts.pace
        assert 0 <= draw.parameters["dead_time"] <= doubts.dead
        plants.add(id(drawing.plant_of(draw.scenario)))
    assert len(plants) == len(drawing.case.members)


def test_a_plant_without_parameters_is_refused() -> None:
    class Bare(Simulator):
        name = "bare"
        pv_signals = sp_signals = mv_signals = VALVE
        period_s = 1.0
        start = (np.zeros(1), np.zeros(1))  # type: ignore[assignment]

        def step(self, x: Any, mv: Any, dv: Any, p: Any) -> Any:
            return x

        def measure(self, x: Any) -> Any:
            return x

    class BareTests(Drawing):
        disturbed = frozenset()  # type: ignore[assignment]

    with pytest.raises(PlantError, match="'bare' has no parameters"):
        BareTests(PH_CASE).ranges(Bare())


# ---------------------------------------------------------------------- loops
def step_by_step(stress: Stress, draw: Draw) -> tuple[np.ndarray, np.ndarray]:
    """(pv, mv) of one loop through ``Controller.step``."""
    controller, plant, test = stress.controller, stress.drawing.plant_of(draw.scenario), draw.scenario
    noise = draw.deviation(plant, stress.drawing.case.noise_std)
    advance, parameters, dv = advance_rows(plant, 1), test.parameters(plant), test.disturbances(plant)
    actuators = Actuators(plant.mv_signals, [draw.fault], test.mv0[None], [draw.late])
    x, applied, state, pvs, mvs = test.x0[None], test.mv0, controller.cold_state(), [], []
    for k in range(test.samples):
        pvs.append(plant.measured(x)[0])
        try:
            mv, state, _ = controller.step(
                sp=test.sp[k],
                pv=pvs[-1] + noise[k],
                dv=dv[k],
                mv_applied=applied,
                state=state,
                operate=stress.operated,
            )
        except LoopwrightError:
            mv, state = applied, controller.cold_state()
        position, acting = actuators.move(k, mv[None])
        applied = position[0]
        mvs.append(applied)
        x = advance(x, acting, dv[k][None], parameters[k][None])
    return np.array(pvs), np.array(mvs)


def test_loops_side_by_side_are_those_of_the_controller(stress: Stress) -> None:
    draws = stress.drawing.draws(range(6))
    assert any(d.fault for d in draws)
    assert any(d.late for d in draws)
    for draw, (loop, _) in stress.loops(draws):
        pv, mv = step_by_step(stress, draw)
        assert np.array_equal(loop.pv, pv)
        assert np.array_equal(loop.mv, mv)


def test_loops_have_the_operate_that_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    case = controllers_of_a_lag({})
    (mv,) = case.plant.mv_signals
    law = Predictive(case.plant.signals, first_order(0.6), Predictive.Params(horizon=20, operate={})).eval()
    export(law, tmp_path / "it.onnx", case="it", provenance={})
    drawing, content, middle = Drawing(case, faults=0.0), (tmp_path / "it.onnx").read_bytes(), mv.middle
    limited = Stress(drawing, content, ((f"{mv.name}.high", middle), (f"{mv.name}.low", middle - 0.1)))
    draws = drawing.draws(range(4))
    free = [loop.mv.max() for _, (loop, _) in Stress(drawing, content).loops(draws)]
    assert max(free) > middle
    for draw, (loop, _) in limited.loops(draws):
        pv, moved = step_by_step(limited, draw)
        assert np.array_equal(loop.pv, pv)
        assert np.array_equal(loop.mv, moved)
        assert loop.mv.max() <= max(middle, draw.scenario.mv0[0])
    with pytest.raises(ContractError, match="allowed is"):
        Stress(drawing, content, ((f"{mv.name}.high", mv.high + 1),)).outcomes([0])


def test_a_refused_sample_holds_the_mv_and_begins_anew(stress: Stress, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sensor fails for a sample: the row is refused as the controller refuses it, and its neighbours go on."""
    whole = Draw.deviation

    def failing(draw: Draw, plant: Simulator, std: np.ndarray) -> np.ndarray:
        found = whole(draw, plant, std)
        if draw.index == 1:
            found[7] = np.nan
        return found

    before = stress.outcomes([0, 1])
    monkeypatch.setattr(Draw, "deviation", failing)
    after = stress.outcomes([0, 1])
    assert after[0] == before[0]
    assert after[1].refused == 1
    assert after[1].failed
    (draw, (loop, _)), *_ = stress.loops([stress.drawing.draw(1)])
    assert np.array_equal(loop.mv, step_by_step(stress, draw)[1])


def test_a_replay_is_the_loop_of_the_run(stress: Stress) -> None:
    assert [stress.loop(i)[2] for i in (4, 1)] == [stress.outcomes(range(6))[i] for i in (4, 1)]


def test_batches_change_nothing(stress: Stress) -> None:
    whole = outcomes_of(stress, 23, batch=23, workers=1)
    assert whole == outcomes_of(stress, 23, batch=4, workers=1)
    assert [one.index for one in whole] == list(range(23))


@pytest.mark.parametrize("n_hidden", [0, 5])
def test_rows_of_an_identified_plant_are_its_steps(n_hidden: int) -> None:
    model = random_model(0, n_y=2, n_mv=2, n_dv=1, n_hidden=n_hidden)
    arrays = IdentifiedArrays(**{f.name: getattr(model, f.name).numpy() for f in fields(IdentifiedArrays)})
    plant = IdentifiedPlant(made_signals(2, 2, 1), arrays, most_dead_time=3)
    rng, n = np.random.default_rng(1), 9
    x = plant.start[0] + rng.normal(size=(n, plant.n_x))
    mv, dv = rng.uniform(-1, 1, (n, 2)), rng.uniform(-1, 1, (n, 1))
    p = np.tile(plant.parameters(), (n, 1))
    p[:, :2], p[:, 2] = rng.uniform(0.7, 1.3, (n, 2)), np.linspace(0.6, 1.4, n)
    p[:, 3], p[:, 4:] = np.linspace(0, 3, n), rng.normal(size=(n, 2))
    rows = advance_rows(plant, n)(x, mv, dv, p)
    single = np.array([plant.step(*row) for row in zip(x, mv, dv, p, strict=True)])
    assert rows == pytest.approx(single, rel=1e-12, abs=1e-12)
    alone = [advance_rows(plant, 1)(*(part[i : i + 1] for part in (x, mv, dv, p)))[0] for i in range(n)]
    assert np.array_equal(rows, np.array(alone))


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_two_workers_find_what_one_process_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loops of an own plant on real processes, which see nothing of its files."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}/tools/roots{os.pathsep}{ROOT / 'tests'}")
    monkeypatch.setattr("loopwright.pipeline.engine.cluster.PRELOAD", [])  # which takes each worker seconds
    own = own_stress(tmp_path)
    alone = outcomes_of(own, 40, workers=1)
    with local_cluster(2) as at:
        connected(at).wait_for_workers(2, timeout=120)
        monkeypatch.chdir(ROOT)
        assert outcomes_of(own, 40, batch=7) == alone
    assert len({one.figures["mae"] for one in alone}) > 20


# ---------------------------------------------------------------------- together
def test_the_summary_counts_what_the_loops_say(stress: Stress) -> None:
    draws, outcomes = stress.drawing.draws(range(40)), stress.outcomes(range(40))
    outcomes[5] = replace(outcomes[5], locked_up=True)
    summary = Summary(PH_CASE, "pid", draws, outcomes)
    assert summary.counts["locked up"] == 1
    assert summary.counts["any of these"] >= 1
    assert summary.worst(1) == [5]
    mae = next(s for s in summary.spreads() if s.metric == "mae" and not s.test)
    assert mae.values[-1] == max(one.figures["mae"] for one in outcomes)
    for met in summary.requirements():
        need = met.requirement
        values = [o.figures[need.metric] for d, o in zip(draws, outcomes, strict=True) if d.test == need.scenario]
        assert met.loops == len(values)
        assert met.share <= np.mean([need.low <= v <= need.high for v in values])
    rows = table(draws, outcomes)
    assert rows["index"] == list(range(40))
    assert len({len(column) for column in rows.values()}) == 1


def test_a_quantity_that_the_error_follows_stands_first(stress: Stress) -> None:
    draws = stress.drawing.draws(range(60))
    (one,) = stress.outcomes([0])
    outcomes = [replace(one, index=d.index, figures={**one.figures, "sse": d.parameters["A"] ** 40}) for d in draws]
    first = Summary(PH_CASE, "pid", draws, outcomes).growths()[0]
    assert first.name == "A"
    assert list(first.median) == sorted(first.median)


def test_the_controller_of_a_stress_is_the_file(stress: Stress) -> None:
    assert stress.controller.sha256 == Controller(PH).sha256


def test_a_loop_that_swings_about_its_last_set_point_is_told_from_one_that_follows() -> None:
    k, span = np.arange(200), np.array([10.0, 10.0])
    sp = np.where(k < 100, 2.0, 5.0)[:, None] * np.ones(2)
    settles = sp[:, 0] + 1.0 * np.exp(-(k % 100) / 10) * np.cos(k)
    swings_on = sp[:, 1] + 0.2 * np.cos(2 * np.pi * k / 12)
    assert swings(sp, np.column_stack([settles, swings_on]), span).tolist() == [False, True]
    small, once = sp[:, 0] + 0.05 * np.cos(k), sp[:, 1] + np.where(k < 180, 1.0, -1.0)
    assert swings(sp, np.column_stack([small, once]), span).tolist() == [False, False]
    moving = np.where(k // 5 % 2, 2.0, 5.0)[:, None]  # a set point that moves: the error's sides are its own
    assert not swings(moving, np.roll(moving, 1, axis=0), span[:1]).any()
