"""A drift does not pass for a slow answer: gain and settling are those beside it, or are said to be unreliable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dirty_plant import PERIOD_S, Clean, clean, screen_of
from scipy.signal import lfilter

from loopwright.pipeline.historian.cleaning.findings import InputReport
from loopwright.pipeline.historian.drift import Jump, jump_of, levels_of
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.report.screening import sayings

N = 4000
ALONG = np.linspace(0.0, 1.0, N)
SETTLES_S = 25 * PERIOD_S  # 0.9^22 = 0.1, behind a dead time of two rows


def slow_plant(drift: np.ndarray) -> Clean:
    """A lag of 100 rows, moved every 10 to 60."""
    data = clean(N)
    y = np.full(N, 50.0)
    for k in range(N - 1):
        y[k + 1] = y[k] + 0.01 * (20 + 0.8 * data.mv[k] - y[k])
    noise = np.random.default_rng(1).normal(0, 0.1, N)
    return data.with_(pv=(y + drift + noise).round(3))


def valve_of(found: Screened) -> InputReport:
    return found.report.verdict.inputs[0]


@pytest.mark.parametrize("drift", [15 * ALONG, 5 * np.sin(25 * ALONG), -20 * ALONG**2], ids=["ramp", "wave", "curve"])
def test_gain_and_settling_are_those_beside_a_drift(drift: np.ndarray, tmp_path: Path) -> None:
    data = clean(N)
    found = screen_of(data.with_(pv=data.pv + drift), tmp_path)
    assert "drift" in {f.kind for f in found.report.findings}
    assert valve_of(found).gain["TIC-101.PV"] == pytest.approx(0.8, rel=0.05)
    assert valve_of(found).settling_s == pytest.approx(SETTLES_S, rel=0.2)
    assert found.report.verdict.unsure == ()


def test_a_drift_beside_a_slow_plant_makes_its_figures_unreliable(tmp_path: Path) -> None:
    found = screen_of(slow_plant(10 * ALONG), tmp_path)
    verdict = found.report.verdict
    assert verdict.unsure == ("TIC-101.PV",)
    assert verdict.carries == "doubtful"
    assert "unreliable: drift" in " ".join(verdict.reasons)
    assert "gain and settling unreliable: drift" in "\n".join(sayings(verdict, {}))


def test_a_slow_plant_without_a_drift_is_not_doubted(tmp_path: Path) -> None:
    assert screen_of(slow_plant(0 * ALONG), tmp_path).report.verdict.unsure == ()


def test_a_load_that_wanders_is_no_jump_and_a_jump_beside_it_is_one() -> None:
    """Of records of 3,000 rows, whose load returns within 1,000."""
    random, found = np.random.default_rng(0), list[Jump | None]()
    for _ in range(30):
        explained = np.cumsum(random.random(3000) < 0.01) % 2 * 2.0 - 1
        load = np.asarray(lfilter([np.sqrt(1 - 0.999**2)], [1, -0.999], random.normal(0, 1, 3000)), dtype=np.float64)
        noise, row = random.normal(0, 0.1, 3000), int(random.integers(800, 2200))
        for more in (0.7 * load, 0.15 * load + (np.arange(3000) > row)):
            levels = levels_of(explained + more + noise, explained, 4.0, 60)
            assert levels is not None
            found.append(jump_of(levels))
    assert found[::2].count(None) >= 26
    jumps = [jump for jump in found[1::2] if jump is not None]
    assert len(jumps) >= 29
    assert np.median([jump.size for jump in jumps]) == pytest.approx(1.0, abs=0.1)
