"""The jacketed batch reactor's tests, what they are scored by, and what is said where nothing was measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.jacketed_batch_reactor.case import OBSERVER
from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_plant import FuzzyBatchReactor
from loopwright.pipeline.cases.jacketed_batch_reactor.paper import CLAIMS, _quiet
from loopwright.pipeline.cases.jacketed_batch_reactor.pictures import PICTURES
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Form, LawEvidence, LawMetrics
from loopwright.pipeline.evaluation.metric import together
from loopwright.pipeline.report.verdicts import judge
from loopwright.pipeline.simulation.scenario import Scenario

CASE = CASES["jacketed_batch_reactor"]


def course(*levels: tuple[float, int]) -> np.ndarray:
    return np.concatenate([np.full(n, value) for value, n in levels])[:, None]


def test_figures_by_level_of_a_recipe() -> None:
    sp = course((40.0, 300), (30.0, 300))
    test = Scenario("x", "", sp, np.full(2, 20.0), np.array([0.0, 1.0]))
    core = np.concatenate(
        [np.linspace(20, 40.5, 100), np.full(200, 40.25), np.linspace(40.25, 29.9, 100), np.full(200, 30.0)]
    )
    core[-200:-100] = 29.9  # within the second tail of 150 samples, before its last 50
    pv = np.column_stack([core, np.where(sp[:, 0] == 40, 65.0, 22.0)])
    mode = np.r_[np.full(100, 1.0), np.full(50, 2.0), np.full(450, 1.0)]
    found = CASE.score(test, pv, np.column_stack([np.zeros(600), mode]))
    assert found["switches"] == 2
    assert (found["min_jacket"], found["max_jacket"]) == (22.0, 65.0)
    assert found["max_asse"] == pytest.approx(0.25)
    assert found["masse"] == pytest.approx(0.125)
    assert found["max_overshoot"] == pytest.approx(0.5)
    tails = np.r_[np.full(150, 0.25), np.full(50, -0.1), np.zeros(100)]
    assert found["tail_rms"] == pytest.approx(np.sqrt(np.mean(tails**2)))
    assert found["mae"] == pytest.approx(np.abs(core - sp[:, 0]).mean())


def test_worst_figures_stay_worst_over_several_sequences() -> None:
    rows = [
        {"mae": 1.0, "max_overshoot": 0.3, "min_jacket": 20.0},
        {"mae": 3.0, "max_overshoot": 0.1, "min_jacket": 19.0},
    ]
    assert together(rows, CASES["jacketed_batch_reactor"].metrics) == {
        "mae": 2.0,
        "max_overshoot": 0.3,
        "min_jacket": 19.0,
    }


@pytest.mark.parametrize(("name", "share"), [("theta_10", 0.1), ("theta_20", 0.2)])
def test_perturbed_models_are_off_by_their_share_and_stable(name: str, share: float) -> None:
    printed = np.array(FuzzyBatchReactor().consequents())
    tests = CASE.scenarios()[name]
    assert len({t.digest() for t in tests}) == len(tests) == 10
    off = np.array([t.plant.consequents() for t in tests]) / printed[None]
    off[:, :, 0] = (1 - off[:, :, 0] * printed[None, :, 0]) / (1 - printed[None, :, 0])
    assert np.abs(off - 1).max() <= share + 1e-12
    assert np.abs(off - 1).max() > 0.9 * share
    assert all(t.plant.core == FuzzyBatchReactor().core for t in tests)


def test_the_printed_model_is_tested_as_it_stands() -> None:
    (test,) = CASE.scenarios()["same_model"]
    assert test.plant == FuzzyBatchReactor()
    assert all(t.plant is None for name in ("profile", "held_out", "feed") for t in CASE.scenarios()[name])


def test_where_nothing_was_measured_nothing_is_claimed() -> None:
    empty = Evidence(CASE, {}, {}, {})
    judged = judge(empty, CLAIMS)
    known = "an extreme input gives an extreme output in each mode"  # of the printed matrices themselves
    assert [v.what for v in judged.statements if v.holds is not None] == [known]
    assert all(v.holds is None for v in judged.acceptance if not v.what.startswith("best controller, "))
    for picture in PICTURES:
        with pytest.raises(NotMeasuredError):
            picture.draw(empty)


class Switching(Evidence):
    """Evidence of the feedforward's switches over each identification, and no other figure."""

    def __init__(self, switches: dict[str, float], models: dict[str, Any]) -> None:
        super().__init__(CASE, {}, {}, models)
        object.__setattr__(self, "switches", switches)

    def figure(self, law, scenario, metric=None, setting=None, how="median"):
        return self.switches.get(setting["part"])


def told(switches: dict[str, float], a1_hot: float = 1.01) -> Evidence:
    """Shut, mode cold cools the jacket at 26 deg C."""
    line = {"a1": (a1_hot, 0.99), "a2": (0.0, 0.0), "r": (0.0, 0.0)}
    parameters = {
        f"{name}_{mode}_{centre}": value
        for name, both in line.items()
        for mode, value in zip(("hot", "cold"), both, strict=True)
        for centre in (20, 40, 70)
    }
    parts = {how: {"median": {"parameters": parameters}} for how in switches}
    return Switching(switches, {"hybrid_fuzzy": {"parts": parts}})


def test_a_model_that_alternates_falls_short_and_says_where() -> None:
    few = _quiet(told({"tied": 6.0, "global": 6.0, "local": 8.0}))
    assert (few.holds, few.because) == (True, "")
    many = _quiet(told({"tied": 6.0, "global": 6.0, "local": 214.0}))
    assert many.holds is False
    assert "local: at 26 °C a shut throttle moves the jacket by +0.26 °C a period in mode hot and -0.26" in many.because
    assert "tied" not in many.because
    assert _quiet(told({"tied": 6.0, "global": 6.0, "local": 214.0}, a1_hot=0.99)).because == ""
    with pytest.raises(NotMeasuredError):
        _quiet(told({"tied": 6.0}))


def test_pictures_of_a_recipe_need_what_the_law_tells(tmp_path: Path) -> None:
    """A loop whose law tells no adjusted reference gives no picture."""
    n = 5
    arrays = {
        "time_s": np.arange(n),
        "sp": np.ones((n, 1)),
        "pv": np.ones((n, 2)),
        "mv": np.ones((n, 2)),
        "info": np.ones((n, 2)),
    }
    np.savez(tmp_path / "trajectories.npz", **{f"profile_noise/base/0/{k}": v for k, v in arrays.items()})
    (recipe,) = (p for p in PICTURES if p.name == "recipe_reactor")

    def draw(*info: str) -> Canvas:
        metrics = LawMetrics(OBSERVER, "x", "mae", (0,), 0, {"base": Form({}, info, {})})
        law = LawEvidence(metrics, tmp_path / "trajectories.npz")
        return recipe.draw(Evidence(CASE, {}, {OBSERVER: law}, {}))

    assert draw("adjusted_reference", "wanted_jacket").axes
    with pytest.raises(NotMeasuredError):
        draw("a", "b")
