"""An own plant with a simulator: its controllers are tested on it, and tuned on models of its record."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import all_cases
from loopwright.pipeline.cases.own_model import OwnPlant
from loopwright.pipeline.cases.own_simulator import SimulatedCase
from loopwright.pipeline.cases.own_tests import TEST_LOAD
from loopwright.pipeline.plants.simulator_file import FileSimulator
from loopwright.pipeline.simulation.simulate import simulate_closed
from loopwright.pipeline.stages.check import mistakes

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_simulator" / "heater.py"


def model(pole: float) -> dict[str, np.ndarray]:
    """A lag from valve and feed to the temperature, about as the heater."""
    return {
        "a": np.array([[pole]]),
        "b": (1 - pole) * np.array([[1.5, -0.2]]),
        "c": np.zeros(1),
        "w1": np.zeros((0, 3)),
        "b1": np.zeros(0),
        "w2": np.zeros((1, 0)),
        "y_center": np.array([45.0]),
        "y_scale": np.array([20.0]),
        "v_center": np.array([50.0, 900.0]),
        "v_scale": np.array([40.0, 200.0]),
        "noise": np.array([0.01]),
        **{name: np.zeros(1) for name in ("colour", "gain_sd", "pace_sd", "dead_sd")},
        **{name: np.zeros(0) for name in ("dv_noise", "dv_change")},
        "rest": np.array([[1.0, 0.0, 0.0, 0.0]]),
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder after `loopwright new heater --simulator heater.py`, with three models in place of trained ones."""
    path = tmp_path_factory.mktemp("simulated")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
        assert main(["new", "heater", "--simulator", str(EXAMPLE), "--rows", "1500"]) == 0
        models = Path("work/heater/models/identified/seed0")
        models.mkdir(parents=True)
        for name, pole in {"identified": 0.95, "plant1": 0.94, "plant2": 0.96}.items():
            np.savez(models / f"{name}.npz", **model(pole))
    return path


@pytest.fixture
def heater(folder: Path, monkeypatch: pytest.MonkeyPatch) -> SimulatedCase:
    monkeypatch.chdir(folder)
    case = all_cases()["heater"]
    assert isinstance(case, SimulatedCase)
    return case


def test_the_door_leaves_a_record_its_copy_and_a_section(heater: SimulatedCase) -> None:
    assert {p.name for p in Path("data/heater").iterdir()} == {
        "record.parquet", "screening.json", "screening.html", "first_test.json", "simulator.py",
    }  # fmt: skip
    section = yaml.safe_load(Path("params.yaml").read_text())["plants"]["heater"]
    assert section["simulator"] == "data/heater/simulator.py"
    assert section["period_s"] == 30.0  # three steps of the simulator: it settles within 200 of them
    report = json.loads(Path("data/heater/screening.json").read_text())
    assert report["kept_rows"] == 1500
    assert report["verdict"]["carries"] == "yes", report["verdict"]["reasons"]
    assert "68 periods of 30 s" in report["findings"][0]["words"]
    assert mistakes() == []


def test_laws_are_tuned_on_models_and_tested_on_the_simulator(heater: SimulatedCase) -> None:
    tests = heater.tests()
    assert isinstance(heater.plant, OwnPlant)
    assert all(isinstance(t.plant, FileSimulator) for name, ts in tests.items() for t in ts if name != "spoilt")
    assert not any(isinstance(t.plant, FileSimulator) for t in (*tests["spoilt"], *heater.development()))
    assert heater.stand_in == "simulator"
    assert heater.reads == (Path("data/heater/simulator.py"),)
    assert {t.plant.period_s for t in tests["held_out"] if t.plant} == {30.0}


def test_the_controller_s_range_is_not_the_experiment_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text("cases: {}\nrecords: {}\nmodels: {}\ncontrollers: {}\n")
    new = ["new", "heater", "--simulator", str(EXAMPLE), "--rows", "600"]
    with monkeypatch.context() as patch:
        patch.setattr("loopwright.pipeline.commands.new.simulated", lambda *_: pytest.fail("the experiment has begun"))
        assert main([*new, "--command", "valve=70..90"]) == 2
    error = capsys.readouterr().err
    assert "the simulator starts with valve = " in error
    assert "70 to 90 may be commanded" in error
    assert not Path("data").exists()
    assert main([*new, "--command", "valve=30..60", "--max-move", "valve=4"]) == 0
    case = all_cases()["heater"]
    assert isinstance(case, SimulatedCase)
    (valve,) = case.plant.mv_signals
    assert (valve.low, valve.high, valve.max_move) == (30.0, 60.0, pytest.approx(4 * case.plant.period_s / 60))
    assert case.record.mv.min() < 30 < 60 < case.record.mv.max()
    assert [(s.low, s.high) for s in case.simulator.mv_signals] == [(0.0, 100.0)]


def test_a_load_moves_the_simulator_as_far_as_it_would_the_models(heater: SimulatedCase) -> None:
    for test in heater.scenarios()["load"]:
        assert test.plant is not None
        (name,) = test.changes
        assert name == "load_valve"
        rest = simulate_closed(test.plant, lambda sp, pv, mv: (mv, []), test)
        moved = rest.pv[heater.hold, 0] - rest.pv[0, 0]
        assert abs(moved) == pytest.approx(TEST_LOAD * heater.record.pv[:, 0].std(), rel=0.1)  # the heater is nonlinear


def test_a_load_is_no_larger_than_the_valve_can_take_back(heater: SimulatedCase) -> None:
    at = float(heater.simulator.start[1][0])
    (valve,) = heater.signals.mv
    near = replace(valve, low=at - 4.0, high=at + 2.0)
    narrow = type("Narrow", (type(heater),), {"signals": replace(heater.signals, mv=(near,))})(heater.held_out_seeds)
    loads = [test.changes["load_valve"] for test in narrow.scenarios()["load"]]
    assert all(load.any() for load in loads)
    needed = at - np.concatenate(loads)
    assert near.low + 0.3 - 1e-9 <= needed.min() < needed.max() <= near.high - 0.3 + 1e-9


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--simulator", "none.py"], "none.py: no such file"),
        (["x.csv", "--simulator", str(EXAMPLE)], "--simulator and an export"),
        (["--simulator", str(EXAMPLE), "--period", "17"], "a multiple of the simulator's period, 10 s"),
        ([], "no file is named"),
    ],
)
def test_what_cannot_be_is_one_line_and_writes_nothing(
    arguments: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text("cases: {}\n")
    assert main(["new", "tank", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not Path("data").exists()
