"""Noise of measured signals, told from what they do, and the level that follows them best."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from loopwright.pipeline.plants.noise import level_gain, levels, noise_and_change

N = 4000


def signals(rng: np.random.Generator) -> dict[str, tuple[np.ndarray, float]]:
    """Signals without noise, and the standard deviation of their changes."""
    walk = np.cumsum(0.1 * rng.normal(size=N))
    steps = np.repeat(rng.uniform(-5, 5, N // 100), 100)
    slow = 8 * np.sin(np.arange(N) / 150)
    return {name: (s, float(np.diff(s).std())) for name, s in {"walk": walk, "steps": steps, "slow": slow}.items()}


@pytest.mark.parametrize("kind", ["walk", "steps", "slow"])
@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_noise_is_told_from_what_the_signal_does(kind: str, noise: float) -> None:
    rng = np.random.default_rng(3)
    clean, change = signals(rng)[kind]
    seen = clean + noise * rng.normal(size=N)
    found = noise_and_change([seen[: N // 2, None], seen[N // 2 :, None]])
    loose = 0.5 if kind == "steps" and noise < change else 0.25
    assert found[0] == pytest.approx([noise], rel=loose)
    # What the record leaves open of the change is no less than one standard error: about noise^2 sqrt(10 / N).
    assert change * 0.7 < found[1][0] < max(1.3 * change, 3 * noise * (10 / N) ** 0.25)


@pytest.mark.parametrize("rows", [60, 400, 4000])
@pytest.mark.parametrize("seed", range(5))
def test_a_level_never_stands_still(rows: int, seed: int) -> None:
    """Of a disturbance that hardly moves: no record shows that it never will."""
    rng = np.random.default_rng(seed)
    seen = np.sin(np.arange(rows) / 900) + 0.5 * rng.normal(size=rows)
    noise, change = noise_and_change([seen[:, None]])
    assert level_gain(noise, change)[0] > 0.15


@pytest.mark.parametrize("kind", ["walk", "steps", "slow"])
def test_a_signal_without_noise_has_none(kind: str) -> None:
    clean, change = signals(np.random.default_rng(5))[kind]
    noise, own = noise_and_change([clean[:, None]])
    assert noise == 0
    assert own == pytest.approx([change], rel=0.02)


def test_a_short_record_and_one_without_disturbances_say_nothing() -> None:
    for found in (noise_and_change([np.zeros((19, 2))]), noise_and_change([np.zeros((3, 2)), np.ones((2, 2))])):
        assert [part.tolist() for part in found] == [[0, 0], [0, 0]]
    assert [part.shape for part in noise_and_change([np.zeros((50, 0))])] == [(0,), (0,)]


@given(noise=st.floats(0.05, 10), change=st.floats(0.05, 10))
def test_the_level_follows_as_the_steady_kalman_filter(noise: float, change: float) -> None:
    one = np.eye(1)
    ahead = solve_discrete_are(one, one, change**2 * one, noise**2 * one)[0, 0]
    assert level_gain(np.array([noise]), np.array([change])) == pytest.approx([ahead / (ahead + noise**2)], rel=1e-6)


def test_a_signal_without_noise_is_its_level() -> None:
    assert level_gain(np.zeros(2), np.array([0.3, 0.0])).tolist() == [1, 1]


@given(noise=st.floats(0.1, 3), change=st.floats(0.1, 3), rows=st.integers(2, 12), seed=st.integers(0, 99))
def test_levels_are_the_likeliest_ones_of_all_rows(noise: float, change: float, rows: int, seed: int) -> None:
    """Least squares of each reading over the noise and of each change over its own."""
    seen = np.random.default_rng(seed).normal(size=rows)
    moves = np.diff(np.eye(rows), axis=0)
    stacked = np.vstack([np.eye(rows) / noise, moves / change])
    wanted = np.linalg.lstsq(stacked, np.r_[seen / noise, np.zeros(rows - 1)], rcond=None)[0]
    found = levels(np.column_stack([seen, seen]), np.array([noise, 0.0]), np.array([change, change]))
    assert found[:, 0] == pytest.approx(wanted, abs=1e-9)
    assert found[:, 1].tolist() == seen.tolist()


def test_a_single_row_is_its_level() -> None:
    assert levels(np.array([[3.0]]), np.ones(1), np.ones(1)).tolist() == [[3.0]]


@pytest.mark.parametrize("kind", ["walk", "steps"])
def test_a_plant_has_the_same_gain_to_the_level_as_to_the_signal(kind: str) -> None:
    """And less to the signal with noise that the plant never felt."""
    rng = np.random.default_rng(11)
    clean, _ = signals(rng)[kind]
    clean = clean - clean.mean()
    y = np.convolve(clean, [0.0, *(0.4 * 0.6 ** np.arange(40))])[:N]
    seen = clean + 0.8 * rng.normal(size=N)

    def gain(of: np.ndarray) -> float:
        past = np.column_stack([of[40 - lag : -lag] for lag in range(1, 40)])
        return float(np.linalg.lstsq(past, y[40:], rcond=None)[0].sum())

    level = levels(seen[:, None], *noise_and_change([seen[:, None]]))[:, 0]
    assert gain(clean) == pytest.approx(1)
    assert abs(gain(level) - 1) < abs(gain(seen) - 1) / 3
