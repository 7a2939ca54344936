"""The perfect-model NMPC and the offline optimum: what they must obey, and figures that cannot go stale unseen."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pipeline import oracle
from pipeline.bounds import bounds_path, load_bounds, plant_digest
from pipeline.cases import CASES, Case, Scenario
from pipeline.cases.thiosulfate_cstr import ThiosulfateCstrCase
from pipeline.errors import LawError
from pipeline.horizon import Horizon
from pipeline.metrics import closed_loop_metrics, mae
from pipeline.oracle import PerfectNmpc, run_nmpc, run_offline, search
from pipeline.plants.thiosulfate_cstr import ThiosulfateCstr
from pipeline.simulate import simulate_closed


@pytest.fixture(scope="module")
def case() -> Case:
    return CASES["thiosulfate_cstr"]


@pytest.fixture(scope="module")
def nmpc(case: Case) -> PerfectNmpc:
    return PerfectNmpc(case.plant, horizon=20)


@pytest.fixture(scope="module")
def ascent(case: Case) -> Scenario:
    """Two steps from the middle: up, and back to the unstable point."""
    middle = case.scenarios()["tin"][0]
    sp = np.repeat([0.75, float(middle.x0[0])], 25)[:, None]
    return Scenario("ascent", "", sp, middle.x0, middle.mv0, {}, 25)


def naive(case: Case, scenario: Scenario) -> float:
    """MAE with the steady MV of each set point, which is all that feedforward can know."""
    moves = {level: case.plant.steady_state_at(level)[1] for level in set(scenario.sp[:, 0].tolist())}
    loop = simulate_closed(case.plant, lambda sp, pv, applied: (moves[float(sp[0])], ()), scenario)
    return mae(scenario.sp[:, 0], loop.pv[:, 0])


def test_the_plan_obeys_the_plant_and_the_actuator(case: Case) -> None:
    plant = case.plant
    horizon = Horizon(plant, 25)
    x0 = plant.steady_states(250.0)[1]
    sp, p = np.full((25, 1), 0.75), np.tile(plant.parameters(), (25, 1))
    plan = search(horizon, x0, sp, p, plant.stepper())
    assert plan.solved
    assert np.all((plan.mv >= 0) & (plan.mv <= 500))
    step = plant.stepper()
    for k in range(25):
        reached = step(plan.x[k], plan.mv[k], plant.dv_nominal, p[k])
        assert reached == pytest.approx(plan.x[k + 1], rel=1e-5)
    assert plan.cost == pytest.approx(np.sum(np.abs(0.75 - plan.x[1:, 0])))


def test_the_nmpc_beats_feedforward_and_nearly_reaches_the_offline_optimum(
    case: Case, nmpc: PerfectNmpc, ascent: Scenario
) -> None:
    closed, best = run_nmpc(nmpc, ascent), run_offline(case.plant, ascent, elements=3)
    assert closed["failures"] == best["failures"] == 0
    assert closed["max_asse"] < 1e-5
    assert best["mae"] <= 1.001 * closed["mae"]
    assert closed["mae"] < 1.02 * best["mae"]
    assert closed["mae"] < 0.3 * naive(case, ascent)


def test_the_nmpc_counters_a_disturbance_that_it_is_told_of(case: Case, nmpc: PerfectNmpc) -> None:
    scenario = case.scenarios()["ua_gradual"][0]
    short = replace(scenario, sp=scenario.sp[:30], changes={"UA": scenario.changes["UA"][:30]})
    assert run_nmpc(nmpc, short)["mae"] < 1e-6


def test_noise_reaches_the_nmpc_and_repeats(case: Case, nmpc: PerfectNmpc, ascent: Scenario) -> None:
    short = replace(ascent, sp=ascent.sp[25:35], hold=0)
    one, again, other = (run_nmpc(nmpc, short, case.noise_std.tolist(), seed) for seed in (1, 1, 2))
    assert one["mae"] == again["mae"] != other["mae"]
    assert one["mae"] > run_nmpc(nmpc, short)["mae"]


def test_a_failed_solve_goes_on_with_the_older_plan(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    nmpc = PerfectNmpc(case.plant, horizon=12)
    x, sp = case.plant.steady_states(250.0)[1], np.array([0.7])
    nmpc.step(x, sp)
    expected = nmpc._plan.mv[1]
    solve = Horizon.solve
    monkeypatch.setattr(Horizon, "solve", lambda *given: replace(solve(*given), solved=False))
    assert nmpc.step(case.plant.stepper()(x, nmpc._plan.mv[0], np.zeros(0), case.plant.parameters()), sp) == expected
    assert nmpc.failures == 1


def test_an_ignition_is_found_at_its_best_sample(case: Case) -> None:
    # From the cold state to the hot one: the slow local optimum costs 6 % more.
    plant = case.plant
    horizon = Horizon(plant, 30)
    p = np.tile(plant.parameters(), (30, 1))
    plan = search(horizon, plant.steady_states(250.0)[2], np.full((30, 1), 0.0755), p, plant.stepper())
    assert plan.solved
    assert plan.cost < 6.6


# ---------------------------------------------------------------------- the stored figures
@dataclass(frozen=True)
class TinyCase(ThiosulfateCstrCase):
    """A case whose every scenario takes a moment."""

    held_out_seeds: tuple[int, ...] = (1, 2)

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        middle = super().scenarios()["tin"][0]
        tests = [
            replace(middle, name="held_out", sp=middle.sp[:6] + 0.01 * seed, changes={}, hold=3, seed=seed)
            for seed in self.held_out_seeds
        ]
        return {"held_out": tuple(tests)}


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bounds") / "tiny.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(oracle, "HORIZON", 8)
        patch.setattr(oracle, "TAIL", 2)
        patch.setattr(oracle, "REACHES", (2,))
        lines = list(oracle.compute(TinyCase(), ["held_out"], path=path))
    assert len(lines) == 6
    return path


def test_bounds_are_means_over_the_sequences_with_all_metrics(stored: Path) -> None:
    bounds = load_bounds(TinyCase(), stored)
    assert set(bounds) == {"held_out", "held_out_noise"}
    assert set(bounds["held_out"]) == {"nmpc", "offline"}
    assert set(bounds["held_out_noise"]) == {"nmpc"}
    assert set(closed_loop_metrics([0.0], [0.0], [0.0], 0, 1.0)) < set(bounds["held_out"]["offline"])
    alone = [load_bounds(TinyCase((seed,)), stored)["held_out"]["nmpc"]["mae"] for seed in (1, 2)]
    assert bounds["held_out"]["nmpc"]["mae"] == pytest.approx(np.mean(alone))
    assert alone[0] != alone[1]


def test_figures_of_other_sequences_are_missed(stored: Path) -> None:
    with pytest.raises(LawError, match=r"no nmpc figures of scenario 'held_out' \(seeds \[3\]\).*python -m pipeline"):
        load_bounds(TinyCase((1, 3)), stored)


def test_figures_of_another_plant_are_refused(stored: Path, tmp_path: Path) -> None:
    tree = json.loads(stored.read_text())
    other = tmp_path / "other.json"
    other.write_text(json.dumps(tree | {"plant": "0" * 64}))
    with pytest.raises(LawError, match=r"other equations or parameters of the plant; run `python -m pipeline.oracle"):
        load_bounds(TinyCase(), other)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": 0}'])
def test_a_file_that_holds_no_bounds_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "none.json"
    path.write_text(text)
    with pytest.raises(LawError, match=r"holds no bounds of case 'thiosulfate_cstr'; run `python -m"):
        load_bounds(TinyCase(), path)


def test_the_digest_follows_parameters_and_equations_not_comments() -> None:
    plant = ThiosulfateCstr()

    class Commented(ThiosulfateCstr):
        def derivative(self, x, mv, dv):  # type: ignore[no-untyped-def]
            # a comment and no docstring
            return ThiosulfateCstr.derivative(self, x, mv, dv)

    assert plant_digest(plant) == plant_digest(ThiosulfateCstr())
    assert plant_digest(plant) != plant_digest(plant.with_parameters({"UA": 19_999.0}))
    assert plant_digest(plant) != plant_digest(Commented())


def _bounded() -> list[str]:
    return [name for name, case in CASES.items() if bounds_path(case).exists()]


@pytest.mark.parametrize("name", _bounded())
def test_the_stored_figures_belong_to_the_case_as_it_is(name: str) -> None:
    case = CASES[name]
    bounds = load_bounds(case)
    assert {n.removesuffix("_noise") for n in bounds} == set(case.scenarios())
    for figures in bounds.values():
        assert figures["nmpc"]["failures"] <= 10


def test_the_thiosulfate_bounds_are_those_of_an_independent_implementation(case: Case) -> None:
    bounds = load_bounds(case)
    assert bounds["sp_a"]["nmpc"]["mae"] == pytest.approx(0.064, rel=0.01)
    assert bounds["sp_a"]["offline"]["mae"] == pytest.approx(0.0635, rel=0.01)
    assert bounds["sp_b"]["nmpc"]["mae"] == pytest.approx(0.0073, rel=0.01)
    assert bounds["sp_b"]["offline"]["mae"] == pytest.approx(0.0072, rel=0.02)


def test_an_unknown_scenario_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        oracle.main(["thiosulfate_cstr", "--scenario", "sp_c"])
    assert "has no scenario 'sp_c'; it has sp_a, sp_b" in capsys.readouterr().err
