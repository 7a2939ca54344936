"""Drift inside a record: told from noise and from dynamics that a model lacks; it decides how candidates are judged."""

from __future__ import annotations

import made_plants
import numpy as np

from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.residual_tests import drift_of, error_beyond_drift

MODEL = Dynamics.linear(np.array([[0.9]]), np.array([[0.1]]))
ROWS = 4000


def record(gain: float = 0.0, level: float = 0.0, curve: float = 0.0, periods: int = 1) -> Stretch:
    """The model's answer with a gain and a level that wander, or behind a curved valve; noise of sd .05."""
    rng = np.random.default_rng(0)
    v = made_plants.random_holds(rng, ROWS, 20, -2.0, 2.0)
    x, y, phase = 0.0, np.empty(ROWS), 2 * np.pi * periods * np.arange(ROWS) / ROWS
    for k in range(ROWS):
        y[k] = (1 + gain * np.sin(phase[k])) * x + level * np.cos(phase[k])
        x = 0.9 * x + 0.1 * (v[k] + curve * (v[k] ** 2 - 1))
    return Stretch((y + 0.05 * rng.normal(size=ROWS))[:, None], v[:, None])


def test_a_wandering_gain_or_level_is_drift() -> None:
    assert drift_of(MODEL, [record(gain=0.4)]).share > 0.7
    assert drift_of(MODEL, [record(level=0.3)]).share > 0.7
    assert drift_of(MODEL, [record(gain=0.4)]).found


def test_quick_drift_is_found_over_shorter_parts() -> None:
    slow, quick = drift_of(MODEL, [record(gain=0.4)]), drift_of(MODEL, [record(gain=0.4, periods=6)])
    assert quick.found
    assert quick.rows < slow.rows


def test_a_gain_that_is_wrong_all_along_is_not() -> None:
    wrong = Dynamics.linear(MODEL.a, 2 * MODEL.b)
    assert drift_of(wrong, [record()]).share == 0


def test_noise_and_a_missing_curve_are_not() -> None:
    assert drift_of(MODEL, [record()]).share == 0
    assert drift_of(MODEL, [record(curve=0.4)]).share < 0.3
    assert not drift_of(MODEL, [record(curve=0.4)]).found


def test_the_error_beyond_drift_is_that_of_the_dynamics() -> None:
    wandering, curved = record(gain=0.4, level=0.3), record(curve=0.4)
    assert error_beyond_drift(MODEL, [wandering], ROWS // 40) < 1.5 * 0.05
    assert error_beyond_drift(MODEL, [curved], ROWS // 40) > 3 * 0.05
    twice = Dynamics.linear(MODEL.a, 2 * MODEL.b)
    assert error_beyond_drift(twice, [wandering], ROWS // 40) < 1.5 * 0.05


def test_a_run_that_explodes_shows_nothing() -> None:
    assert not drift_of(Dynamics.linear(np.array([[1.5]]), np.array([[0.1]])), [record()]).found
