"""Scaled records: scales, shifts by dead times that stay in their runs, stretches and folds."""

from __future__ import annotations

from dataclasses import replace

import made_plants
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales, folds


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
