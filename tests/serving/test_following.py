"""A read-back that stands while the command moves is told; a slow, coarse or sticky actuator is none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from loopwright.serving import Controller, ControlLoop, Mode, Sample, Signal
from loopwright.serving.monitor import Monitor
from loopwright.serving.monitor.actuator_checks import Following

pytest_plugins = ["small_laws"]


def follow(actuator: Callable[[int, float], float], law: Callable[[int, float], float], n: int, error: float) -> bool:
    """Whether a read-back counts as stuck at any of ``n`` scans; MV of 0 .. 100, patience of 20 scans."""
    following, mv = Following([Signal("u", "%", 0.0, 100.0)], 20), 50.0
    found = False
    for k in range(n):
        applied = actuator(k, mv)
        following.add(np.array([applied]), np.array([mv]), error, float(k))
        mv = min(max(law(k, applied), 0.0), 100.0)
        found = found or following.stuck(0)
    return found


class Slow:
    """An actuator that goes ``rate`` a scan, not for less than ``deadband``, read back in steps of ``resolution``."""

    def __init__(self, rate: float, deadband: float = 0.0, resolution: float = 1e-9, offset: float = 0.0) -> None:
        self.rate, self.deadband, self.resolution, self.offset, self.at = rate, deadband, resolution, offset, 50.0

    def __call__(self, _: int, asked: float) -> float:
        move = asked - self.at
        self.at += min(max(move, -self.rate), self.rate) if abs(move) > self.deadband else 0.0
        return round(self.at / self.resolution) * self.resolution + self.offset


def steps(k: int, _: float) -> float:
    """A law that commands a position: another one every 50 scans."""
    return 30.0 + 40.0 * (k // 50 % 2)


def test_a_read_back_that_stands_while_the_command_moves_is_told() -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, 500).tolist()
    assert follow(lambda k, _: 50.0 + noise[k], steps, 500, 0.0)
    assert follow(lambda k, _: 50.0, lambda _, applied: applied + 0.65, 100, 0.3)  # a law that adds to the applied MV
    assert not follow(lambda k, _: 50.0, lambda _, applied: applied + 0.65, 40, 0.3)


@pytest.mark.parametrize(
    "kind",
    [
        {"rate": 100.0},
        {"rate": 0.5},
        {"rate": 0.1, "resolution": 1.0},
        {"rate": 100.0, "deadband": 2.0, "resolution": 1.0},
        {"rate": 5.0, "offset": 1.5},
    ],
)
@pytest.mark.parametrize("error", [0.0, 0.3])
def test_a_slow_coarse_or_sticky_actuator_is_not_stuck(kind: dict[str, float], error: float) -> None:
    noise = np.random.default_rng(1).normal(0, 0.3, 1000).tolist()
    assert not follow(Slow(**kind), steps, 500, error)
    assert not follow(Slow(**kind), lambda k, _: 50.0 + noise[k], 500, 0.02)  # at rest
    assert not follow(Slow(**kind), lambda k, _: 50.0 + 0.05 * k, 500, 0.0)  # a slow ramp


def test_a_stuck_actuator_is_an_alarm_and_one_that_follows_is_none(controller: Controller) -> None:
    """A whole loop: PI on a plant whose valve stands from some scan on."""
    for stuck, level in ((False, "as validated"), (True, "watch")):
        monitor, loop = (
            Monitor(controller.manifest, started_s=0.0),
            ControlLoop(controller, sp=1.0, mv=50.0, mode=Mode.AUTO, guards=()),
        )
        valve, height = 50.0, 0.5
        for k in range(3 * monitor.settle):
            sample = Sample(np.array([height, 300.0]), np.array([valve]), np.zeros(1))
            command = loop.scan(sample)
            monitor.observe(float(k), sample, command)
            valve = valve if stuck else float(command.mv[0])
            height += 0.1 * (valve / 100 - height)
        (verdict,) = [v for v in monitor.verdicts() if v.name == "valve read back"]
        assert verdict.level == level
