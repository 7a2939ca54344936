"""NNARX: regressors, free run and k-step prediction against plain loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ModelError, RecordError
from pipeline.models import load_model
from pipeline.models.network_parts import NnarxPart
from pipeline.models.nnarx import NNARX
from pipeline.models.objectives import Windows
from pipeline.models.regressors import nnarx_pairs
from pipeline.plants.thiosulfate_cstr import ThiosulfateCstr
from pipeline.record import Record
from serving.manifest import Signal


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
def test_k_step_equals_a_plain_loop(n_y: int, n_u: int, delay: int, steps: int) -> None:
    record = made_up_record()
    model = model_for(record, n_y, n_u, delay)
    predicted, measured = model.k_step(record, steps)
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
    cut = Windows.of(record, 2, 3, 1, delay=2)
    phi = cut._regressor(list(torch.from_numpy(cut.past).unbind(1)), torch.from_numpy(cut.u), 0)
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
    np.testing.assert_array_equal(again.k_step(record, 3)[0], model.k_step(record, 3)[0])


def test_wrong_arguments_are_one_clear_line() -> None:
    with pytest.raises(ModelError, match="n_u=0"):
        NNARX(2, 0)
    with pytest.raises(ModelError, match="7 regressor columns"):
        NNARX.scaled_to(np.zeros((5, 7)), np.zeros((5, 1)), n_y=2, n_u=2)
    with pytest.raises(RecordError):
        Windows.of(made_up_record((4, 4)), 2, 2, 10)
    with pytest.raises(ModelError, match="windows have shapes"):
        Windows(np.zeros((3, 2)), np.zeros((4, 2, 1)), np.zeros((3, 1)))


def test_part_learns_from_a_record_one_step_and_free_run() -> None:
    """A linear first-order plant is learnt to rounding of the noise-free data, and runs free as well."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0, 500, 200), 4)
    y = np.zeros(len(u))
    for k in range(len(u) - 1):
        y[k + 1] = 0.8 * y[k] + 0.2 * u[k] / 500
    plant = ThiosulfateCstr()
    record = Record.of(plant, np.column_stack([y, 300 + y]), u[:, None])
    part = NnarxPart(n_y=1, n_u=1, hidden=(4,), steps=5, trainer={"kind": "lm", "iterations": 60})
    learnt = part.learn(record, plant, {}, 0)
    assert learnt.metrics["fit_percent"] > 99
    assert learnt.metrics["free_run_rmse"] < 0.01
