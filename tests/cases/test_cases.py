"""Every case's tests are well formed; the thiosulfate ones are those of the paper."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import yaml

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.ph_neutralization.case import PhNeutralizationCase
from loopwright.pipeline.commands.simulate import _test_of as first_scenario
from loopwright.pipeline.engine.command import run_stage
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.closed_loop import closed_loop_metrics
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX, Scenario
from loopwright.serving.manifest import Manifest

DISTURBANCES = {"tin", "ua", "ua_gradual"}


@pytest.fixture(scope="module", params=sorted(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


@pytest.fixture(scope="module")
def cstr() -> Case:
    return CASES["thiosulfate_cstr"]


def rests(case: Case, scenario: Scenario) -> bool:
    """At rest under the nominal parameters or those of its first period, or at the start of a batch."""
    plant = case.plant
    if scenario.x0 == pytest.approx(plant.start[0]):
        return True
    ends = [
        plant.stepper()(scenario.x0, scenario.mv0, plant.dv_nominal, p)
        for p in (plant.parameters(), scenario.parameters(plant)[0])
    ]
    return any(x == pytest.approx(scenario.x0, rel=1e-7) for x in ends)


def test_every_scenario_starts_at_rest_and_stays_within_the_signals(case: Case) -> None:
    plant = case.plant
    for scenario in (*(s for group in case.scenarios().values() for s in group), *case.development()):
        assert scenario.sp.shape == (scenario.samples, len(plant.sp_signals))
        assert rests(case, scenario)
        assert 0 <= scenario.late_from < scenario.samples
        for j, signal in enumerate(plant.sp_signals):
            assert np.all((scenario.sp[:, j] >= signal.low) & (scenario.sp[:, j] <= signal.high))
        assert scenario.parameters(plant).shape == (scenario.samples, len(plant.parameters()))
        if scenario.hold:
            assert scenario.samples % scenario.hold == 0


def test_nothing_scored_is_developed_on(case: Case) -> None:
    scored = {s.digest() for group in case.scenarios().values() for s in group}
    assert not scored & {s.digest() for s in case.development()}


def test_the_gate_weighs_scenarios_that_exist(case: Case) -> None:
    assert set(case.gate) <= set(case.scenarios())
    assert sum(case.gate.values()) == pytest.approx(1.0)


def test_the_paper_names_scenarios_and_metrics_that_exist(case: Case) -> None:
    metrics = set(closed_loop_metrics([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], 0, 1.0, late_from=1)) | set(case.metrics)
    scenarios = {name + end for name in case.scenarios() for end in ("", NOISE_SUFFIX)}
    for row in (*(r for t in case.tables for r in t.rows if r.scenario), *case.requirements):
        assert row.scenario in scenarios
        assert row.metric in metrics
    assert case.metric in metrics
    assert not scenarios & set(case.unscored())
    assert {f.scenario for f in case.figures} <= {None, *scenarios, *case.unscored()}


def test_the_shorter_period_has_the_same_tests() -> None:
    slow, fast = CASES["ph_neutralization"].scenarios(), CASES["ph_neutralization_15s"].scenarios()
    assert list(slow) == list(fast)
    for name, tests in slow.items():
        for one, other in zip(tests, fast[name], strict=True):
            assert other.sp[::4] == pytest.approx(one.sp)
            assert other.hold == 4 * one.hold
            for key, values in one.changes.items():
                assert other.changes[key][::4] == pytest.approx(values)


def test_profiles_are_within_reach_once_the_late_errors_count() -> None:
    case = CASES["batch_reactor"]
    reach = case.plant.steady_curve[0]
    for test in (*(s for group in case.scenarios().values() for s in group), *case.development()):
        assert reach[0] < test.sp[test.late_from :].min()
        assert test.sp[test.late_from :].max() < reach[-1]
        assert test.sp[0] > test.x0[2]


def test_noise_has_one_entry_a_process_variable(case: Case) -> None:
    assert case.noise_std.shape == (len(case.plant.pv_signals),)
    assert np.all(case.noise_std > 0)


def test_a_seed_of_the_development_is_refused(case: Case) -> None:
    with pytest.raises(ParamsError, match="held_out_seeds"):
        case.with_held_out((case.development_seeds[0], 9001))
    with pytest.raises(ParamsError, match="one or more different seeds"):
        case.with_held_out(())


def test_scenarios_are_the_published_ones(cstr: Case) -> None:
    tests = cstr.scenarios()
    assert list(tests) == ["sp_a", "sp_b", "tin", "ua", "ua_gradual", "held_out"]
    a, b = tests["sp_a"][0], tests["sp_b"][0]
    assert a.sp[::80, 0].tolist() == [0.6661, 0.0755, 0.6661, 0.9872, 0.0755, 0.9872, 0.6661]
    assert b.sp[::80, 0].tolist() == [0.0755, 0.2, 0.35, 0.5, 0.6661, 0.8, 0.9, 0.96, 0.7, 0.45, 0.15, 0.0755]
    assert a.x0 == pytest.approx([0.98717, 271.66], abs=5e-3)
    assert b.x0 == pytest.approx([0.07545, 376.27], abs=5e-3)
    assert tests["held_out"][0].x0 == pytest.approx(b.x0)


def test_disturbances_act_from_the_first_period_on_at_the_unstable_point(cstr: Case) -> None:
    tests = {name: cstr.scenarios()[name][0] for name in DISTURBANCES}
    for scenario in tests.values():
        assert scenario.samples == 350
        assert scenario.x0 == pytest.approx([0.66613, 308.499], abs=1e-3)
        assert np.all(scenario.sp == scenario.x0[0])
    assert np.all(tests["tin"].changes["T_in"] == 305)
    assert np.all(tests["ua"].changes["UA"] == 10_000)
    falling = tests["ua_gradual"].changes["UA"]
    assert falling[[0, 1, 250, 349]].tolist() == [20_000, 19_960, 10_000, 10_000]


def test_held_out_sequences_are_random_but_repeat(cstr: Case) -> None:
    first, again = cstr.scenarios()["held_out"], cstr.scenarios()["held_out"]
    assert len(first) == 5
    assert len({s.digest() for s in first}) == 5
    assert [s.digest() for s in first] == [s.digest() for s in again]
    for scenario in first:
        levels = scenario.sp[::60, 0]
        assert len(levels) == len(set(levels)) == 16
        assert levels.min() >= 0.03
        assert levels.max() <= 0.985
    assert [s.seed for s in cstr.with_held_out((7, 8)).scenarios()["held_out"]] == [7, 8]


def test_every_set_point_has_a_steady_state_within_the_actuators_range(cstr: Case) -> None:
    for level in np.unique(np.concatenate([s.sp[:, 0] for group in cstr.scenarios().values() for s in group])):
        _, mv = cstr.plant.steady_state_at(float(level))
        assert 0 < mv[0] < 500


def test_regions_are_named_as_in_the_literature(cstr: Case) -> None:
    assert list(cstr.regions) == ["hot", "middle", "cold"]
    assert cstr.regions["middle"] == pytest.approx((0.2556, 0.9029), abs=2e-4)


def test_the_longer_test_has_the_same_set_points(cstr: Case) -> None:
    scenario, longer = cstr.scenarios()["sp_a"][0], cstr.unscored()["sp_a_hold160"]
    assert longer.samples == 2 * scenario.samples
    assert longer.sp[::160].tolist() == scenario.sp[::80].tolist()


def test_a_digest_follows_what_is_demanded_and_ignores_the_last_bits(cstr: Case) -> None:
    scenario = cstr.scenarios()["ua"][0]
    assert replace(scenario, x0=scenario.x0 * (1 + 1e-13), title="other").digest() == scenario.digest()
    assert replace(scenario, sp=scenario.sp + 1e-4).digest() != scenario.digest()
    assert replace(scenario, changes={}).digest() != scenario.digest()


def test_wrong_shapes_and_names_are_refused(cstr: Case) -> None:
    x0, mv0 = np.zeros(2), np.zeros(1)
    with pytest.raises(PlantError, match="give \\(n, n_sp\\)"):
        Scenario("flat", "", np.zeros(5), x0, mv0)
    with pytest.raises(PlantError, match="one value a period"):
        Scenario("short", "", np.zeros((5, 1)), x0, mv0, {"UA": np.ones(4)})
    with pytest.raises(PlantError, match="no parameter 'UB'"):
        Scenario("odd", "", np.zeros((5, 1)), x0, mv0, {"UB": np.ones(5)}).parameters(cstr.plant)


def test_curves_are_labelled_as_in_the_paper(cstr: Case) -> None:
    assert cstr.tables[0].rows[0].label == "INCAD (r=2.5)"


def test_cases_do_not_load_torch() -> None:
    code = "import sys, json, loopwright.pipeline.cases; print(json.dumps('torch' in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) is False


@pytest.mark.parametrize("name", sorted(CASES))
def test_a_champion_has_something_to_beat(name: str) -> None:
    """The case's baseline is one of its controllers: without it, no version of the case could become champion."""
    tree = yaml.safe_load((Path(__file__).parents[2] / "params.yaml").read_text())
    laws = {c["law"] for c in tree["controllers"].values() if c["case"] == name}
    assert CASES[name].baseline in laws
    assert len(laws) > 1


# ---------------------------------------------------------------------- what a case may lack
@dataclass(frozen=True)
class NoTests(PhNeutralizationCase):
    """A case that nothing is asked of."""

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        return {}


class Unwritten(EquationPlant):
    """A plant without equations."""


def test_a_case_without_tests_is_one_error() -> None:
    with pytest.raises(ParamsError, match=r"has no tests: its scenarios\(\) is empty; return at least one"):
        NoTests().tests()
    with pytest.raises(ParamsError, match="has no tests"):
        first_scenario(NoTests(), None, cast(Manifest, SimpleNamespace(operate=())))


def test_a_test_without_sequences_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    own = PhNeutralizationCase().scenarios()
    monkeypatch.setattr(NoTests, "scenarios", lambda self: own | {"buffer": ()})
    with pytest.raises(ParamsError, match="its test 'buffer' has no sequence"):
        NoTests().tests()


def test_an_abstract_plant_class_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NoTests, "plant_class", Unwritten)
    with pytest.raises(PlantError, match="plant class Unwritten is abstract, as it lacks derivative; implement that"):
        _ = NoTests().plant


def test_a_singular_system_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def fit(name: str) -> None:
        np.linalg.solve(np.zeros((2, 2)), np.ones(2))

    assert run_stage(fit, ["fit", "x"], "MODEL") == 2
    said = capsys.readouterr().err
    assert said.startswith("fit x: a system of linear equations has no single solution (Singular matrix); check the")
    assert said.count("\n") == 1
