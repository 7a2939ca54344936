"""On every case a drift of a parameter by 20 % is found within a stated time; nothing asked to retrain before.

Two cases of different kinds are looked at with every change, all of them with a release.
"""

from __future__ import annotations

import pytest
from benchmark_modules import benchmark_script

from loopwright.pipeline.cases import CASES
from loopwright.serving.monitor import cusum, monitor

# Of a chart. Fewer than 12 that are independent make it learn four times as long, as here the 10 of the first case do:
# after 14 blocks of it another verdict would come first.
BLOCKS = {"thiosulfate_cstr": 10}
# Of what differs from the run before, but for the drift: set points and noise. The first is also looked at without it.
SEEDS: dict[str, tuple[int, ...]] = {"ph_neutralization_15s": (8, 9, 10, 11)}
# Parameter, share, the verdicts that tell it, periods within which one does. With less buffer the loop of 15 s
# misses its set points and moves its MV more, and both charts see it in the same blocks: the noise says which is first.
DRIFTS = {
    "thiosulfate_cstr": ("k0", -0.2, ("T_j at rest",), 1_000),
    "ph_neutralization": ("q1", 0.2, ("q3 moves",), 200),
    "ph_neutralization_15s": ("q1", -0.2, ("error of pH", "q3 moves"), 500),
    "henson_seborg_cstr": ("K1", -0.2, ("q_c at rest",), 500),
    "reversible_cstr": ("k1", -0.2, ("F at rest",), 1_000),
    "batch_reactor": ("beta1", -0.2, ("load_u over a batch",), 7 * 50),
    "jacketed_batch_reactor": ("a_c", -0.2, ("mode over a batch",), 4 * 2_000),
}


def assert_found_and_quiet_without(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is normal is learnt in less time than on a plant, so that a run is short; batches are learnt in full."""
    monkeypatch.setattr(monitor, "LEARN_RESTS", 60)
    monkeypatch.setattr(monitor, "LEARN_MODEL", 6)
    monkeypatch.setattr(monitor, "LEARN_BLOCKS", BLOCKS.get(name, 14))
    monkeypatch.setattr(cusum, "FINE_S", 0.0)
    monkeypatch.setattr(cusum, "LEARN_S", 0.0)
    # Looking takes a quarter of the time where it is done at every scan.
    monkeypatch.setattr(benchmark_script("monitor"), "LOOK_S", 10 * CASES[name].plant.period_s)
    parameter, share, verdicts, within = DRIFTS[name]
    watched = benchmark_script("monitor").learnt(name, seed=7)
    assert [alarm for alarm in watched.alarms if alarm[2] == "retrain"] == []
    assert "watch" not in watched.levels.values()
    seeds = SEEDS.get(name, (8,))
    for seed in seeds:
        found = benchmark_script("monitor").drifted(watched, (parameter, share), within, seed=seed)
        assert found, f"seed {seed}: not within {within} periods"
        assert {name for _, name, *_ in found} & set(verdicts), found
    assert benchmark_script("monitor").drifted(watched, (parameter, 0.0), within, seed=seeds[0]) == []
