"""Training pairs: their rows are the record's, none reaches over a run's end, none leaks through a split."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import ParamsError, RecordError
from loopwright.pipeline.models.training.regressors import Pairs, forward_pairs, inverse_pairs, nnarx_pairs
from loopwright.pipeline.records.record import Record, position_in_run
from loopwright.serving.manifest import Signal

PV = (Signal("y", "m", 0.0, 1e4), Signal("z", "m", 0.0, 1e4))
MV = (Signal("u", "V", 0.0, 1e4), Signal("v", "V", 0.0, 1e4))


def make(runs: list[int], hold: int = 1) -> Record:
    """Every cell tells its row: y = k, z = 1000 + k, and u = 2000 + k, v = 3000 + k of the first row of its hold."""
    run = np.repeat(np.arange(len(runs)), runs)
    position = position_in_run(run)
    k = np.arange(len(run), dtype=np.float64)
    level = k - position % hold
    pv, mv = np.column_stack([k, 1000 + k]), np.column_stack([2000 + level, 3000 + level])
    return Record(1.0, PV, MV, (), run, position * 1.0, pv, mv, np.empty((len(run), 0)))


runs = st.lists(st.integers(1, 9), min_size=1, max_size=6)


@settings(max_examples=80, deadline=None)
@given(runs=runs, hold=st.integers(1, 4), horizon=st.integers(1, 4))
def test_pairs_over_a_horizon(runs, hold, horizon):
    record = make(runs, hold)
    wanted = [
        k
        for k in range(len(record) - horizon)
        if record.run[k] == record.run[k + horizon] and len({*record.mv[k : k + horizon, 0]}) == 1
    ]
    if not wanted:
        with pytest.raises(RecordError, match=r"too short for the lags|no MV is held"):
            inverse_pairs(record, horizon)
        return
    k = np.array(wanted)
    inverse = inverse_pairs(record, horizon, cv=1)
    assert inverse.row.tolist() == wanted
    assert np.array_equal(inverse.x, np.column_stack([k, 1000 + k, 1000 + k + horizon]))
    assert np.array_equal(inverse.y, record.mv[k])
    forward = forward_pairs(record, horizon, target=1)
    assert forward.row.tolist() == wanted
    assert np.array_equal(forward.x, np.hstack([record.pv[k], record.mv[k]]))
    assert np.array_equal(forward.y[:, 0], 1000 + k + horizon)


@settings(max_examples=80, deadline=None)
@given(runs=runs, n_y=st.integers(1, 3), n_u=st.integers(1, 3), delay=st.integers(1, 3))
def test_nnarx_pairs(runs, n_y, n_u, delay):
    record = make(runs)
    back = max(n_y - 1, n_u + delay - 2)
    if max(runs) < back + 2:
        with pytest.raises(RecordError, match="too short for the lags"):
            nnarx_pairs(record, n_y, n_u, delay=delay)
        return
    pairs = nnarx_pairs(record, n_y, n_u, delay=delay)
    assert len(pairs) == sum(max(n - back - 1, 0) for n in runs)
    assert (record.run[pairs.row - back] == record.run[pairs.row + 1]).all()
    for x, y, k in zip(pairs.x, pairs.y, pairs.row, strict=True):
        lags_u = [k + 1 - delay - i for i in range(n_u)]
        assert x.tolist() == [*(k - i for i in range(n_y)), *(2000 + i for i in lags_u), *(3000 + i for i in lags_u)]
        assert y.tolist() == [k + 1]


def test_newest_mv_of_a_nnarx_acts_on_its_target():
    pairs = nnarx_pairs(make([6]), n_y=2, n_u=2)
    assert pairs.x[0].tolist() == [1.0, 0.0, 2001.0, 2000.0, 3001.0, 3000.0]
    assert pairs.y[0].tolist() == [2.0]


@settings(max_examples=80, deadline=None)
@given(runs=st.lists(st.integers(6, 20), min_size=1, max_size=5), fraction=st.floats(0.3, 0.8), n_y=st.integers(1, 3))
def test_split_in_time_shares_no_row(runs, fraction, n_y):
    pairs = nnarx_pairs(make(runs), n_y, 1)
    try:
        train, validation = pairs.split(fraction, "time")
    except RecordError:
        assert len(pairs) < 20
        return
    assert train.row.max() + train.ahead <= validation.row.min() - validation.back
    assert len(validation) == len(pairs) - round(fraction * len(pairs))
    assert len(train) >= round(fraction * len(pairs)) - n_y
    assert (np.diff(train.row) > 0).all()


def test_split_at_random_is_seeded_and_a_partition():
    pairs = forward_pairs(make([200]))
    a, b, other = (pairs.split(0.7, "random", seed) for seed in (1, 1, 2))
    assert np.array_equal(a[0].row, b[0].row)
    assert not np.array_equal(a[0].row, other[0].row)
    assert len(a[0]) == round(0.7 * len(pairs))
    assert np.array_equal(np.sort(np.r_[a[0].row, a[1].row]), pairs.row)
    for part in a:
        assert np.array_equal(part.x, pairs.x[part.row])
        assert np.array_equal(part.y[:, 0], part.row + 1)


def test_runs_of_two_rows_lose_no_pair_in_a_split():
    pairs = forward_pairs(make([2] * 10))
    train, validation = pairs.split(0.7, "time")
    assert (len(train), len(validation)) == (7, 3)


def test_mistakes_are_named():
    record = make([6])
    with pytest.raises(ParamsError, match="horizon is 0 periods"):
        inverse_pairs(record, 0)
    with pytest.raises(ParamsError, match="n_y=0, n_u=1, delay=1; each must be at least 1"):
        nnarx_pairs(record, 0, 1)
    with pytest.raises(RecordError, match="no MV is held for 3 samples on end"):
        inverse_pairs(record, 3)
    with pytest.raises(RecordError, match="longest run has 6 rows, too short for the lags: they span 8 rows"):
        forward_pairs(record, 7)
    pairs = forward_pairs(record)
    for fraction in (0.0, 1.0, np.nan):
        with pytest.raises(ParamsError, match="training fraction"):
            pairs.split(fraction)
    with pytest.raises(ParamsError, match="must be 'time' or 'random'"):
        pairs.split(0.5, "chance")  # type: ignore[arg-type]
    one = Pairs(pairs.x[:1], pairs.y[:1], pairs.row[:1])
    with pytest.raises(RecordError, match=r"1 pairs split at 0.7 leave 1 for training and 0"):
        one.split(0.7)
