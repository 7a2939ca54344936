"""A person's own plant as a case: its section of params.yaml, its record, and models in place of the plant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from loopwright.pipeline.cases import CASES, all_cases
from loopwright.pipeline.cases.own_model import LEAST_GAIN_ERROR, Doubts, OwnPlant
from loopwright.pipeline.cases.own_plant import LOAD_AT, OwnCase, own_case
from loopwright.pipeline.cases.own_tests import TEST_LOAD
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.historian.settling import MOST_PERIODS
from loopwright.pipeline.models.identified.dynamics import Dynamics
from loopwright.pipeline.models.identified.identified import remembering
from loopwright.pipeline.plants.simulator import PerturbedPlant, Signals
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import noise_draws, simulate_closed
from loopwright.pipeline.tuning.responses import StepResponses
from loopwright.serving.manifest import Signal

TEMPERATURE = {"name": "TIC-101.PV", "unit": "degC", "low": 20.0, "high": 90.0}
VALVE = {"name": "TIC-101.OP", "unit": "%", "low": 0.0, "high": 100.0}
SECTION: dict[str, Any] = {
    "period_s": 10.0,
    "pv": [TEMPERATURE],
    "mv": [VALVE],
    "dv": [],
    "data": "data/heater/record.parquet",
    "source": [],
}


def model(pole: float) -> dict[str, np.ndarray]:
    """A lag from the valve to the temperature: 20 degC at 0 %, 80 degC at 100 %."""
    return {
        "a": np.array([[pole]]),
        "b": np.array([[(1 - pole) * 1.5]]),
        "c": np.zeros(1),
        "w1": np.zeros((0, 2)),
        "b1": np.zeros(0),
        "w2": np.zeros((1, 0)),
        "y_center": np.array([50.0]),
        "y_scale": np.array([20.0]),
        "v_center": np.array([50.0]),
        "v_scale": np.array([50.0]),
        "noise": np.array([0.01]),
        **{name: np.zeros(1) for name in ("colour", "gain_sd", "pace_sd", "dead_sd")},
        **{name: np.zeros(0) for name in ("dv_noise", "dv_change")},
        "rest": np.array([[1.0, 0.0, 0.0]]),
    }


def wrote(folder: Path, section: dict[str, Any]) -> None:
    (folder / "params.yaml").write_text(yaml.safe_dump({"plants": {"heater": section}, "cases": {}}))


@pytest.fixture
def heater(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OwnCase:
    """The case in a folder with its record and three trained models, the last two for its tests."""
    monkeypatch.chdir(tmp_path)
    wrote(tmp_path, SECTION)
    signal, valve = Signal(**TEMPERATURE), Signal(**VALVE)
    signals = Signals(10.0, (signal,), (signal,), (), (valve,))
    mv = np.random.default_rng(0).uniform(20, 60, (500, 1))
    Path("data/heater").mkdir(parents=True)
    Record.of(signals, 20 + 0.6 * mv, mv).write(Path(SECTION["data"]))
    folder = Path("work/heater/models/identified/seed0")
    folder.mkdir(parents=True)
    for name, pole in {"identified": 0.9, "plant1": 0.88, "plant2": 0.92}.items():
        np.savez(folder / f"{name}.npz", **model(pole))
    case = all_cases()["heater"]
    assert isinstance(case, OwnCase)
    return case


def test_it_stands_after_the_cases_of_the_papers(heater: OwnCase) -> None:
    assert list(all_cases()) == [*CASES, "heater"]
    assert (heater.title, heater.plant.period_s, heater.on_models) == ("Heater", 10.0, True)
    assert heater.ready


def test_no_test_runs_on_the_law_s_own_model(heater: OwnCase) -> None:
    tests = [test for sequences in heater.tests().values() for test in sequences]
    assert all(test.plant is not None and test.plant is not heater.plant for test in tests)
    assert {id(test.plant) for test in tests} == {id(plant) for plant in heater.members}
    assert all(test.plant is heater.plant for test in heater.development())


def test_no_development_sequence_decides_alone_however_large_its_errors_are(heater: OwnCase) -> None:
    """Half the error on four sequences, twice the error on the last one, of a plant that nobody controls well."""
    for size in (1.0, 1e3):
        assert heater.developed([1.0] * 4 + [2 * size]) < heater.developed([2.0] * 4 + [size])
    assert np.isnan(heater.developed([]))
    assert np.isnan(heater.developed([np.nan, 1.0]))
    assert heater.developed([0.0, 1.0]) > 0
    assert all_cases()["batch_reactor"].developed([1.0, 5.0]) == 3  # of the papers' cases the plain mean


def test_set_points_are_what_the_model_reaches_within_the_record(heater: OwnCase) -> None:
    low, high = np.quantile(heater.record.mv, (0.1, 0.9))
    for test in heater.scenarios()["held_out"]:
        assert test.sp.min() >= 20 + 0.6 * low - 1e-6
        assert test.sp.max() <= 20 + 0.6 * high + 1e-6
        assert len(np.unique(test.sp)) == len(test.sp) // heater.hold
    other = own_case("heater").with_held_out((7, 8, 9)).scenarios()["held_out"]
    assert not np.array_equal(other[0].sp, heater.scenarios()["held_out"][0].sp)


def test_a_set_point_is_held_three_times_as_long_as_the_model_needs(heater: OwnCase) -> None:
    needed = np.ceil(np.log(0.05) / np.log(0.9))
    assert abs(heater.hold - 3 * needed) <= 3


def test_spoilt_plants_have_errors_and_carry_a_load(heater: OwnCase) -> None:
    tests = heater.scenarios()
    high = 1 + LEAST_GAIN_ERROR  # of one error alone; together with others it is less
    gains = {float(t.changes["gain_TIC-101.OP"][0]) for t in tests["spoilt"]}
    assert sorted(gains) == pytest.approx([high ** -(2**-0.5), high ** (3**-0.5)])
    pairs = {(t.kind, id(t.plant)) for t in tests["spoilt"]}
    assert len(pairs) == len(tests["spoilt"])  # no kind meets the same model twice
    for test in tests["load"]:
        assert test.plant is not None
        rest = simulate_closed(test.plant, lambda sp, pv, mv: (mv, []), test)
        assert np.ptp(rest.pv[: LOAD_AT + 1]) < 1e-6
        moved = rest.pv[heater.hold + LOAD_AT, 0] - rest.pv[0, 0]
        assert abs(moved) == pytest.approx(TEST_LOAD * heater.record.pv[:, 0].std(), rel=0.01)
    assert len({np.sign(test.changes["load_TIC-101.PV"][-1]) for test in tests["load"]}) == 2


def test_errors_of_spoilt_plants_grow_with_what_the_record_leaves_open(heater: OwnCase) -> None:
    path = heater.models / "identified.npz"
    np.savez(path, **model(0.9) | {"gain_sd": np.array([0.2]), "pace_sd": np.array([0.3]), "dead_sd": np.array([1.2])})
    case = own_case("heater")
    assert isinstance(case, OwnCase)
    assert case.plant.parameters({"dead_time": 2.4}).tolist() == [1.0, 1.0, 2.4, 0.0]
    slow, fast, late = (dict(t.changes) for t in case.scenarios()["spoilt"])
    three, two = 3**-0.5, 2**-0.5  # errors together are as likely as one alone
    assert [float(values[0]) for values in slow.values()] == pytest.approx([1.4**three, 1.6**three, three])
    assert [float(values[0]) for values in fast.values()] == pytest.approx([1.4**-two, 1.6**-two, 0.0])
    assert [float(values[0]) for values in late.values()] == pytest.approx([1.0, 1.0, 2.4])
    assert "0.58 periods later" in case.scenarios()["spoilt"][0].title
    assert "2.4 periods later" in case.scenarios()["spoilt"][0].title
    assert len(case.plant.variations()) == 1 + 3


@pytest.mark.parametrize(("sd", "error"), [(0.0, 0.25), (0.2, 0.4), (9.0, 1.0)])
def test_an_error_is_neither_below_a_quarter_nor_beyond_a_factor_of_two(sd: float, error: float) -> None:
    certain = {"pace_sd": np.zeros(1), "dead_sd": np.zeros(1)}
    assert Doubts.of({"gain_sd": np.array([sd]), **certain}).gain == (pytest.approx(error),)


def test_noise_is_that_of_the_model(heater: OwnCase) -> None:
    assert heater.noise_std == pytest.approx([0.2])


def test_coloured_noise_is_larger_than_its_changes_tell(heater: OwnCase) -> None:
    np.savez(heater.models / "identified.npz", **model(0.9) | {"colour": np.array([0.75])})
    case = own_case("heater")
    assert case.noise_std == pytest.approx([0.4])
    noise = noise_draws(case.plant, 4000, case.noise_std, np.random.default_rng(1))
    assert noise.std() == pytest.approx(0.4, rel=0.1)
    assert np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1] == pytest.approx(0.75, abs=0.05)


def test_before_training_the_signals_are_known_and_the_rest_is_asked_for(heater: OwnCase) -> None:
    for path in Path("work").rglob("*.npz"):
        path.unlink()
    case = own_case("heater")
    assert not case.ready
    assert [s.name for s in case.plant.mv_signals] == ["TIC-101.OP"]
    with pytest.raises(PlantError, match="`loopwright run heater` trains"):
        _ = case.plant.start
    with pytest.raises(PlantError, match="add parts plant1"):
        case.scenarios()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mv": []}, "pv and mv need one signal or more each"),
        ({"mv": [{**VALVE, "high": 0.0}]}, "low must be below high"),
        ({"mv": [{"name": "u", "unit": "%"}]}, "missing"),
        ({"mv": [TEMPERATURE]}, "is there twice"),
        ({"controlled": 2}, "allow 1 to 1"),
        ({"controlled": 0}, "allow 1 to 1"),
        ({"perod_s": 1.0}, "unknown key 'perod_s'"),
    ],
)
def test_a_wrong_section_is_one_line(heater: OwnCase, tmp_path: Path, change: dict[str, Any], said: str) -> None:
    wrote(tmp_path, {**SECTION, **change})
    with pytest.raises(ParamsError, match=r"plants\.heater") as error:
        own_case("heater")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_an_mv_that_acts_after_many_periods_is_seen_to_act(heater: OwnCase) -> None:
    plant = heater.plant
    assert isinstance(plant, OwnPlant)
    late = remembering(Dynamics(**{name: model(0.9)[name] for name in ("a", "b", "c", "w1", "b1", "w2")}), [70])
    equation = {name: getattr(late, name) for name in ("a", "b", "c", "w1", "b1", "w2")}
    of = OwnPlant(
        plant.signals, replace(plant.arrays, **equation, rest=np.array([[1.0, 0.0, 0.0], *[[0.0, 1.0, 0.0]] * 70]))
    )
    of.noise, of.dv_noise, of.colour = plant.noise, plant.dv_noise, plant.colour
    assert of.foreseen == MOST_PERIODS + 70
    process = StepResponses.near_start(of).process(0, 0)
    assert process.dead_time_s == pytest.approx(700.0, rel=0.02)
    assert process.rate * process.tau_s == pytest.approx(0.6, rel=0.02)


def test_laws_stay_on_the_side_of_a_turn_that_one_of_the_models_has(heater: OwnCase) -> None:
    """Of 2 tanh(1.5 v) - 1.5 v, which turns where cosh(1.5 v)^2 = 2, v = (u - 50) / 50: at 20.6 and 79.4 %."""
    turning = {**model(0.9), "b": np.array([[-0.15]]), "w1": np.array([[0.0, 1.5]])}
    turning |= {"b1": np.zeros(1), "w2": np.array([[0.2]])}
    assert [(s.low, s.high) for s in heater.commanded.mv] == [(0.0, 100.0)]
    np.savez(heater.models / "plant2.npz", **turning)
    case = all_cases()["heater"]
    assert isinstance(case, OwnCase)
    (mv,) = case.commanded.mv
    assert (mv.low, mv.high) == (pytest.approx(20.6, abs=1.0), pytest.approx(79.4, abs=1.0))
    assert all(plant.mv_signals == (mv,) for plant in (case.plant, *case.members))


def test_loops_are_tuned_for_what_the_record_visited_and_not_for_a_transmitters_range(heater: OwnCase) -> None:
    plant = heater.plant
    assert isinstance(plant, OwnPlant)
    low, high = plant.asked
    assert (low[0], high[0]) == pytest.approx((20.0, 90.0))  # two standard deviations of 20 reach beyond 90
    narrow = replace(plant.arrays, y_scale=plant.arrays.y_scale / 10)
    of = OwnPlant(plant.signals, narrow)
    assert of.asked == (pytest.approx([46.0]), pytest.approx([54.0]))
    assert PerturbedPlant(of, {}).asked == of.asked
    assert PerturbedPlant(of, {}).foreseen == of.foreseen == MOST_PERIODS
