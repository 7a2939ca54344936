"""The stored bounds: means over sequences and draws, and figures that cannot go stale unseen."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import pytest
from whole_bounds import whole_bounds

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.ph_neutralization.case import PhNeutralizationCase
from loopwright.pipeline.cases.ph_neutralization.plant import PhNeutralization
from loopwright.pipeline.cases.thiosulfate_cstr.case import ThiosulfateCstrCase
from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.evaluation.case import Effort
from loopwright.pipeline.evaluation.closed_loop import closed_loop_metrics
from loopwright.pipeline.evaluation.metric import METRICS
from loopwright.pipeline.optimal.bounds import (
    DEFAULTS,
    bounded,
    bounds_path,
    problem,
    stored_bounds,
    together,
)
from loopwright.pipeline.optimal.nmpc_horizon import Horizon, NmpcPlan
from loopwright.pipeline.optimal.perfect import run_offline
from loopwright.pipeline.plants.plant_digest import equations_digest
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.stages import bounds as bounds_stage


@dataclass(frozen=True)
class TinyCase(ThiosulfateCstrCase):
    """A case whose every scenario takes a moment."""

    held_out_seeds: tuple[int, ...] = (1, 2)
    effort: ClassVar[Effort] = Effort(periods=8, tail=2, reaches=(2,))

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
    lines = list(bounds_stage.compute(TinyCase(), ["held_out"], path=path))
    assert len(lines) == 6
    return path


def test_bounds_are_means_over_the_sequences_with_all_metrics(stored: Path) -> None:
    bounds = whole_bounds(TinyCase(), stored)
    assert set(bounds) == {"held_out", "held_out_noise"}
    assert set(bounds["held_out"]) == {"nmpc", "offline"}
    assert set(bounds["held_out_noise"]) == {"nmpc"}
    assert set(closed_loop_metrics([0.0], [0.0], [0.0], 0, 1.0)) < set(bounds["held_out"]["offline"])
    alone = [whole_bounds(TinyCase((seed,)), stored)["held_out"]["nmpc"]["mae"] for seed in (1, 2)]
    assert bounds["held_out"]["nmpc"]["mae"] == pytest.approx(np.mean(alone))
    assert alone[0] != alone[1]


def test_figures_of_other_sequences_are_missed(stored: Path) -> None:
    _, missing = stored_bounds(TinyCase((1, 3)), stored)
    assert re.search(r"no nmpc figures of scenario 'held_out' \(seeds \[3\]\).*loopwright bounds", missing[0])


def test_what_a_file_lacks_is_said_and_the_rest_is_given(stored: Path, tmp_path: Path) -> None:
    tree = json.loads(stored.read_text())
    for row in tree["figures"]["held_out"].values():
        del row["offline"]
    partial = tmp_path / "partial.json"
    partial.write_text(json.dumps(tree))
    bounds, missing = stored_bounds(TinyCase(), partial)
    whole = whole_bounds(TinyCase(), stored)
    assert bounds["held_out"] == {"nmpc": whole["held_out"]["nmpc"]}
    assert bounds["held_out_noise"] == whole["held_out_noise"]
    (line,) = missing
    assert "has no offline figures of scenario 'held_out'" in line
    assert stored_bounds(TinyCase(), stored) == (whole, [])


@dataclass(frozen=True)
class LongTail(TinyCase):
    """The offline optimum's plans are longer than the NMPC's, so that a test can tell them apart."""

    held_out_seeds: tuple[int, ...] = (1,)
    effort: ClassVar[Effort] = Effort(periods=8, tail=6, reaches=(3,))


def test_an_optimum_is_no_worse_than_the_nmpc_and_says_that_it_did_not_converge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On another plant every long plan failed, and the best rollout was stored as the optimum."""
    case, solve, path = LongTail(), Horizon.solve, tmp_path / "long.json"

    def gives_up(self: Horizon, *given: Any) -> NmpcPlan:
        plan = solve(self, *given)
        return plan if self.n == case.effort.periods else replace(plan, solved=False)

    monkeypatch.setattr(Horizon, "solve", gives_up)
    lines = list(bounds_stage.compute(case, ["held_out"], path=path))
    bounds = whole_bounds(case, path)["held_out"]
    alone = run_offline(case.plant, case.scenarios()["held_out"][0], METRICS["mae"], False, case.effort)
    assert alone["mae"] > 1.1 * bounds["nmpc"]["mae"]
    assert bounds["offline"]["mae"] <= bounds["nmpc"]["mae"]
    assert bounds["offline"]["failures"] == 1
    (line,) = [line for line in lines if " offline:" in line]
    assert "1 plans were not solved" in line


def test_the_nmpc_stands_for_an_optimum_that_is_worse() -> None:
    nmpc, worse = {"sse": 1.0, "failures": 0.0, "step_ms_p50": 3.0}, {"sse": 6.0, "failures": 2.0}
    assert bounds_stage.better(worse, nmpc, "sse") == {"sse": 1.0, "failures": 2.0, "from_nmpc": 1.0}
    assert bounds_stage.better(worse | {"sse": float("nan")}, nmpc, "sse")["sse"] == 1.0
    best = {"sse": 0.5, "failures": 0.0}
    assert bounds_stage.better(best, nmpc, "sse") == best
    assert together([bounds_stage.better(worse, nmpc, "sse"), best]) == {"sse": 0.75, "failures": 2.0, "from_nmpc": 1.0}


def test_figures_of_another_plant_are_refused(stored: Path, tmp_path: Path) -> None:
    tree = json.loads(stored.read_text())
    other = tmp_path / "other.json"
    other.write_text(json.dumps(tree | {"plant": "0" * 64}))
    with pytest.raises(LawError, match=r"other equations or parameters of the plant; run `loopwright bounds"):
        whole_bounds(TinyCase(), other)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": 0}'])
def test_a_file_that_holds_no_bounds_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "none.json"
    path.write_text(text)
    with pytest.raises(LawError, match=r"holds no bounds of case 'thiosulfate_cstr'; run `loopwright bounds"):
        whole_bounds(TinyCase(), path)


def test_the_digest_follows_parameters_and_equations_not_comments() -> None:
    plant = ThiosulfateCstr()

    class Commented(ThiosulfateCstr):
        def derivative(self, x, mv, dv):  # type: ignore[no-untyped-def]
            # a comment and no docstring
            return ThiosulfateCstr.derivative(self, x, mv, dv)

    assert equations_digest(plant) == equations_digest(ThiosulfateCstr())
    assert equations_digest(plant) != equations_digest(plant.with_parameters({"UA": 19_999.0}))
    assert equations_digest(plant) != equations_digest(Commented())


def _bounded() -> list[str]:
    return [name for name, case in CASES.items() if bounds_path(case).exists()]


@pytest.mark.parametrize("name", _bounded())
def test_the_stored_figures_belong_to_the_case_as_it_is(name: str) -> None:
    case = CASES[name]
    bounds = whole_bounds(case)
    tests = case.scenarios()
    assert {n.removesuffix("_noise") for n in bounds} == {n for n in tests if bounded(case, tests[n])}
    assert {n.removesuffix("_noise") for n in case.gate} <= {n.removesuffix("_noise") for n in bounds}
    for figures in bounds.values():
        assert figures["nmpc"]["failures"] <= 10


def test_the_thiosulfate_bounds_are_the_reference_figures() -> None:
    bounds = whole_bounds(CASES["thiosulfate_cstr"])
    assert bounds["sp_a"]["nmpc"]["mae"] == pytest.approx(0.064, rel=0.01)
    assert bounds["sp_a"]["offline"]["mae"] == pytest.approx(0.0635, rel=0.01)
    assert bounds["sp_b"]["nmpc"]["mae"] == pytest.approx(0.0073, rel=0.01)
    assert bounds["sp_b"]["offline"]["mae"] == pytest.approx(0.0072, rel=0.02)


def test_the_bounds_of_the_tank_are_the_reference_figures() -> None:
    bounds = whole_bounds(CASES["ph_neutralization"])
    assert bounds["set_point"]["nmpc"]["sse"] == pytest.approx(6.04, abs=0.005)
    assert bounds["disturbance"]["nmpc"]["sse"] == pytest.approx(0.144, abs=0.0005)


def test_the_bounds_of_the_batch_are_the_reference_figures() -> None:
    bounds = whole_bounds(CASES["batch_reactor"])
    for kind in ("nmpc", "offline"):
        assert bounds["trajectory"][kind]["sse"] == pytest.approx(13_252, abs=1)
        assert bounds["trajectory"][kind]["sse_late"] < 0.05


def test_no_controller_of_reference_is_ahead_of_the_bounds_of_the_reactors() -> None:
    # These bounds have no reference figures; the figures are those of tuned controllers.
    cstr = whole_bounds(CASES["henson_seborg_cstr"])
    for test, iae in (("up", 0.0296), ("down", 0.0296), ("jump", 0.0452)):
        assert 0.3 * iae < cstr[test]["nmpc"]["iae"] < iae
    product = whole_bounds(CASES["reversible_cstr"])["levels"]["nmpc"]
    assert product["tracking"] < 0.00035
    # On the reference throughout: its own IAE, and that of the PI that follows it most closely.
    assert product["iae"] == pytest.approx(38.5, rel=0.02)


# ---------------------------------------------------------------------- cases of other kinds
@dataclass(frozen=True)
class TinyTank(PhNeutralizationCase):
    """A tank whose pH stays for four samples."""

    effort: ClassVar[Effort] = Effort(periods=4, tail=2)

    def scenarios(self) -> dict[str, tuple[Scenario, ...]]:
        x0, mv0 = self.plant.steady_state_at(7.0)
        return {"held_out": (Scenario("held_out", "", np.full((4, 1), 7.2), x0, mv0),)}


@pytest.fixture(scope="module")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bounds") / "tank.json"
    lines = list(bounds_stage.compute(TinyTank(), ["held_out"], path=path))
    assert [line.split(": ")[1].split()[0] for line in lines] == ["sse", "sse"]
    return path


def test_noise_does_not_reach_an_nmpc_that_is_given_the_state(tank: Path) -> None:
    bounds = whole_bounds(TinyTank(), tank)
    assert set(bounds["held_out"]) == {"nmpc", "offline"}
    assert bounds["held_out_noise"] == {"nmpc": bounds["held_out"]["nmpc"]}


@pytest.mark.parametrize(
    ("key", "other"),
    [
        ("metric", "mae"),
        ("recipe", True),
        ("unforeseen", False),
        ("limits", {"h": (0.0, 30.0)}),
        ("effort", Effort(periods=4, tail=3)),
    ],
)
def test_figures_for_another_aim_are_refused_and_computed_anew(
    tank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str, other: Any
) -> None:
    monkeypatch.setattr(TinyTank, key, other)
    with pytest.raises(LawError, match=rf"computed for the {key} .*, and the case has .*; run `loopwright bounds"):
        whole_bounds(TinyTank(), tank)
    path = tmp_path / "again.json"
    path.write_text(tank.read_text())
    assert len(list(bounds_stage.compute(TinyTank(), ["held_out"], path=path))) == 2
    assert json.loads(path.read_text())[key] == problem(TinyTank())[key]
    whole_bounds(TinyTank(), path)


def test_a_file_that_says_no_aim_means_the_defaults(stored: Path, tmp_path: Path) -> None:
    tree = json.loads(stored.read_text())
    silent = tmp_path / "silent.json"
    silent.write_text(json.dumps({key: value for key, value in tree.items() if DEFAULTS.get(key) != value}))
    assert not {"metric", "recipe", "unforeseen"} & set(json.loads(silent.read_text()))
    assert whole_bounds(TinyCase(), silent) == whole_bounds(TinyCase(), stored)


def test_noisy_figures_are_means_over_the_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def figures(draws: int, seed: int) -> dict[str, float]:
        monkeypatch.setattr(ThiosulfateCstrCase, "noise_draws", draws)
        monkeypatch.setattr(bounds_stage, "NOISE_SEED", seed)
        path = tmp_path / f"{draws}_{seed}.json"
        list(bounds_stage.compute(TinyCase((1,)), ["held_out"], path=path))
        return whole_bounds(TinyCase((1,)), path)["held_out_noise"]["nmpc"]

    both, one, other = figures(2, 0), figures(1, 0), figures(1, bounds_stage.DRAW_SEEDS)
    assert both["mae"] == pytest.approx((one["mae"] + other["mae"]) / 2, rel=1e-5)
    assert one["mae"] != other["mae"]


def test_the_digest_follows_what_an_output_calls() -> None:
    class Other(PhNeutralization):
        def output(self, x: Any) -> Any:
            return PhNeutralization.output(self, x) + OFFSET

    class Wider(PhNeutralization):
        mv_signals: ClassVar[Any] = (replace(PhNeutralization.mv_signals[0], high=1100.0),)

    class Same(PhNeutralization):
        def output(self, x: Any) -> Any:
            """Another text."""
            return ca.vertcat(PhNeutralization.output(self, x))

    own = equations_digest(PhNeutralization())
    assert equations_digest(Same()) == own
    assert equations_digest(Wider()) != own
    assert equations_digest(Other()) != own


OFFSET = 1e-3
