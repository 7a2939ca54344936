"""On every case a drift of a parameter by 20 % is found within a stated time; nothing asked to retrain before."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from pipeline.cases import CASES
from serving.monitor import monitor, pace

FILE = Path(__file__).parents[2] / "benchmarks" / "monitor.py"
# Parameter, share, periods within which it is found.
DRIFTS = {
    "thiosulfate_cstr": ("k0", -0.2, 2_000),
    "ph_neutralization": ("q1", 0.2, 1_000),
    "ph_neutralization_15s": ("q1", -0.2, 2_500),
    "henson_seborg_cstr": ("K1", -0.2, 2_000),
    "reversible_cstr": ("k1", -0.2, 4_000),
    "batch_reactor": ("beta1", -0.2, 10 * 50),
    "jacketed_batch_reactor": ("a_c", -0.2, 8 * 2_000),
}


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_of_monitor", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_every_case_is_among_them(benchmark: ModuleType) -> None:
    assert set(DRIFTS) == set(CASES) == set(benchmark.PLANS)


@pytest.mark.parametrize("name", DRIFTS)
def test_a_drift_is_found(benchmark: ModuleType, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is normal is learnt in less time than on a plant, so that a run is short; batches are learnt in full."""
    monkeypatch.setattr(monitor, "LEARN_RESTS", 60)
    monkeypatch.setattr(monitor, "LEARN_MODEL", 6)
    monkeypatch.setattr(monitor, "LEARN_BLOCKS", 10)
    monkeypatch.setattr(monitor, "LEARN_S", 0.0)
    monkeypatch.setattr(pace, "LEARN_S", 0.0)
    parameter, share, within = DRIFTS[name]
    watched = benchmark.learnt(name, seed=7)
    assert [alarm for alarm in watched.alarms if alarm[2] == "retrain"] == []
    assert "watch" not in watched.levels.values()
    assert benchmark.drifted(watched, (parameter, share), within, seed=8) is not None
