"""ARX: least squares against systems whose coefficients are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.errors import ModelError, ParamsError
from loopwright.pipeline.models import MODELS, load_model
from loopwright.pipeline.models.lagged.lagged import ARX, ArxPart
from loopwright.pipeline.models.part import Source
from loopwright.pipeline.models.training.regressors import nnarx_pairs
from loopwright.pipeline.records.record import Record


def linear_record(noise: float = 0.0, samples: int = 800) -> Record:
    """y(t) = 0.1 + 1.2 y(t-1) - 0.4 y(t-2) + 0.002 u(t-1) - 0.0005 u(t-2), plus noise of the equation."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0, 500, samples // 4), 4)
    y = np.full(len(u), 0.5)
    for k in range(1, len(u) - 1):
        y[k + 1] = 0.1 + 1.2 * y[k] - 0.4 * y[k - 1] + 0.002 * u[k] - 0.0005 * u[k - 1] + noise * rng.normal()
    return Record.of(ThiosulfateCstr().signals, np.column_stack([y, 300 + y]), u[:, None])


def test_exact_data_give_the_exact_coefficients(tmp_path: Path) -> None:
    record = linear_record()
    learnt = ArxPart().learn(Source(record, ThiosulfateCstr().signals))
    model = learnt.model
    assert isinstance(model, ARX)
    np.testing.assert_allclose(model.weight.numpy(), [1.2, -0.4, 0.002, -0.0005], rtol=1e-9)
    assert model.bias.item() == pytest.approx(0.1, rel=1e-9)
    assert learnt.metrics["rmse"] < 1e-11
    assert learnt.metrics["free_run_rmse"] < 1e-10
    assert learnt.metrics["r2"] == pytest.approx(1.0)
    cut = model.windows(record, 25)
    np.testing.assert_allclose(model.free_run(cut), cut.future, atol=1e-10)
    model.save(tmp_path / "arx.npz")
    again = load_model(tmp_path / "arx.npz")
    assert again.config() == model.config()
    x = torch.from_numpy(nnarx_pairs(record, 2, 2).x)
    assert torch.equal(again(x), model(x))


def test_noisy_data_leave_a_residual_orthogonal_to_the_regressors() -> None:
    pairs = nnarx_pairs(linear_record(noise=0.02), 2, 2)
    model = ARX.fit(pairs.x, pairs.y, n_y=2, n_u=2)
    residual = pairs.y - model(torch.from_numpy(pairs.x)).numpy()
    moments = np.column_stack([pairs.x, np.ones(len(pairs))]).T @ residual[:, 0]
    assert np.abs(moments / np.abs(pairs.x).sum(axis=0).max()).max() < 1e-12
    assert residual.std() == pytest.approx(0.02, rel=0.1)


def test_part_is_known_by_its_kind_and_learns_another_target() -> None:
    assert MODELS["arx"] is ArxPart
    model = ArxPart(target="T").learn(Source(linear_record(), ThiosulfateCstr().signals)).model
    assert isinstance(model, ARX)
    assert model.bias.item() == pytest.approx(0.1 + 300 * 0.2, rel=1e-6)
    with pytest.raises(ParamsError, match="process variable"):
        ArxPart(target="pressure").learn(Source(linear_record(), ThiosulfateCstr().signals))


def test_what_the_data_do_not_determine_is_said() -> None:
    with pytest.raises(ModelError, match="learns from a record"):
        ArxPart().learn(Source(None, ThiosulfateCstr().signals))
    with pytest.raises(ModelError, match="n_u=0"):
        ARX(2, 0)
    with pytest.raises(ModelError, match="7 regressor columns"):
        ARX.fit(np.zeros((5, 7)), np.zeros((5, 1)), n_y=2, n_u=2)
    x = np.random.default_rng(0).normal(size=(50, 5))
    x[:, 3] = x[:, 4] = x[:, 2]
    with pytest.raises(ModelError, match="determine 4 of 6"):
        ARX.fit(x, x[:, :1], n_y=2, n_u=3)
