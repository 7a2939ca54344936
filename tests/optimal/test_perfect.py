"""The perfect-model NMPC and the offline optimum: what they must obey, and what they must find."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares

from loopwright.pipeline.__main__ import main
from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.batch_reactor.plant import BatchReactor
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.case import Case, Effort
from loopwright.pipeline.evaluation.metric import METRICS
from loopwright.pipeline.metrics import mae
from loopwright.pipeline.optimal.nmpc_horizon import Horizon
from loopwright.pipeline.optimal.perfect import PerfectNmpc, run_nmpc, run_offline, search
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import simulate_closed


@pytest.fixture(scope="module")
def case() -> Case:
    return CASES["thiosulfate_cstr"]


@pytest.fixture(scope="module")
def nmpc(case: Case) -> PerfectNmpc:
    return PerfectNmpc(case.plant, effort=Effort(periods=20))


@pytest.fixture(scope="module")
def tank() -> EquationPlant:
    return CASES["ph_neutralization"].plant


@pytest.fixture(scope="module")
def batch() -> Case:
    return CASES["batch_reactor"]


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
    closed, best = run_nmpc(nmpc, ascent), run_offline(case.plant, ascent, effort=Effort(fine=3))
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
    nmpc = PerfectNmpc(case.plant, effort=Effort(periods=12))
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


@pytest.mark.parametrize(("start", "end"), [(7.0, 9.0), (9.2, 6.6)])
def test_the_plan_for_squared_errors_is_that_of_single_shooting(tank: EquationPlant, start: float, end: float) -> None:
    # Another way to the same optimum: moves alone, through the integrator, by a bounded least-squares solver.
    n, x0 = 6, tank.steady_state_at(start)[0]
    x, moves, errors = ca.DM(x0), ca.SX.sym("moves", n), []
    for k in range(n):
        x = tank.transition(x, moves[k], tank.dv_nominal, tank.parameters())
        errors.append(end - tank.measurement(x))
    error = ca.Function("error", [moves], [ca.vertcat(*errors)])
    slope = ca.Function("slope", [moves], [ca.jacobian(ca.vertcat(*errors), moves)])
    starts = np.random.default_rng(0).uniform(860, 1040, (8, n))
    found = [
        least_squares(lambda u: np.array(error(u)).ravel(), s, lambda u: np.array(slope(u)), (850, 1050))
        for s in starts
    ]
    horizon = Horizon(tank, 12, metric=METRICS["sse"])
    plan = search(horizon, x0, np.full((12, 1), end), np.tile(tank.parameters(), (12, 1)), tank.stepper())
    span = tank.sp_signals[0].high - tank.sp_signals[0].low
    assert plan.solved
    assert plan.cost * span**2 == pytest.approx(2 * min(f.cost for f in found), rel=1e-4)


def test_an_unforeseen_disturbance_costs_the_nmpc_one_sample(tank: EquationPlant) -> None:
    x0, mv0 = tank.steady_state_at(8.0)
    q1 = np.repeat([tank.parameters()[tank.parameter_names().index("q1")], 1010.0], 6)
    scenario = Scenario("acid", "", np.full((12, 1), 8.0), x0, mv0, {"q1": q1})
    nmpc = PerfectNmpc(tank, METRICS["sse"], Effort(periods=10))
    assert run_nmpc(nmpc, scenario)["sse"] < 1e-9
    missed = tank.measure(tank.stepper()(x0, mv0, tank.dv_nominal, tank.parameters({"q1": 1010.0})))
    assert run_nmpc(nmpc, scenario, unforeseen=True)["sse"] == pytest.approx((8 - float(missed[0])) ** 2, rel=1e-4)


@pytest.mark.parametrize(("period_s", "lowest"), [(20.0, 13_252.0), (10.0, 19_417.0)])
def test_a_recipe_is_followed_as_closely_as_can_be(batch: Case, period_s: float, lowest: float) -> None:
    # Full heating until the profile comes within reach, and on it from then on; the reference figures are
    # for 1000 s, of which 300 are enough, because nothing adds to the lowest sum after them.
    # Without sight of the recipe the same NMPC trails it.
    printed = batch.scenarios()["trajectory"][0]

    class Sampled(BatchReactor):
        pass

    Sampled.period_s, Sampled.substeps = period_s, 10
    plant = Sampled()
    time_s = np.arange(0.0, 300.0, period_s)
    sp = 54.0 + 71.0 * np.exp(-2.5e-3 * time_s)[:, None]
    test = replace(printed, sp=sp, late_from=round(200 / period_s))
    best = run_offline(plant, test, METRICS["sse"], True, Effort(fine=2))
    nmpc = PerfectNmpc(plant, METRICS["sse"], Effort(periods=12))
    aware, blind = run_nmpc(nmpc, test, recipe=True), run_nmpc(nmpc, test)
    assert best["sse"] == pytest.approx(lowest, abs=1.0)
    assert aware["sse"] == pytest.approx(best["sse"], rel=1e-4)
    assert aware["sse_late"] < 1e-3 < 1 < blind["sse_late"]


def test_each_set_point_is_planned_by_itself_unless_it_is_a_recipe(tank: EquationPlant) -> None:
    # Equal neighbours are one set point, of whatever length: its plan ends at rest. A recipe's plan starts early.
    x0, mv0 = tank.steady_state_at(7.0)
    test = Scenario("steps", "", np.repeat([7.0, 7.0, 9.0], 5)[:, None], x0, mv0, {}, 5)
    steps, course = (run_offline(tank, test, METRICS["sse"], recipe, Effort(fine=3)) for recipe in (False, True))
    assert steps["sse"] == pytest.approx(4 + 1.0393, rel=1e-3)
    assert course["sse"] < steps["sse"]


def test_a_metric_without_a_floor_is_refused(tank: EquationPlant) -> None:
    with pytest.raises(
        PlantError, match="no horizon for the metric 'masse', which has no floor; it may be mae, sse, tracking"
    ):
        Horizon(tank, 5, metric=METRICS["masse"])


def test_noise_on_what_is_no_state_is_refused(tank: EquationPlant) -> None:
    x0, mv0 = tank.steady_state_at(7.0)
    scenario = Scenario("rest", "", np.full((3, 1), 7.0), x0, mv0)
    with pytest.raises(PlantError, match="measures other things than its states; its NMPC cannot be given noise"):
        run_nmpc(PerfectNmpc(tank, METRICS["sse"], Effort(periods=5)), scenario, [0.02])


def test_an_unknown_scenario_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bounds", "thiosulfate_cstr", "--scenario", "sp_c"]) == 2
    assert "unknown scenario 'sp_c'; did you mean 'sp_b'?" in capsys.readouterr().err
