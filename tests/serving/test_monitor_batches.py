"""Batches beside earlier batches: what is found, what is not compared, and what a plant without batches makes of it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from loopwright.serving import Command, Manifest, Mode, Sample, Signal
from loopwright.serving.monitor import Monitor

SP = (Signal("T", "degC", 0.0, 100.0),)
MV = (Signal("u", "%", 0.0, 100.0),)
MANIFEST = Manifest("kettle", "pid", 10.0, SP, SP, (), MV, 0, ("core_offset",), ("sp", "pv", "state"), {}, {})
SCANS = 100


def batches(monitor: Monitor, n: int, seed: int, shift: float = 0.0, end: float = 80.0, scans: int = SCANS) -> None:
    """Batches along a ramp; ``shift`` is what the MV is higher by in their second half."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        load = rng.normal()
        for k in range(scans):
            sp = 20 + (end - 20) * k / scans
            mv = 30 + 0.5 * sp + load + (shift if k > scans / 2 else 0.0) + 0.2 * rng.normal()
            sample = Sample(np.array([sp + 0.3 * rng.normal()]), np.array([mv]))
            info = np.array([0.1 * rng.normal()])
            monitor.observe(0.0, sample, Command(k, Mode.AUTO, np.array([sp]), np.array([mv]), np.array([mv]), info))
        monitor.observe(0.0, None, Command(0, Mode.MANUAL, np.array([20.0]), np.array([0.0]), None, None))


def level(monitor: Monitor, name: str) -> str:
    return next(v.level for v in monitor.verdicts() if v.name == name)


def learnt() -> Monitor:
    monitor = Monitor(MANIFEST, started_s=0.0)
    batches(monitor, 26, seed=0)
    return monitor


def test_a_shift_in_a_part_of_each_batch_is_found_within_six_batches_and_named() -> None:
    monitor = learnt()
    batches(monitor, 60, seed=1)
    assert {v.level for v in monitor.verdicts() if "batch" in v.name or "answer" in v.name} == {"as validated"}
    batches(monitor, 6, seed=2, shift=12.0)
    verdict = next(v for v in monitor.verdicts() if v.name == "u over a batch")
    assert verdict.level == "watch"
    assert "u is" in verdict.text
    assert "% higher than in the first batches" in verdict.text
    assert verdict.value == pytest.approx(12.0, abs=2.0)
    assert level(monitor, "T over a batch") == "as validated"


def test_batches_of_another_recipe_or_length_are_not_compared_until_they_are_the_rule() -> None:
    monitor = learnt()
    batches(monitor, 4, seed=1, end=60.0)
    batches(monitor, 1, seed=2)
    batches(monitor, 4, seed=3, scans=150)
    assert level(monitor, "u over a batch") == "as validated"
    batches(monitor, 1, seed=4)
    batches(monitor, 9, seed=5, end=60.0)
    assert level(monitor, "u over a batch") == "not known yet"
    batches(monitor, 20, seed=6, end=60.0)
    assert level(monitor, "u over a batch") == "as validated"


def test_a_loop_that_is_taken_by_hand_now_and_then_makes_no_batches() -> None:
    monitor = Monitor(MANIFEST, started_s=0.0)
    for k, scans in enumerate((900, 50, 400, 2_000, 120, 700)):
        batches(monitor, 1, seed=k, scans=scans)
    assert not monitor.batches.known
    assert not any("batch" in v.name for v in monitor.verdicts())
    assert any(v.name == "u at rest" and v.level == "not known yet" for v in monitor.verdicts())


def test_in_a_plant_of_batches_nothing_waits_for_a_rest_that_never_comes() -> None:
    assert all(v.level != "not known yet" for v in learnt().verdicts())


def test_a_restart_goes_on_with_the_batches_that_were_learnt() -> None:
    monitor = learnt()
    other = Monitor.restored(MANIFEST, json.loads(json.dumps(monitor.state(), allow_nan=False)))
    for one in (monitor, other):
        batches(one, 6, seed=3, shift=12.0)
    assert [(v.name, v.level) for v in other.verdicts()] == [(v.name, v.level) for v in monitor.verdicts()]
    assert level(other, "u over a batch") == "watch"
