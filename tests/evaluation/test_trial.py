"""What a file's trial makes of its loops: noise repeated and averaged, lock-ups counted, infos kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.evaluation import trials
from loopwright.pipeline.evaluation.case import Case, Curve, Figure
from loopwright.pipeline.evaluation.stuck_loops import seized, swings_on
from loopwright.pipeline.evaluation.trials import DRAW_SEEDS, close_loop, repeated, try_files
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.serving.errors import OutputError
from loopwright.serving.manifest import Signal


@dataclass
class Told:
    info: tuple[str, ...] = ("error", "steps")
    operate: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()


class Proportional:
    """u = 1/2 + gain (r - y), as a controller is stepped; refuses the steps of ``refused``."""

    manifest = Told()

    def __init__(self, gain: float = 0.02, refused: int = -1) -> None:
        self.gain, self.refused, self.steps = gain, refused, 0
        self.dv: list[Any] = []

    def cold_state(self) -> np.ndarray:
        return np.zeros(1)

    def step(self, *, sp: Any, pv: Any, dv: Any, mv_applied: Any, state: Any) -> Any:
        self.steps += 1
        self.dv.append(dv)
        if self.steps == self.refused:
            raise OutputError("no")
        error = sp - pv
        return np.clip(0.5 + self.gain * error, 0.0, 1.0), state + 1, np.array([error[0], state[0]])


@pytest.fixture
def case() -> Case:
    return CASES["batch_reactor"]


def test_noisy_figures_are_means_over_different_noise(case: Case) -> None:
    test = case.scenarios()["trajectory"][0]
    controller: Any = Proportional()
    found = repeated(controller, case, test, True, 7)
    loops = [
        close_loop(controller, case.plant, test, case.noise_std, 7 + DRAW_SEEDS * i) for i in range(case.noise_draws)
    ]
    rows = [case.score(test, loop.pv, loop.mv) for loop in loops]
    assert len({row["sse"] for row in rows}) == case.noise_draws
    assert found.metrics["sse"] == pytest.approx(np.mean([row["sse"] for row in rows]), rel=1e-12)
    assert np.array_equal(found.first.measured, loops[0].measured)
    quiet = repeated(controller, case, test, False, 7)
    assert quiet.metrics == case.score(test, quiet.first.pv, quiet.first.mv)


def test_figures_of_a_test_with_a_late_part_count_it(case: Case) -> None:
    test = case.scenarios()["trajectory"][0]
    controller: Any = Proportional()
    loop = close_loop(controller, case.plant, test, None, 0)
    error = (loop.sp - loop.pv)[:, 0]
    found = case.score(test, loop.pv, loop.mv)
    assert found["sse_late"] == pytest.approx(float(np.sum(error[test.late_from :] ** 2)))
    assert found["sse"] > 5 * found["sse_late"] > 0


def test_a_law_gets_the_nominal_measured_disturbances(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    test, controller = case.scenarios()["trajectory"][0], Proportional()
    monkeypatch.setattr(type(case.plant), "dv_nominal", np.array([295.0]))
    monkeypatch.setattr(type(case.plant), "stepper", lambda self: lambda x, mv, dv, p: x)
    close_loop(controller, case.plant, test, None, 0)  # type: ignore[arg-type]
    assert len(controller.dv) == test.samples
    assert {tuple(dv) for dv in controller.dv} == {(295.0,)}


def test_a_refused_step_keeps_the_mv_and_counts_as_a_lock_up(case: Case) -> None:
    test = case.scenarios()["trajectory"][0]
    held: Any = Proportional(refused=13)
    loop = close_loop(held, case.plant, test, None, 0)
    assert loop.mv[12] == loop.mv[11]
    assert loop.info[:, -1].tolist() == [float(k == 12) for k in range(test.samples)]
    assert loop.info[13, 1] == 0  # it started afresh
    assert seized(case, test, loop)[0]
    sound: Any = Proportional()
    assert not seized(case, test, close_loop(sound, case.plant, test, None, 0))[0]


def test_a_loop_at_its_limit_is_locked_up_and_a_start_up_is_not(case: Case) -> None:
    test = case.scenarios()["trajectory"][0]
    cold: Any = Proportional(gain=-1.0)  # the wrong way: full cooling for ever
    assert seized(case, test, close_loop(cold, case.plant, test, None, 0))[0]
    hard: Any = Proportional(gain=1.0)  # full heating for 8 samples, then near the profile
    loop = close_loop(hard, case.plant, test, None, 0)
    assert (loop.mv[:7] == 1).all()
    assert not seized(case, test, loop)[0]


def test_a_loop_that_swings_to_the_end_is_no_lock_up_and_is_told(case: Case) -> None:
    test = case.scenarios()["trajectory"][0]
    sound: Any = Proportional()
    loop = close_loop(sound, case.plant, test, None, 0)
    assert not swings_on(case, test, loop)
    pv, cv = loop.pv.copy(), case.plant.sp_signals[0]
    pv[:, 0] = cv.middle + 0.02 * (cv.high - cv.low) * np.cos(np.pi * np.arange(len(pv)))
    assert swings_on(case, test, replace(loop, pv=pv, sp=np.full_like(loop.sp, cv.middle)))


def test_a_trial_runs_what_the_case_asks_of_each_form(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials, "Controller", lambda path: Proportional())
    monkeypatch.setattr(type(case), "noise_draws", 2)
    base = try_files(case, 0, [("base", 3, Path("p.onnx"))], "try")[0]
    fixed = ["trajectory", "trajectory_noise", "fouling", "fouling_noise"]
    assert list(base.metrics) == [*fixed, "held_out", "held_out_noise"]
    assert list(base.sequences["held_out"]) == [str(s) for s in case.held_out_seeds]
    variant = try_files(case, 0, [("gain=1", 3, Path("p.onnx"))], "try")[0]
    assert list(variant.metrics) == fixed  # with noise, because the plant has no other measurements
    assert np.isnan(variant.development)
    assert np.isnan(variant.development_travel)
    assert base.locked_up == {}
    assert base.lock_ups == base.development_lock_ups == 0
    # The development is judged by the case's metric, under the noise that the plant always has.
    controller: Any = Proportional()
    tests = case.development()
    rows = [repeated(controller, case, t, True, trials.DEVELOPMENT + i) for i, t in enumerate(tests)]
    assert base.development == pytest.approx(np.mean([row.metrics["sse"] for row in rows]))
    assert base.development_travel == pytest.approx(np.mean([row.metrics["mv_travel"] for row in rows]))
    # Infos are those of the manifest, without the mark of a refused step.
    assert base.info == ("error", "steps")
    assert base.curves["trajectory"].info.shape == (50, 2)
    assert base.curves["trajectory"].info[-1, 1] == 49


def test_a_case_says_what_variants_run_and_figures_of_a_paper_add_no_test(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "Controller", lambda path: Proportional(gain=-1.0))  # full cooling for ever
    monkeypatch.setattr(type(case), "noise_draws", 1)
    monkeypatch.setattr(type(case), "figures", (Figure(9, "x", (Curve("p"),), "fouling"),))
    monkeypatch.setattr(type(case), "variants_run", lambda self, tests: tests[0].name == "fouling")
    test = case.scenarios()["trajectory"][0]
    monkeypatch.setattr(type(case), "unscored", lambda self: {"longer": test})
    found = try_files(case, 0, [("gain=1", 3, Path("p.onnx"))], "try")[0]
    assert list(found.metrics) == ["fouling", "fouling_noise"]
    assert list(found.curves) == ["fouling", "fouling_noise", "longer"]
    # Every run that got stuck counts, the one that is not scored too.
    assert found.locked_up == {"fouling": 1, "fouling_noise": 1, "longer": 1}
    assert found.lock_ups == 3


def test_variants_run_without_noise_where_the_plant_does(monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES["ph_neutralization"]
    monkeypatch.setattr(trials, "Controller", lambda path: Proportional(0.0))
    monkeypatch.setattr(Proportional, "step", lambda self, **kw: (kw["mv_applied"], kw["state"], np.zeros(2)))
    found = try_files(case, 0, [("penalty=20", 0, Path("p.onnx"))], "try")[0]
    assert list(found.metrics) == ["set_point", "disturbance", "buffer", "base"]


class Fed(Simulator):
    """A tank whose feed is measured, with noise."""

    name, title, period_s = "fed", "Fed", 1.0
    sp_signals = pv_signals = (Signal("level", "m", 0.0, 10.0),)
    mv_signals = (Signal("valve", "", 0.0, 1.0),)
    dv_signals = (Signal("feed", "t/h", 0.0, 9.0),)

    def __init__(self, sd: float) -> None:
        self.sd = sd

    @property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([5.0]), np.array([0.5])

    @property
    def dv_noise_std(self) -> np.ndarray:
        return np.array([self.sd])

    def step(self, x: np.ndarray, mv: np.ndarray, dv: np.ndarray, p: np.ndarray) -> np.ndarray:
        return 0.9 * x + mv + 0.1 * dv

    def measure(self, x: np.ndarray) -> np.ndarray:
        return x


def test_measured_disturbances_have_their_own_noise_where_the_test_has_noise() -> None:
    """The law reads it and the plant does not feel it; that of the process variables is as without it."""

    def course(sd: float, noise: Any) -> tuple[np.ndarray, Any]:
        plant, controller = Fed(sd), Proportional(gain=0.0)
        test = Scenario("rest", "Rest", np.full((400, 1), 5.0), *plant.start, dv=np.full((400, 1), 2.0))
        loop = close_loop(controller, plant, test, noise, 3)  # type: ignore[arg-type]
        return np.array(controller.dv), loop

    noise = np.array([0.1])
    (plain, still), (noisy, loop) = course(0.0, noise), course(0.5, noise)
    assert (plain == 2).all()
    assert float((noisy - plain).std()) == pytest.approx(0.5, rel=0.1)
    assert np.array_equal(loop.measured, still.measured)
    assert np.array_equal(course(0.5, None)[0], plain)
