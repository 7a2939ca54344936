"""What a step costs: percentiles with and without what other programs take, and memory that does not grow."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from loopwright.serving import Controller
from loopwright.serving import card as module
from loopwright.serving.card import Timing, bench, table

pytest_plugins = ["small_laws"]


def test_a_step_that_lost_the_processor_does_not_count_as_the_controller_s() -> None:
    """20 of 2,000 steps of 100 us wait for 5 ms; one of the others takes 150 us itself."""
    wall, processor = np.full(2_000, 1e5), np.full(2_000, 1e5)
    wall[::100] += 5e6
    wall[1:4], processor[1:4] = 1.5e5, 1.5e5
    found = Timing.of("hot", wall, processor)
    assert found.p50 == 100
    assert found.p999 == pytest.approx(5_100)
    assert found.waited == pytest.approx(1.0)
    assert found.alone == pytest.approx(150)
    assert table((found,)).splitlines()[1].split()[-6:] == ["1.00", "%", "150.0", "=", "1.5", "p50"]


def test_where_the_system_does_not_tell_nothing_is_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TELLS", False)
    found = Timing.of("hot", np.full(10, 1e5), np.zeros(10))
    assert found.p999 == 100
    assert np.isnan([found.waited, found.alone]).all()


def test_only_the_steps_that_were_asked_for_count(controller: Controller) -> None:
    hot, warmed, cold = bench(controller, steps=30, loop_steps=5, period_s=0.001)
    assert (hot.label, warmed.label, cold.label) == ("hot", "every 1 ms, warmed", "every 1 ms, cold")
    for found in (hot, warmed, cold):
        assert 0 < found.p50 <= found.p99 <= found.p999


def test_no_step_leaves_memory_behind(pi_file: Path) -> None:
    controller = Controller(pi_file)
    state, inputs = controller.cold_state(), {"sp": [1.0], "pv": [0.9, 300.0], "dv": [1.0], "mv_applied": [50.0]}
    tracemalloc.start()
    try:
        left = []
        for _ in range(3):
            for _ in range(1_000):
                state = controller.step(**inputs, state=state).state
            left.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert left[2] - left[1] < 1_000  # a float64 a step would be 8,000
