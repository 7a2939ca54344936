"""A level integrates: its rate is told in place of a gain, and its level may wander by loads that are measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dirty_plant import Clean, screen_of, steps

from loopwright.pipeline.historian.arx_model import believed
from loopwright.pipeline.historian.cleaning.tags import Tag
from loopwright.pipeline.historian.screening import Screened
from loopwright.pipeline.report.screening import sayings

RATE = 0.02  # a row, of the level by the valve
PERIOD_S = 10.0
TAGS = (Tag("TIC-101.PV", "pv", "m"), Tag("TIC-101.OP", "mv", "%"), Tag("FI-7", "dv", "t/h"))


def level(n: int = 3000, noise: float = 0.3, load: float = 0.0, pole: float = 1.0) -> Clean:
    """x(k+1) = pole x + RATE (u(k-3) - d(k)) + load; an operator brings the level back at each move of u."""
    random = np.random.default_rng(4)
    flow, u, y, x, hidden = steps(random, n, 40, 60), np.zeros(n), np.zeros(n), 0.0, 0.0
    left = 0
    for k in range(n):
        y[k] = 50 + x + noise * random.standard_normal()
        if left == 0:
            left, now = int(random.integers(10, 50)), flow[k] + random.uniform(-12, 12) - 0.5 * x
        u[k], left = round(min(max(now, 0.0), 100.0), 1), left - 1
        hidden = 0.98 * hidden + 0.2 * random.standard_normal()
        x = pole * x + RATE * (u[max(k - 3, 0)] - flow[k]) + load * hidden
    return Clean(1_709_532_000.0 + PERIOD_S * np.arange(n), y.round(3), u, flow.round(2))


def lines(found: Screened) -> str:
    return "\n".join(sayings(found.report.verdict, {t.name: t.unit for t in found.report.tags}))


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_a_level_has_a_rate_and_no_gain(noise: float, tmp_path: Path) -> None:
    found = screen_of(level(noise=noise), tmp_path, TAGS)
    valve, flow = found.report.verdict.inputs
    assert valve.rate["TIC-101.PV"] == pytest.approx(RATE * 60 / PERIOD_S, rel=0.05)
    assert flow.rate["TIC-101.PV"] == pytest.approx(-RATE * 60 / PERIOD_S, rel=0.05)
    assert valve.gain["TIC-101.PV"] == 0.0
    assert valve.settling_s == 0.0
    assert "integrates: 0.1" in lines(found)
    assert "[m] per [%] and minute" in lines(found)
    assert "gain" not in lines(found)


def test_under_a_controller_a_level_may_be_a_plant_that_settles_slowly(tmp_path: Path) -> None:
    verdict = screen_of(level(), tmp_path, TAGS).report.verdict
    valve, flow = verdict.inputs
    held = replace(verdict, inputs=(replace(valve, against=("TIC-101.PV",)), replace(flow, against=())))
    by_valve, by_flow = sayings(held, {})
    assert "or settles slowly" in by_valve
    assert "or settles slowly" not in by_flow


def test_a_level_with_its_loads_measured_does_not_wander(tmp_path: Path) -> None:
    found = screen_of(level(), tmp_path, TAGS)
    assert "drift" not in {f.kind for f in found.report.findings}, found.report.findings


@pytest.mark.parametrize(
    ("load", "words"), [(0.05, "integrates, and its inputs do not explain"), (0.1, "integrates"), (0.3, "wanders")]
)
def test_a_load_that_nobody_measures_moves_a_level(load: float, words: str, tmp_path: Path) -> None:
    found = screen_of(level(load=load), tmp_path, TAGS)
    named = [f.words for f in found.report.findings if f.kind == "drift"]
    assert len(named) == 1
    assert named[0].startswith(words)


@pytest.mark.parametrize("pole", [0.9, 0.99])
def test_a_slow_plant_that_rests_has_a_gain(pole: float, tmp_path: Path) -> None:
    found = screen_of(level(pole=pole, noise=0.05), tmp_path, TAGS)
    (valve, _) = found.report.verdict.inputs
    assert not valve.rate
    assert valve.gain["TIC-101.PV"] == pytest.approx(RATE / (1 - pole), rel=0.15)


def fading(seed: int, last: float) -> tuple[np.ndarray, np.ndarray]:
    """(y, u) (6000,) of a cooler: a gain that falls with the valve, three lags, and a load that wanders.

    All of the answer is ``last`` times as large in the last row as in the first one.
    """
    random, n = np.random.default_rng(seed), 6000
    holds = random.integers(20, 150, n)
    u = np.repeat(random.uniform(15, 85, n), holds)[:n].round(1)
    y, load, lags = np.zeros(n), 0.0, np.zeros(3)
    for k in range(n):
        y[k] = lags[2] + 0.3 * random.standard_normal()
        load = 0.995 * load + 0.27 * random.standard_normal()
        w = u[max(k - 5, 0)] / 100
        steady = load - 80 * (1 + (last - 1) * k / n) * w / (w + 0.35)
        lags += (np.array([steady, *lags[:2]]) - lags) * [0.08, 0.18, 0.28]
    return y, u


@pytest.mark.parametrize("last", [1.0, 0.6, 0.5])
@pytest.mark.parametrize("seed", range(4))
def test_a_gain_that_changes_in_the_record_is_no_integrator(seed: int, last: float) -> None:
    y, u = fading(seed, last)
    model = believed(y, [u], np.zeros(len(y), dtype=np.int64))
    assert model is not None
    assert not model.integrates
    assert -0.9 < model.step_response(0)[-1] < -0.2
