"""What a record leaves open: errors of gain, speed and dead time, and the colour of the noise."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.models.identified.parameter_uncertainty import MOST_COLOUR, colour_of, doubt_of
from loopwright.pipeline.plants.noise import coloured


def answer(gain: float, pole: float, dead: int, length: int = 200) -> np.ndarray:
    """Step response (length,) of a lag."""
    k = np.maximum(np.arange(1, length + 1) - dead, 0)
    return gain * (1 - pole**k)


def test_spreads_of_gain_speed_and_dead_time_are_told_apart() -> None:
    gains, taus, deads = [1.8, 2.0, 2.2], [18.0, 20.0, 22.0], [2, 3, 4]
    members = [answer(g, np.exp(-1 / t), d) for g, t, d in zip(gains, taus, deads, strict=True)]
    found = doubt_of(np.array(members)[:, None, :, None], 1)
    assert found.gain == pytest.approx([0.1], rel=0.02)
    assert found.pace == pytest.approx([0.1], rel=0.05)
    assert found.dead == pytest.approx([1.0 + 0.1 * 20 * 0.105], rel=0.1)  # a tenth of the answer comes later, too


def test_the_output_counts_that_an_mv_moves_most() -> None:
    strong = [answer(g, 0.9, 0) for g in (2.0, 2.1)]
    weak = [answer(g, 0.9, 0) for g in (0.01, -0.01)]  # its gain is anybody's guess
    found = doubt_of(np.stack([strong, weak], axis=-1)[:, None], 1)
    assert found.gain == pytest.approx([0.0345], rel=0.01)


def test_an_answer_that_goes_on_counts_as_far_as_a_law_looks() -> None:
    """Growth in 4,000 rows: poles about 1 made 696 % of 15 %, and a law that held was withheld on a plant gone so."""
    k = np.arange(1, 901)
    members = [answer(g, 0.9, 0, 900) * r**k + 0.002 * k for g, r in ((0.9, 1.002), (1.0, 1.0), (1.1, 0.998))]
    found = doubt_of(np.array(members)[:, None, :, None], 1)
    assert found.gain[0] < 0.1
    assert found.pace[0] < 0.2
    assert found.dead[0] < 1.0


def test_one_member_of_many_decides_nothing() -> None:
    """A closed-loop record of 4,000 rows: the model erred by 9 %, one drawn pole beyond 1 made the gain 3,000 times."""
    gains = np.random.default_rng(0).normal(1.0, 0.1, 19)
    members = [answer(g, 0.9, 3) for g in gains]
    alone = doubt_of(np.array(members)[:, None, :, None], 1)
    assert alone.gain[0] == pytest.approx(gains.std(ddof=1), rel=0.35)
    assert alone.gain[0] <= gains.std(ddof=1) * 1.01
    k = np.arange(1, 201)
    members.append(0.001 * 1.05**k)
    found = doubt_of(np.array(members)[:, None, :, None], 1)
    assert found.gain == pytest.approx(alone.gain, rel=0.3)
    assert found.pace[0] < alone.pace[0] + 0.2


def test_a_single_model_and_an_mv_without_effect_leave_nothing_open() -> None:
    assert doubt_of(answer(1.0, 0.9, 0)[None, None, :, None], 1).gain == [0.0]
    still = doubt_of(np.zeros((3, 1, 50, 1)), 1)
    assert (still.gain, still.pace, still.dead) == ([0.0], [0.0], [0.0])


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8])
def test_the_colour_of_noise_is_found_under_slow_errors_of_the_model(phi: float) -> None:
    rng, n = np.random.default_rng(3), 20_000
    noise = coloured(rng.standard_normal((n, 1)), np.array([phi]))
    slow = 0.5 * np.sin(2 * np.pi * np.arange(n) / 2000)[:, None]
    assert colour_of([noise + slow]) == pytest.approx([phi], abs=0.03)


def test_drift_is_no_colour_beyond_what_the_residual_holds() -> None:
    walk = np.cumsum(np.random.default_rng(0).standard_normal((5000, 1)), axis=0)
    assert 0.9 < colour_of([walk])[0] <= MOST_COLOUR
    assert colour_of([np.zeros((50, 2))]).tolist() == [0.0, 0.0]


def test_the_output_that_is_moved_most_is_sought_over_the_rows_that_count() -> None:
    """A slow pole moves another output most in the end, by any size; over the first rows that one hardly answers."""
    rng, k = np.random.default_rng(4), np.arange(300.0)
    known = (1 - 0.9**k) * (1 + 0.05 * rng.normal(size=(16, 1)))
    slow = 0.02 * k * rng.normal(1.0, 0.8, size=(16, 1))
    late = np.clip(k - 60, 0, None) * slow + 0.01 * rng.normal(size=(16, 1)) * k / 60
    found = doubt_of(np.stack([known + late / 50, late], axis=-1)[:, None], 1)
    assert found.gain[0] < 0.1
    assert found.pace[0] < 0.1
    assert found.dead[0] < 1
