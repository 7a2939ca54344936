"""Bounds where a plain set point is not all: a discrete MV, a reference, another plant, plans that are followed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from whole_bounds import whole_bounds

from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.cases.henson_seborg_cstr.plant import HensonSeborgCstr
from loopwright.pipeline.cases.jacketed_batch_reactor.plant import COLD, HOT, LEAK, JacketedBatchReactor, SignedFlow
from loopwright.pipeline.cases.reversible_cstr.plant import ReversibleCstr
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.case import Array, Case, Effort
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.metric import METRICS, Metric
from loopwright.pipeline.optimal.nmpc_horizon import Horizon
from loopwright.pipeline.optimal.perfect import PerfectNmpc, run_nmpc, run_offline
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.plant_digest import equations_digest
from loopwright.pipeline.simulation.scenario import Scenario, held
from loopwright.pipeline.simulation.simulate import simulate_closed, simulate_open
from loopwright.pipeline.stages import bounds as bounds_stage
from loopwright.pipeline.tuning.reference_model import ReferenceModel

QUICK = Effort(periods=20, elements=1, fine=1, degree=2, reaches=(3,), tail=10, every=5, noisy=False)


@pytest.fixture(scope="module")
def vessel() -> JacketedBatchReactor:
    return JacketedBatchReactor()


# ---------------------------------------------------------------------- a discrete MV
def test_one_signed_flow_does_what_throttle_and_mode_do(vessel: JacketedBatchReactor) -> None:
    flows = np.random.default_rng(0).uniform(-1, 1, (200, 1))
    flows[np.abs(flows) < 0.05] = 0.3
    signed = vessel.relaxed()
    start = np.array([40.0, 35.0])
    one, other = (simulate_open(p, start, mv) for p, mv in ((signed, flows), (vessel, signed.actual(flows))))
    assert signed.actual(flows).shape == (200, 2)
    # What both valves leak at a flow f is LEAK^2 / (4 |f|) of full flow.
    assert np.max(np.abs(one - other)) < 0.005
    with_other = vessel.with_parameters({"T_hot": 70.0})
    assert with_other.relaxed().T_hot == 70.0
    assert signed.relaxed() is signed


def test_a_flow_within_the_leak_keeps_the_mode() -> None:
    flows = np.array([0.0, -0.5, LEAK / 2, -LEAK / 2, 0.2, -LEAK / 2])[:, None]
    assert SignedFlow().actual(flows)[:, 1].tolist() == [HOT, COLD, COLD, COLD, HOT, HOT]
    assert SignedFlow().actual(flows)[:, 0] == pytest.approx(np.abs(flows[:, 0]))


def test_a_signed_flow_rests_where_the_real_vessel_does(vessel: JacketedBatchReactor) -> None:
    for level in (18.5, 26.0, 62.0):
        (x, mv), (x_real, mv_real) = vessel.relaxed().steady_state_at(level), vessel.steady_state_at(level)
        assert np.array_equal(x, x_real)
        assert vessel.relaxed().actual(mv[None])[0] == pytest.approx(mv_real)
    assert np.array_equal(vessel.relaxed().start[0], vessel.start[0])


def test_the_nmpc_over_the_signed_flow_is_ahead_of_any_switching_by_hand(vessel: JacketedBatchReactor) -> None:
    # By hand: full flow to the set point, then the steady throttle. The jacket's heat then carries the core on.
    sp = np.full((60, 1), 24.0)
    test = Scenario("up", "", sp, np.full(2, 20.0), np.array([0.0, HOT]))
    hold = vessel.steady_state_at(24.0)[1]

    def by_hand(r: Array, pv: Array, applied: Array) -> tuple[Array, tuple[float, ...]]:
        return (np.array([1.0, HOT]) if pv[0] < r[0] else hold), ()

    seen: dict[str, Array] = {}

    def score(test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
        seen["mv"] = mv
        return {"mae": float(np.mean(np.abs(test.sp - pv[:, :1])))}

    loop = simulate_closed(vessel, by_hand, test)
    found = run_nmpc(PerfectNmpc(vessel.relaxed(), METRICS["mae"], QUICK), test, score=score)
    best = run_offline(vessel.relaxed(), test, METRICS["mae"], False, QUICK)
    assert found["failures"] == best["failures"] == 0
    assert found["mae"] == pytest.approx(best["mae"], rel=1e-3)
    assert found["mae"] < float(np.mean(np.abs(sp - loop.pv[:, :1])))
    assert seen["mv"].shape == (60, 2)
    assert set(seen["mv"][:, 1]) == {HOT, COLD}  # the jacket is braked by cold water
    # The real vessel under these moves goes the same way.
    real = simulate_open(vessel, test.x0, seen["mv"])[:-1, :1]
    assert float(np.mean(np.abs(sp - real))) == pytest.approx(found["mae"], rel=1e-3)


@pytest.mark.parametrize("every", [1, 5])
def test_limits_of_a_state_are_kept_by_nmpc_and_offline_optimum(vessel: JacketedBatchReactor, every: int) -> None:
    signed, limits = vessel.relaxed(), {"T_w": (20.0, 50.0)}
    sp = np.repeat([23.0, 21.0], [50, 40])[:, None]
    test = Scenario("up and down", "", sp, np.full(2, 20.0), np.array([0.0, HOT]))
    seen: list[Array] = []

    def score(test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
        seen.append(pv)
        return {"mae": float(np.mean(np.abs(test.sp - pv[:, :1])))}

    effort = replace(QUICK, every=every)
    free = run_nmpc(PerfectNmpc(signed, METRICS["mae"], effort), test, score=score)
    kept = run_nmpc(PerfectNmpc(signed, METRICS["mae"], effort, limits), test, score=score)
    best = run_offline(signed, test, METRICS["mae"], False, effort, score, limits)
    assert kept["failures"] == best["failures"] == 0
    assert seen[0][:, 1].max() > 60
    assert seen[0][:, 1].min() < 19
    for pv in seen[1:]:
        assert pv[:, 1].max() <= 50.001
        assert pv[:, 1].min() >= 19.999
    assert free["mae"] < best["mae"] == pytest.approx(kept["mae"], rel=1e-3)


def test_a_state_that_is_out_of_its_limits_comes_back(vessel: JacketedBatchReactor) -> None:
    signed = vessel.relaxed()
    horizon = Horizon(signed, 12, limits={"T_w": (20.0, 50.0)}, elements=1, degree=2)
    x0, sp, p = np.array([40.0, 55.0]), np.full((12, 1), 60.0), np.tile(signed.parameters(), (12, 1))
    plan = horizon.solve(x0, sp, p, horizon.rollout(x0, sp, p, 3, signed.stepper()))
    assert plan.solved
    assert plan.x[1, 1] <= 55.0 + 1e-6
    assert np.all(plan.x[2:, 1] <= 50.0 + 1e-6)
    with pytest.raises(PlantError, match="has no state 'T_j' to limit; it has T, T_w"):
        Horizon(signed, 5, limits={"T_j": (0.0, 1.0)})


def test_a_discrete_mv_without_relaxation_is_refused(vessel: JacketedBatchReactor) -> None:
    with pytest.raises(PlantError, match="no horizon for the discrete MV 'mode' of plant 'jacketed_batch_reactor'"):
        Horizon(vessel, 5)
    with pytest.raises(PlantError, match=r"has the discrete MV 'mode' and no relaxed\(\) without it"):
        EquationPlant.relaxed(vessel)
    plain = HensonSeborgCstr()
    assert plain.relaxed() is plain


def test_the_digest_follows_the_relaxation(vessel: JacketedBatchReactor, monkeypatch: pytest.MonkeyPatch) -> None:
    own = equations_digest(vessel)
    monkeypatch.setattr("loopwright.pipeline.cases.jacketed_batch_reactor.plant.LEAK", 0.1)
    assert equations_digest(vessel) != own


# ---------------------------------------------------------------------- a reference, and a plan that is followed
@pytest.fixture(scope="module")
def followed() -> Scenario:
    plant = ReversibleCstr()
    sp = held([0.46, 0.40], 60)
    x0, mv0 = plant.steady_state_at(0.46)
    course = ReferenceModel.optimal(2, 0.05).response(sp, plant.period_s)
    return Scenario("levels", "", sp, x0, mv0, {}, 60, reference=course)


def tracking(test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
    assert test.reference is not None
    return {"tracking": float(np.sqrt(np.mean((test.reference - pv[:, :1]) ** 2)))}


def test_a_reference_that_can_be_followed_is_followed(followed: Scenario) -> None:
    plant = ReversibleCstr()
    closed = run_nmpc(PerfectNmpc(plant, METRICS["tracking"], QUICK), followed, recipe=True, score=tracking)
    best = run_offline(plant, followed, METRICS["tracking"], True, QUICK, tracking)
    assert closed["tracking"] < 1e-5
    assert best["tracking"] < 1e-6
    # Without sight of the course the set point itself is all that there is to go to.
    assert run_nmpc(PerfectNmpc(plant, METRICS["tracking"], QUICK), followed, score=tracking)["tracking"] > 1e-3


@pytest.mark.parametrize("sp", [(0.02, 0.03), (0.13, 0.10)])
def test_a_plan_that_comes_true_need_not_be_solved_again(sp: tuple[float, float]) -> None:
    plant = HensonSeborgCstr()
    x0, mv0 = plant.steady_state_at(sp[0])
    test = Scenario("step", "", held(list(sp), 40), x0, mv0, {}, 40)
    each, some = (run_nmpc(PerfectNmpc(plant, METRICS["mae"], replace(QUICK, every=every)), test) for every in (1, 5))
    finer = run_offline(plant, test, METRICS["mae"], False, Effort(fine=3, reaches=(3,)))
    assert some["mae"] == pytest.approx(each["mae"], rel=1e-3)
    assert some["mae"] == pytest.approx(finer["mae"], rel=1e-3)


def test_a_plan_is_followed_until_it_is_old_or_something_surprises() -> None:
    plant = ReversibleCstr()
    nmpc, step, p = PerfectNmpc(plant, METRICS["sse"], replace(QUICK, every=4)), plant.stepper(), plant.parameters()
    x = plant.steady_state_at(0.46)[0]

    def go(sp: float, p: Array, shift: float = 0.0) -> int:
        nonlocal x
        x = step(x, nmpc.step(x, np.array([sp]), p), plant.dv_nominal, p)
        x = x + np.array([shift, 0.0])
        return nmpc.age

    ages = [go(0.45, p) for _ in range(6)]
    assert ages == [0, 1, 2, 3, 0, 1]
    warmer = plant.parameters({"T_in": 430.0})
    assert go(0.45, warmer) == 0  # other parameters
    assert go(0.45, warmer, shift=0.01) == 1
    assert go(0.45, warmer) == 0  # another state than predicted
    assert go(0.45, warmer) == 1
    assert go(0.44, warmer) == 0  # another set point
    assert nmpc.failures == 0


# ---------------------------------------------------------------------- a case with tests on other plants
@dataclass(frozen=True)
class Vessels(Case):
    """Five samples on each of three plants: the case's, one with another jacket, a map."""

    held_out_seeds: tuple[int, ...] = (1,)

    name: ClassVar[str] = "vessels"
    title: ClassVar[str] = "Vessels"
    plant_class: ClassVar[type[EquationPlant]] = JacketedBatchReactor
    own_metrics: ClassVar[tuple[Metric, ...]] = (Metric("hot_samples", "hot samples"),)
    development_seeds: ClassVar[tuple[int, ...]] = (11,)
    noise: ClassVar[Mapping[str, float]] = {"T": 0.05, "T_w": 0.1}
    gate: ClassVar[Mapping[str, float]] = {"own": 1.0}
    effort: ClassVar[Effort] = QUICK

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        own = Scenario("own", "", np.full((5, 1), 22.0), np.full(2, 20.0), np.array([0.0, HOT]))
        cool = JacketedBatchReactor().with_parameters({"T_hot": 40.0})
        return {
            "own": (own,),
            "cool": (replace(own, name="cool", plant=cool),),
            "map": (replace(own, name="map", plant=PLANTS["fuzzy_batch_reactor"]()),),
        }

    def development(self) -> tuple[Scenario, ...]:
        return ()

    def score(self, test: Scenario, pv: Array, mv: Array) -> dict[str, float]:
        return super().score(test, pv, mv) | {"hot_samples": float(np.sum(mv[:, 1] == HOT))}


def test_tests_on_other_plants_have_their_own_bounds_and_those_on_a_map_none(tmp_path: Path) -> None:
    case, path = Vessels(), tmp_path / "vessels.json"
    lines = list(bounds_stage.compute(case, ["own", "cool", "map"], path=path))
    assert len(lines) == 4  # NMPC and offline, of two tests; nothing is measured with noise
    bounds = whole_bounds(case, path)
    assert set(bounds) == {"own", "own_noise", "cool", "cool_noise"}
    assert bounds["own"]["nmpc"]["hot_samples"] == 5
    assert bounds["own"]["nmpc"]["mae"] < bounds["cool"]["nmpc"]["mae"]
    assert bounds["own_noise"]["nmpc"] == bounds["own"]["nmpc"]


def test_a_fixed_test_that_changed_leaves_no_figures_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case, path = Vessels(), tmp_path / "vessels.json"
    list(bounds_stage.compute(case, ["own", "cool"], path=path))
    tests = case.scenarios()
    longer = replace(tests["own"][0], sp=np.full((6, 1), 22.0))
    monkeypatch.setattr(Vessels, "scenarios", lambda self: {"own": (longer,)})
    list(bounds_stage.compute(case, ["own"], path=path))
    figures = json.loads(path.read_text())["figures"]
    assert {name: list(rows) for name, rows in figures.items()} == {"own": [longer.digest()]}


# ---------------------------------------------------------------------- yardsticks
def test_the_yardstick_of_tracking_is_what_noisy_samples_tell_apart(followed: Scenario) -> None:
    class Tracked(Vessels):
        name: ClassVar[str] = "tracked"
        metric: ClassVar[str] = "tracking"
        plant_class: ClassVar[type[EquationPlant]] = ReversibleCstr
        noise: ClassVar[Mapping[str, float]] = {"C_B": 0.002, "T": 0.1}

        def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
            return {"own": (followed,)}

    floor = Evidence(Tracked(), {}, {}, {}).floor("own_noise")
    rng, n = np.random.default_rng(0), followed.samples
    squares: Any = np.mean(rng.normal(0, 0.002, (4000, n)) ** 2, axis=1)
    assert floor == pytest.approx(np.sqrt(np.std(squares)), rel=0.03)
