"""After how many samples a plant answers: structural dead time, of the simulator alone."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.evaluation.open_loop import LONGEST_DEAD_TIME, dead_times
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
        return np.zeros(2 + 2 * LONGEST_DEAD_TIME), np.zeros(2)

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        past = np.concatenate([mv, x[2:]]).reshape(-1, 2)  # newest first
        first, second, cross = self.delays
        a = 0.9 * x[0] + past[first - 1, 0] + 0.5 * past[cross - 1, 1]
        return np.concatenate([[a, 0.8 * x[1] + past[second - 1, 1]], past[:LONGEST_DEAD_TIME].ravel()])

    def measure(self, x: Array) -> Array:
        return x[:2]


@pytest.mark.parametrize(
    ("first", "second", "cross", "wanted"), [(1, 1, 5, [1, 1]), (7, 3, 9, [7, 3]), (7, 3, 4, [4, 3])]
)
def test_the_quickest_mv_counts_for_each_controlled_variable(
    first: int, second: int, cross: int, wanted: list[int]
) -> None:
    assert dead_times(Delayed(first, second, cross)) == wanted
    assert dead_times(Delayed(first, second, cross, values=(0.0, 1.0))) == wanted


def test_a_variable_that_never_answers_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.pipeline.evaluation.open_loop.LONGEST_DEAD_TIME", 5)
    assert dead_times(Delayed(3, 9, 9)) == [3, None]


@pytest.mark.parametrize("name", CASES)
def test_a_plant_in_equations_answers_at_the_next_sample(name: str) -> None:
    """Its derivative has the MV in it, and a period is long beside nothing."""
    assert dead_times(CASES[name].plant) == [1]
