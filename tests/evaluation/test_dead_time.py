"""After how many samples a plant first answers, by its simulator, or of an own plant by the model of its record."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.evaluation.open_loop import ANSWER_RUN, first_answers, plant_answers
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.serving.manifest import Signal


class Delayed(Simulator):
    """Two first-order lags, each of its own MV after its own dead time; the second MV acts on the first PV, too."""

    name = "delayed"
    title = "Delayed"
    pv_signals = (Signal("a", "K", 0.0, 100.0), Signal("b", "K", 0.0, 100.0))
    sp_signals = pv_signals
    period_s = 1.0

    def __init__(self, first: int, second: int, cross: int, values: tuple[float, ...] | None = None) -> None:
        self.delays = (first, second, cross)
        self.mv_signals = (Signal("u", "-", 0.0, 1.0, values=values), Signal("v", "-", 0.0, 1.0))  # type: ignore[misc]

    @property
    def start(self) -> tuple[Array, Array]:
        return np.zeros(2 + 2 * ANSWER_RUN), np.zeros(2)

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        past = np.concatenate([mv, x[2:]]).reshape(-1, 2)  # newest first
        first, second, cross = self.delays
        a = 0.9 * x[0] + past[first - 1, 0] + 0.5 * past[cross - 1, 1]
        return np.concatenate([[a, 0.8 * x[1] + past[second - 1, 1]], past[:ANSWER_RUN].ravel()])

    def measure(self, x: Array) -> Array:
        return x[:2]


@pytest.mark.parametrize(
    ("first", "second", "cross", "wanted"), [(1, 1, 5, [1, 1]), (7, 3, 9, [7, 3]), (7, 3, 4, [4, 3])]
)
def test_the_quickest_mv_counts_for_each_controlled_variable(
    first: int, second: int, cross: int, wanted: list[int]
) -> None:
    assert plant_answers(Delayed(first, second, cross)) == wanted
    assert plant_answers(Delayed(first, second, cross, values=(0.0, 1.0))) == wanted


def test_a_variable_that_never_answers_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.pipeline.evaluation.open_loop.ANSWER_RUN", 5)
    assert plant_answers(Delayed(3, 9, 9)) == [3, None]


class Unstable(Delayed):
    """Its equations have no state once its first variable is far off, long after it has answered."""

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        after = super().step(x, mv, dv, p)
        after[0] += 0.6 * x[0]
        if abs(after[0]) > 1e3:
            raise PlantError("no state")
        return after


def test_a_plant_that_runs_away_after_its_answer_has_answered() -> None:
    """The run ends there, and the answer is sought in what came before."""
    (first, second) = plant_answers(Unstable(3, 2, 9))
    assert first is not None
    assert 3 <= first < ANSWER_RUN
    assert second == 2


def figures(answers: dict[str, dict[str, int | None]]) -> dict[str, Any]:
    """metrics.json of a model set with an identified model."""
    return {"parts": {"identified": {"kind": "identified", "per_seed": {"0": {"first_answers": answers}}}}}


@pytest.mark.parametrize(
    ("answers", "wanted"),
    [
        ({"a": {"u": 5, "v": 4, "d": 1}, "b": {"u": None, "v": None, "d": 1}}, [4, None]),
        ({"a": {"u": None, "v": 9}, "b": {"u": 2, "v": 3}}, [9, 2]),
        ({"a": {"u": 5, "v": 4}}, [7, 3]),  # figures of another plant's variables: the plant is moved
        ({}, [7, 3]),
    ],
)
def test_of_an_own_plant_the_models_own_figures_count(
    answers: dict[str, dict[str, int | None]], wanted: list[int | None]
) -> None:
    case: Any = SimpleNamespace(plant=Delayed(7, 3, 9))
    assert first_answers(case, figures(answers)) == wanted
    assert first_answers(case, {}) == [7, 3]


@pytest.mark.parametrize("name", CASES)
def test_a_plant_in_equations_answers_within_two_samples(name: str) -> None:
    """The jacketed reactor's content answers through its jacket: less than a tenth of it within a period."""
    assert plant_answers(CASES[name].plant) == [2 if name == "jacketed_batch_reactor" else 1]
