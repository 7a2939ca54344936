"""One dead time of one model: its law, its figures, the report, the manifest and the monitor have the same number."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import made_plants
import numpy as np
import pytest
from finished import plant_of

from loopwright.pipeline.dynamics.step_response import answers_after
from loopwright.pipeline.evaluation.open_loop import first_answers, plant_answers
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.identified_part import IdentifiedPart
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.report.identified_model import ANSWERS, model_section
from loopwright.pipeline.tuning.responses import StepResponses
from loopwright.serving.manifest import Manifest
from loopwright.serving.monitor.monitor import Monitor

LINEAR = IdentifiedPart(orders=(2, 4), units=(), minutes=0.05)
GAINS, POLES = np.array([[0.5, -0.3], [0.2, 0.6]]), np.array([0.9, 0.8])
LATE = np.array([[3, 6], [4, 1]])  # [periods] of each output to each MV


def late_two_by_two() -> Record:
    """Two outputs, each a lag for each MV, behind a dead time of the pair."""
    rng, n = np.random.default_rng(3), 2000
    u = np.column_stack([made_plants.random_holds(rng, n, 20) for _ in range(2)])
    x, y = GAINS * u[0], np.empty((n, 2))
    for k in range(n):
        y[k] = x.sum(axis=1) + 0.02 * rng.normal(size=2)
        acting = np.array([[u[max(k - LATE[i, j], 0), j] for j in range(2)] for i in range(2)])
        x = POLES[:, None] * x + (1 - POLES[:, None]) * GAINS * acting
    return Record.of(made_plants.signals_of(2, 2), y, u)


def four_lags(u: np.ndarray) -> np.ndarray:
    """Four lags of six periods each, one behind the other, at rest under the first of the moves u (n,)."""
    pole, x, y = np.exp(-1 / 6), np.full(4, u[0]), np.empty(len(u))
    for k, move in enumerate(u):
        y[k] = x[3]
        x = pole * x + (1 - pole) * np.array([move, *x[:3]])
    return y


def lags_alone() -> Record:
    """Lags that pass for dead time, without one."""
    rng = np.random.default_rng(0)
    u = made_plants.random_holds(rng, 2000, 60)
    y = 20 + 0.5 * four_lags(u) + 0.1 * rng.normal(size=len(u))
    return Record.of(made_plants.signals_of(1, 1), y[:, None], u[:, None])


@dataclass(frozen=True)
class Fitted:
    """A model, its figures, its signals, and the first answers (n_y, n_mv) [periods] of the plant."""

    model: Identified
    figures: dict[str, Any]
    signals: Signals
    truth: list[list[int]]

    @property
    def metrics(self) -> dict[str, Any]:
        """metrics.json of the model set."""
        return {"parts": {"identified": {"kind": "identified", "per_seed": {"0": self.figures}}}}

    @property
    def pairs(self) -> list[list[int]]:
        """First answers (n_y, n_mv) [periods] in the figures."""
        s = self.signals
        return [[self.figures["first_answers"][y.name][u.name] for u in s.mv] for y in s.sp]


def fitted(record: Record, size: int, truth: list[list[int]]) -> Fitted:
    signals = made_plants.signals_of(size, size)
    learnt = LINEAR.learn(Source(record, signals))
    assert isinstance(learnt.model, Identified)
    return Fitted(learnt.model, learnt.metrics, signals, truth)


@pytest.fixture(scope="module", params=["one", "lags", "two"])
def found(request: pytest.FixtureRequest) -> Fitted:
    if request.param == "one":  # four periods of dead time; a fifth through the second lag
        return fitted(made_plants.second_order(1000, delay=4), 1, [[6]])
    if request.param == "lags":  # 1 by any change beyond rounding
        after = int(answers_after(four_lags(np.r_[0.0, np.ones(200)])[2:]))  # the move acts from row 1 on
        assert after > 3
        return fitted(lags_alone(), 1, [[after]])
    return fitted(late_two_by_two(), 2, (LATE + 1).tolist())


def test_the_figures_have_the_first_answer_of_each_pair(found: Fitted) -> None:
    assert found.pairs == found.truth


def test_laws_have_the_dead_time_one_period_less_than_the_quickest_output(found: Fitted) -> None:
    dead = found.model.dead.tolist()
    assert dead == [min(of) - 1 for of in zip(*found.pairs, strict=True)]
    assert dead == [found.figures["dead_times"][u.name] for u in found.signals.mv]


def test_tuning_and_suitability_see_the_same_by_simulation(found: Fitted) -> None:
    plant = plant_of(found.model, found.signals)
    responses, n = StepResponses.near_start(plant), len(found.pairs)
    assert [[responses.answers_after(i, j) for j in range(n)] for i in range(n)] == found.pairs
    assert plant_answers(plant) == [min(of) for of in found.pairs]


def test_the_report_prints_them_in_seconds(found: Fitted) -> None:
    s = found.signals
    plant = SimpleNamespace(period_s=s.period_s, sp_signals=s.sp, mv_signals=s.mv, dv_signals=s.dv)
    case = SimpleNamespace(plant_class=plant, plant=plant, on_models=False, replayed=None)
    section = model_section(SimpleNamespace(case=case, models={"set": found.metrics}))  # type: ignore[arg-type]
    assert section is not None
    column = ANSWERS.index("First answer after [s]")
    printed = {row[:2]: float(row[column]) for row in section.answers}
    assert printed == {
        (y.name, u.name): k * s.period_s
        for y, of in zip(s.sp, found.pairs, strict=True)
        for u, k in zip(s.mv, of, strict=True)
    }


def test_manifest_and_monitor_count_from_a_move_of_the_quickest_mv(found: Fitted) -> None:
    s = found.signals
    told = first_answers(SimpleNamespace(plant=plant_of(found.model, s)), found.metrics)  # type: ignore[arg-type]
    assert told == [min(of) for of in found.pairs]
    silent = Manifest("it", "pid", s.period_s, s.sp, s.pv, (), s.mv, 0, (), ("sp", "pv", "state"))
    assert Monitor(silent, started_s=0.0).first_answers == [2] * len(s.sp)
    assert Monitor(replace(silent, evidence={"dead_time_periods": told}), started_s=0.0).first_answers == told
    assert min(k for k in told if k) - 1 == min(found.model.dead.tolist())  # that a predictive law counts on
