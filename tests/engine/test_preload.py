"""A worker imports what tasks need whenever it is idle, and never in a task's way."""

from __future__ import annotations

import gc
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from loopwright.pipeline.engine import preload
from loopwright.pipeline.engine.cluster import STAGES

ROOT = Path(__file__).parents[2]


class Idle:
    """A worker's loop and its thread for tasks, in the test's hands."""

    def __init__(self) -> None:
        self.state = SimpleNamespace(executing=set(), ready=set(), long_running=set())
        self.waiting = deque[Callable[[], Any]]()
        self.loop, self.executors = self, {"default": self}
        self.periodic_callbacks: dict[str, Any] = {}

    def add_callback(self, act: Callable[[], Any]) -> None:
        self.waiting.append(act)

    submit = add_callback

    def call_later(self, _: float, act: Callable[[], Any]) -> None:
        self.waiting.append(act)


@pytest.mark.parametrize("busy", ["executing", "ready", "long_running"])
def test_imports_go_on_while_nothing_else_is_to_be_done(monkeypatch: pytest.MonkeyPatch, busy: str) -> None:
    imported: list[str] = []
    collecting: list[bool] = []

    def steps() -> Any:
        for name in "abc":
            imported.append(name)
            collecting.append(gc.isenabled())
            yield name

    monkeypatch.setattr(preload, "loading", steps)
    monkeypatch.setattr(preload, "listen", lambda: None)
    before = gc.get_freeze_count()
    worker = Idle()
    setting = threading.Thread(target=preload.dask_setup, args=(worker,))  # in the main one it would take over Ctrl-C
    setting.start()
    setting.join()
    assert imported == []
    for _ in range(2):  # may it go on, and a step
        worker.waiting.popleft()()
    assert imported == ["a"]
    assert gc.isenabled()
    getattr(worker.state, busy).add("a task")
    for _ in range(10):
        worker.waiting.popleft()()
    assert imported == ["a"]
    getattr(worker.state, busy).clear()
    while worker.waiting:
        worker.waiting.popleft()()
    assert imported == ["a", "b", "c"]
    assert collecting == [False] * 3
    assert gc.isenabled()
    assert gc.get_freeze_count() > before


def test_a_worker_that_ends_meanwhile_complains_of_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def ended(_: Callable[[], Any]) -> None:
        raise RuntimeError("cannot schedule new futures after shutdown")

    monkeypatch.setattr(preload, "listen", lambda: None)
    worker = Idle()
    worker.executors = {"default": SimpleNamespace(submit=ended)}  # type: ignore[dict-item]
    setting = threading.Thread(target=preload.dask_setup, args=(worker,))
    setting.start()
    setting.join()
    worker.waiting.popleft()()
    assert not worker.waiting


def test_what_is_missing_or_broken_stops_no_import(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preload, "LIBRARIES", ("not_a_library_at_all", "json"))
    monkeypatch.setattr(preload.pkgutil, "walk_packages", lambda *_, **__: [SimpleNamespace(name="pipeline.not_there")])
    assert list(preload.loading()) == ["not_a_library_at_all", "json", "pipeline.not_there"]


def imported(monkeypatch: pytest.MonkeyPatch, stages: str | None) -> list[str]:
    """The names that a worker would import which is told of ``stages``; none is imported."""
    monkeypatch.setattr(preload, "importlib", SimpleNamespace(import_module=lambda _: None))
    monkeypatch.delenv(STAGES, raising=False)
    if stages is not None:
        monkeypatch.setenv(STAGES, stages)
    return list(preload.loading())


@pytest.mark.parametrize("stages", [None, "", "fit,bounds", "bounds"])
def test_a_worker_for_anything_imports_everything(monkeypatch: pytest.MonkeyPatch, stages: str | None) -> None:
    names = imported(monkeypatch, stages)
    assert names[: len(preload.LIBRARIES)] == list(preload.LIBRARIES)
    assert {
        "loopwright.pipeline.stages.design",
        "loopwright.pipeline.models.static.fuzzy_means",
        "loopwright.pipeline.laws.pid.pid",
    } <= set(names)


def test_a_worker_for_models_alone_imports_no_exporter(monkeypatch: pytest.MonkeyPatch) -> None:
    libraries = ["casadi", "pandas", "pyarrow.parquet", "matplotlib.figure", "torch"]
    assert imported(monkeypatch, "screen,fit,overview") == [*libraries, "loopwright.pipeline.stages.fit"]
    assert imported(monkeypatch, "excite") == [*libraries[:3], "loopwright.pipeline.stages.excite"]
    assert imported(monkeypatch, "screen") == []


def test_a_worker_for_controllers_imports_the_exporter_where_they_are_designed(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, designed = imported(monkeypatch, "validate,report"), imported(monkeypatch, "validate,design")
    assert tried == ["onnxruntime", "casadi", "pyarrow.parquet", "onnx", "loopwright.pipeline.stages.validate"]
    assert {"torch", "torch.export._trace", "onnxscript.optimizer"} <= set(designed)
    assert designed[-2:] == ["loopwright.pipeline.stages.validate", "loopwright.pipeline.stages.design"]


def test_every_stage_that_needs_a_worker_is_known_to_need_something() -> None:
    """A kind without libraries runs where it was started, by dvc.yaml."""
    stages = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
    on_workers = {kind for kind, stage in stages.items() if "meta" in stage.get("do", stage)}
    assert {kind for kind, names in preload.OF_KIND.items() if names} <= on_workers
    assert {kind for kind, names in preload.OF_KIND.items() if not names} <= set(stages) - on_workers
    assert {name for names in preload.OF_KIND.values() for name in names} <= set(preload.LIBRARIES)
