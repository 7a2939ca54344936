"""NNARX: regressors, free run and k-step prediction against plain loops."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ModelError, ParamsError, RecordError
from loopwright.pipeline.models import load_model
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.lagged.nnarx_part import NnarxPart, SizeCandidate, parsimonious
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.models.training.objectives import FreeRunWindows, regressor
from loopwright.pipeline.models.training.regressors import longest_run, nnarx_pairs, split_in_time
from loopwright.pipeline.records.record import Record
from loopwright.serving.manifest import Signal


def made_up_record(runs: tuple[int, ...] = (30, 25), n_mv: int = 2, seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(len(runs)), runs)
    n = len(run)
    signals = tuple(Signal(f"u{i}", "1", -2.0, 2.0) for i in range(n_mv))
    return Record(
        1.0,
        (Signal("y", "1", -5.0, 5.0),),
        signals,
        (),
        run,
        np.concatenate([np.arange(m, dtype=float) for m in runs]),
        rng.normal(size=(n, 1)),
        rng.uniform(-1, 1, (n, n_mv)),
        np.zeros((n, 0)),
    )


def model_for(record: Record, n_y: int, n_u: int, delay: int, residual: bool = True) -> NNARX:
    pairs = nnarx_pairs(record, n_y, n_u, delay=delay)
    model = NNARX.scaled_to(pairs.x, pairs.y, n_y=n_y, n_u=n_u, delay=delay, hidden=(5,), residual=residual)
    model.net.reset(torch.Generator().manual_seed(0))
    return model.eval()


@given(n_y=st.integers(1, 3), n_u=st.integers(1, 3), delay=st.integers(1, 2), steps=st.integers(1, 4))
@settings(max_examples=20, deadline=None)
def test_a_free_run_equals_a_plain_loop(n_y: int, n_u: int, delay: int, steps: int) -> None:
    record = made_up_record()
    model = model_for(record, n_y, n_u, delay)
    cut = model.windows(record, steps)
    predicted, measured = model.free_run(cut)[:, -1], cut.future[:, -1]
    back = max(n_y - 1, n_u + delay - 2)
    starts = record.starts(back + steps) + back
    assert measured == pytest.approx(record.pv[starts + steps, 0])
    for k, value in list(zip(starts, predicted, strict=True))[::9]:
        y = dict(enumerate(record.pv[: k + 1, 0]))
        for t in range(k + 1, k + steps + 1):
            phi = [y[t - i] for i in range(1, n_y + 1)]
            phi += [u[t - delay - i] for u in record.mv.T for i in range(n_u)]
            y[t] = model(torch.tensor(phi, dtype=torch.float64)).item()
        assert value == pytest.approx(y[k + steps], rel=1e-11, abs=1e-12)


def test_one_step_windows_are_the_pairs() -> None:
    record = made_up_record()
    pairs = nnarx_pairs(record, 2, 3, delay=2)
    cut = FreeRunWindows.of(record, 2, 3, 1, delay=2)
    phi = regressor(list(torch.from_numpy(cut.past).unbind(1)), torch.from_numpy(cut.u), 0, n_y=2, n_u=3)
    assert np.array_equal(phi.numpy(), pairs.x)
    assert np.array_equal(cut.future, pairs.y)


def test_free_run_of_a_batch_equals_its_rows() -> None:
    record = made_up_record()
    model = model_for(record, 2, 2, 1)
    cut = model.windows(record, 6)
    past, u = torch.from_numpy(cut.past), torch.from_numpy(cut.u)
    with torch.no_grad():
        rows = torch.stack([model.simulate(past[i], u[i]) for i in range(4)])
        torch.testing.assert_close(model.simulate(past, u)[:4], rows, rtol=1e-12, atol=1e-12)


def test_file_gives_the_same_model(tmp_path: Path) -> None:
    record = made_up_record()
    model = model_for(record, 2, 2, 2)
    model.save(tmp_path / "nnarx.npz")
    again = load_model(tmp_path / "nnarx.npz")
    assert isinstance(again, NNARX)
    assert again.config() == model.config()
    cut = model.windows(record, 3)
    np.testing.assert_array_equal(again.free_run(cut), model.free_run(cut))


def test_wrong_arguments_are_one_clear_line() -> None:
    with pytest.raises(ModelError, match="n_u=0"):
        NNARX(2, 0)
    with pytest.raises(ModelError, match="7 regressor columns"):
        NNARX.scaled_to(np.zeros((5, 7)), np.zeros((5, 1)), n_y=2, n_u=2)
    with pytest.raises(RecordError):
        FreeRunWindows.of(made_up_record((4, 4)), 2, 2, 10)
    with pytest.raises(ModelError, match="windows have shapes"):
        FreeRunWindows(np.zeros((3, 2)), np.zeros((4, 2, 1)), np.zeros((3, 1)))


def linear_record(plant: ThiosulfateCstr, runs: tuple[int, ...] = (800,), order: int = 1, noise: float = 0.0) -> Record:
    """A linear plant of first or second order, moved at random and by noise of its own, from rest in each run."""
    rng = np.random.default_rng(0)
    run = np.repeat(np.arange(len(runs)), runs)
    u = np.repeat(rng.uniform(0, 500, len(run) // 4 + 1), 4)[: len(run)]
    y = np.zeros(len(u))
    for k in range(len(u) - 1):
        if run[k + 1] == run[k]:
            last = y[k - 1] if k and run[k - 1] == run[k] else 0.0
            y[k + 1] = (0.8 * y[k] if order == 1 else 1.5 * y[k] - 0.7 * last) + 0.2 * u[k] / 500
            y[k + 1] += noise * rng.normal()
    return Record.of(plant.signals, np.column_stack([y, 300 + y]), u[:, None], run=run)


@pytest.mark.parametrize("runs", [(800,), (40,) * 20])
def test_part_learns_from_a_record_one_step_and_free_run(runs: tuple[int, ...]) -> None:
    """A linear first-order plant is learnt to rounding of the noise-free data, and runs free as well."""
    plant = ThiosulfateCstr()
    part = NnarxPart(n_y=1, n_u=1, hidden=(4,), steps=5, trainer={"kind": "lm", "iterations": 60})
    learnt = part.learn(Source(linear_record(plant, runs), plant.signals))
    assert learnt.metrics["fit_percent"] > 99
    assert learnt.metrics["free_run_rmse"] < 0.01
    assert learnt.metrics["n_train"] == 560
    assert learnt.predictions is not None
    assert set(learnt.predictions) == {"time_s", "measured", *learnt.metrics["one_step"]}


def test_search_takes_the_lags_that_the_plant_has() -> None:
    """A plant of second order: one lag cannot run free, three lags are larger than two and no better."""
    plant = ThiosulfateCstr()
    search = [{"n_y": 1}, {"n_y": 2}, {"n_y": 3, "hidden": [6]}]
    options = {"n_u": 1, "hidden": [3], "trainer": {"kind": "lm", "iterations": 80}, "search": search}
    learnt = parse(NnarxPart, options, "nnarx").learn(Source(linear_record(plant, order=2, noise=0.01), plant.signals))
    rows = learnt.metrics["candidates"]
    assert [r["chosen"] for r in rows] == [False, True, False]
    assert isinstance(learnt.model, NNARX)
    assert (learnt.model.n_y, learnt.model.n_u, learnt.model.net.hidden) == (2, 1, (3,))
    assert rows[0]["free_run_rmse"] > 2 * rows[1]["free_run_rmse"]
    assert learnt.metrics["free_run_rmse"] == rows[1]["free_run_rmse"]
    assert rows[1]["parameters"] == sum(p.numel() for p in learnt.model.parameters())
    assert json.dumps(learnt.metrics)


def test_search_says_what_a_size_may_be() -> None:
    with pytest.raises(ParamsError, match=r"nnarx.search\[1\]: unknown key 'n_x'; did you mean"):
        parse(NnarxPart, {"search": [{"n_y": 1}, {"n_x": 2}]}, "nnarx")


def candidate(parameters: int, free_run_rmse: float) -> SizeCandidate:
    return SizeCandidate(1, 1, (1,), parameters, 0.0, free_run_rmse)


@given(st.lists(st.tuples(st.integers(1, 5), st.floats(0.01, 10.0)), min_size=1, max_size=8))
def test_the_smallest_of_the_nearly_best_stays(rows: list[tuple[int, float]]) -> None:
    found = parsimonious([candidate(*row) for row in rows])
    limit = 1.05 * min(error for _, error in rows)
    assert rows[found][1] <= limit
    assert all(row >= rows[found] for row in rows if row[1] <= limit)


def test_a_search_needs_candidates() -> None:
    with pytest.raises(ModelError, match="no candidates"):
        parsimonious([])


@given(runs=st.lists(st.integers(1, 40), min_size=1, max_size=12), fraction=st.floats(0.1, 0.9))
def test_a_split_in_time_loses_no_row_and_cuts_no_short_run(runs: list[int], fraction: float) -> None:
    record = made_up_record(tuple(runs))
    n = len(record)
    if round(fraction * n) in (0, n):
        with pytest.raises(RecordError, match="record more samples"):
            split_in_time(record, fraction)
        return
    before, after = split_in_time(record, fraction)
    assert np.array_equal(np.concatenate([before.pv, after.pv]), record.pv)
    assert np.array_equal(np.concatenate([before.time_s, after.time_s]), record.time_s)
    assert len(before)
    assert len(after)
    cut = len(before)
    if before.run[-1] == after.run[0]:  # inside a run: no boundary was near
        ends = np.cumsum(runs)[:-1]
        assert cut == round(fraction * n)
        assert not (np.abs(ends - cut) <= 0.1 * n).any()
    else:
        assert abs(cut - fraction * n) <= 0.1 * n + 0.5


def test_a_fraction_of_one_leaves_nothing_to_validate() -> None:
    with pytest.raises(ParamsError, match="training fraction is 1"):
        split_in_time(made_up_record(), 1.0)


def test_the_longest_run_and_no_more_than_asked() -> None:
    record = made_up_record((5, 9, 7))
    assert np.array_equal(longest_run(record, 100).pv, record.pv[5:14])
    assert np.array_equal(longest_run(record, 4).pv, record.pv[5:9])


def test_models_of_other_lags_are_compared_over_the_same_windows() -> None:
    record = made_up_record()
    wide, narrow = FreeRunWindows.of(record, 3, 3, 4), FreeRunWindows.of(record, 1, 1, 4, least_back=2)
    assert np.array_equal(wide.future, narrow.future)
    assert np.array_equal(wide.past[:, -1:], narrow.past)
    assert np.array_equal(wide.u[:, 2:], narrow.u)
    few = FreeRunWindows.of(record, 3, 3, 4, every=3)
    assert np.array_equal(few.future, wide.future[::3])
