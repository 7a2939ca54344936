"""Scaled records: scales, shifts by dead times that stay in their runs, stretches and folds."""

from __future__ import annotations

from dataclasses import replace

import made_plants
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales, folds, noise_of_disturbances


def test_outputs_have_deviation_one_and_mvs_their_range() -> None:
    record = made_plants.two_by_two(300, measured=True)
    data = ScaledRecord.of(record, Scales.of(record, 2))
    assert data.y.mean(axis=0) == pytest.approx(0, abs=1e-12)
    assert data.y.std(axis=0) == pytest.approx(1)
    assert data.v[:, 0] == pytest.approx(record.mv[:, 0] / 50 - 1)
    assert data.v[:, 2].std() == pytest.approx(0.5)


@given(delays=st.lists(st.integers(0, 30), min_size=1, max_size=1), runs=st.integers(1, 4))
def test_a_shift_takes_no_row_of_another_run(delays: list[int], runs: int) -> None:
    record = made_plants.second_order(80, runs=runs)
    data = ScaledRecord.of(record, Scales.of(record, 1))
    shifted = data.delayed(delays)
    for first, last in data.bounds():
        for k in range(first, last):
            assert shifted.v[k, 0] == data.v[max(k - delays[0], first), 0]


def test_folds_hold_out_the_last_and_the_first_fifth() -> None:
    late, early = folds(made_plants.second_order(1000))
    assert (late.train, late.held) == (slice(0, 800), slice(800, 1000))
    assert (early.train, early.held) == (slice(200, 1000), slice(0, 200))


def test_what_never_moves_is_refused() -> None:
    record = made_plants.second_order(100)
    with pytest.raises(ModelError, match="u0 never change"):
        Scales.of(replace(record, mv=np.full((100, 1), 50.0)), 1)


def test_runs_of_a_few_rows_are_refused() -> None:
    record = made_plants.second_order(500, runs=50)
    with pytest.raises(ModelError, match="needs 12"):
        ScaledRecord.of(record, Scales.of(record, 1)).stretches()


def disturbed(kind: str, rows: int, seed: int, late: int) -> tuple[ScaledRecord, float]:
    """A plant of a lag of four rows with a measured disturbance, and the noise of its reading, scaled."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, rows // 40 + 1), 40)[:rows]
    quick, slow = rng.normal(size=rows), np.cumsum(0.1 * rng.normal(size=rows))
    felt, read = {"noisy": (slow, slow + 0.5 * quick), "quick": (quick, quick), "both": (slow + quick, slow + quick)}[
        kind
    ]
    y, x = np.zeros(rows), np.zeros(2)
    for k in range(1, rows):
        x = x + 0.22 * (np.array([u[k - 1], felt[max(k - 1 - late, 0)]]) - x)
        y[k] = x.sum() + 0.05 * rng.normal()
    scale = 2 * read.std()
    data = ScaledRecord(y[:, None] / y.std(), np.column_stack([u, read / scale]), np.zeros(rows, dtype=np.int64))
    return data, 0.5 / scale if kind == "noisy" else 0.0


@pytest.mark.parametrize("late", [0, 25])
@pytest.mark.parametrize("rows", [600, 3000])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["noisy", "quick", "both"])
def test_the_plant_tells_noise_from_quick_motion(kind: str, rows: int, seed: int, late: int) -> None:
    data, noise = disturbed(kind, rows, seed, late)
    found, change = noise_of_disturbances(data, 1)
    assert found == pytest.approx([noise], rel=0.3)
    if kind != "noisy":
        assert change == pytest.approx([np.sqrt(np.mean(np.diff(data.v[:, 1]) ** 2))], rel=0.01)


def test_levels_stay_in_their_runs_and_leave_mvs_alone() -> None:
    data, _ = disturbed("noisy", 200, 0, 0)
    two = replace(data, run=np.repeat([0, 1], 100))
    apart = [two.rows(slice(i, i + 100)).followed(np.ones(1), np.ones(1)).v for i in (0, 100)]
    both = two.followed(np.ones(1), np.ones(1)).v
    assert np.array_equal(both, np.vstack(apart))
    assert np.array_equal(both[:, 0], data.v[:, 0])
    assert two.followed(np.zeros(1), np.ones(1)) is two
