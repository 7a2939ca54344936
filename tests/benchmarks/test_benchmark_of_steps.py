"""The benchmark of the controllers' steps: a row as each comes, and no more time than was given."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

FILE = Path(__file__).parents[2] / "benchmarks" / "step.py"
TITLE = 2  # lines before the first row: what is measured, and the table's head


@pytest.fixture
def step(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_of_steps", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


class Bench:
    """Stands for ``loopwright.serving.card.bench``: each round takes 3 s of its clock, with equal figures."""

    def __init__(self, hot_us: float, capsys: Any) -> None:
        self.now, self.hot_us, self.capsys, self.calls, self.shown = 0.0, hot_us, capsys, 0, ""
        self.rows_before: list[int] = []

    def monotonic(self) -> float:
        return self.now

    def __call__(self, controller: Any, **_: int) -> tuple[Any, ...]:
        self.shown += self.capsys.readouterr().out
        self.rows_before.append(len(self.shown.splitlines()) - TITLE)
        self.now += 3.0
        self.calls += 1
        return tuple(SimpleNamespace(p50=x, alone=4 * x) for x in (self.hot_us, self.hot_us, 9 * self.hot_us))


def run(step: ModuleType, bench: Bench, monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    monkeypatch.setattr(
        step, "Controller", lambda file: SimpleNamespace(manifest=SimpleNamespace(case=file, law="inc"))
    )
    monkeypatch.setattr(step, "CASES", {})
    monkeypatch.setattr(step, "bench", bench)
    monkeypatch.setattr(step, "time", SimpleNamespace(monotonic=bench.monotonic))
    monkeypatch.setattr("sys.argv", ["step.py", *options])
    return int(step.main())


def test_each_controller_has_its_row_before_the_next_one_is_measured(
    step: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(5.0, capsys)
    assert run(step, bench, monkeypatch, "a.onnx", "b.onnx", "c.onnx", "--rounds", "2") == 0
    assert bench.rows_before == [0, 0, 1, 1, 2, 2]
    rows = (bench.shown + capsys.readouterr().out).splitlines()[TITLE:]
    assert [row.split("/")[0] for row in rows] == ["a.onnx", "b.onnx", "c.onnx"]


@pytest.mark.parametrize("seconds", [30.0, 60.0])
def test_figures_over_their_limits_are_measured_again_but_not_beyond_the_time(
    step: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], seconds: float
) -> None:
    slow = Bench(1e4, capsys)
    assert run(step, slow, monkeypatch, "a", "b", "c", "--rounds", "2", "--seconds", str(seconds)) == 1
    assert slow.now <= seconds + 3.0  # and one round
    assert slow.calls > 3 * 2
    assert capsys.readouterr().out.count("hot over") + slow.shown.count("hot over") == 3


def test_the_perfect_models_step_is_sampled(step: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=0.0)

    class Nmpc:
        def __init__(self, plant: Any, *_: Any) -> None:
            self.mv = np.array([s.middle for s in plant.mv_signals])

        def step(self, *_: Any) -> Any:
            clock.now += 2.0
            return self.mv

    monkeypatch.setattr(step, "PerfectNmpc", Nmpc)
    times = SimpleNamespace(monotonic=lambda: clock.now, perf_counter_ns=lambda: int(1e9 * clock.now))
    monkeypatch.setattr(step, "time", times)
    median, samples = step.nmpc_median_us("thiosulfate_cstr", 50, 30.0)
    assert median == 2e6
    assert samples == 16  # the first after 30 s is not begun
    assert step.nmpc_median_us("thiosulfate_cstr", 50, 0.0)[1] == step.LEAST_SAMPLES
    assert step.nmpc_median_us("thiosulfate_cstr", 5, 1e9)[1] == 5


def test_a_long_tail_is_a_complaint_about_a_law_of_long_steps_alone(step: ModuleType) -> None:
    assert step.complaints("predictive", 300.0, 300.0, 30.0, 3.5) == ["p99.9 over 3 p50"]
    assert step.complaints("predictive", 300.0, 300.0, 30.0, 2.5) == []
    assert step.complaints("predictive", 300.0, 300.0, 30.0, float("nan")) == []
    assert step.complaints("inc", 5.0, 5.0, 300.0, 9.0) == []
    assert step.complaints("predictive", 501.0, 300.0, 30.0, 1.0) == ["hot over 500"]
