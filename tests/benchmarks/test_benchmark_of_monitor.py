"""On every case a drift of a parameter by 20 % is found, and nothing asked to retrain before it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from pipeline.cases import CASES
from serving.monitor import monitor

FILE = Path(__file__).parents[2] / "benchmarks" / "monitor.py"
# Parameter, share, periods of the run (the drift comes in its middle), periods within which it is found.
DRIFTS = {
    "thiosulfate_cstr": ("k0", -0.2, 16_000, 500),
    "ph_neutralization": ("q1", 0.2, 6_000, 200),
    "ph_neutralization_15s": ("q1", -0.2, 8_000, 500),
    "henson_seborg_cstr": ("K1", -0.2, 30_000, 6_000),
    "reversible_cstr": ("k1", -0.2, 24_000, 4_000),
    "batch_reactor": ("beta1", -0.2, 6_000, 1_500),
    "jacketed_batch_reactor": ("a_w", -0.2, 40_000, 20_000),
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
    """What is normal is learnt in less time than on a plant, so that a run is short."""
    monkeypatch.setattr(monitor, "LEARN_RESTS", {"henson_seborg_cstr": 12, "reversible_cstr": 40}.get(name, 120))
    monkeypatch.setattr(monitor, "LEARN_BLOCKS", 8)
    parameter, share, periods, within = DRIFTS[name]
    found = benchmark.run(name, periods, (parameter, share), seed=7)
    # Before it at most a load that was seen: nothing that asks to retrain.
    assert [alarm for alarm in found.alarms if alarm[0] < 0 and alarm[2] == "retrain"] == []
    after = [alarm for alarm in found.alarms if alarm[0] >= 0]
    assert after
    assert after[0][0] <= within
