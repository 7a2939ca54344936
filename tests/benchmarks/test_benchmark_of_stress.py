"""The simulated clock of benchmarks/stress.py."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

MAKESPAN = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "stress.py"))["makespan"]


@pytest.mark.parametrize(
    ("workers", "overhead", "seconds"),
    [
        (1, 0.0, 8.0),  # one after the other
        (4, 0.0, 2.0),  # all at work all the time
        (8, 0.0, 1.0),  # a task each
        (64, 0.0, 1.0),  # more workers than tasks
        (64, 0.5, 5.0),  # the last task is handed out after eight overheads
        (1, 0.5, 8.5),  # handing out goes on while the worker works
    ],
)
def test_eight_tasks_of_a_second(workers: int, overhead: float, seconds: float) -> None:
    assert MAKESPAN([1.0] * 8, workers, overhead) == pytest.approx(seconds)
