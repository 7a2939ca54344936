"""The identified model: its equation, its scales, its file, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.identified.identified import Identified, noise_of


def drawn(n_y: int = 2, n_mv: int = 1, n_dv: int = 1, n_x: int = 4, n_hidden: int = 3, seed: int = 0) -> Identified:
    rng = np.random.default_rng(seed)
    config = {"n_y": n_y, "n_mv": n_mv, "n_dv": n_dv, "n_x": n_x, "n_hidden": n_hidden}
    shapes = {name: tuple(t.shape) for name, t in Identified(**config).state_dict().items()}
    arrays = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    arrays |= {"y_scale": rng.uniform(0.5, 3, n_y), "v_scale": rng.uniform(0.5, 3, n_mv + n_dv)}
    return Identified.from_arrays(config, arrays)


@given(
    n_y=st.integers(1, 3),
    n_mv=st.integers(1, 2),
    n_dv=st.integers(0, 2),
    more=st.integers(0, 3),
    n_hidden=st.integers(0, 4),
    seed=st.integers(0, 99),
)
def test_the_equation(n_y: int, n_mv: int, n_dv: int, more: int, n_hidden: int, seed: int) -> None:
    model = drawn(n_y, n_mv, n_dv, n_y + more, n_hidden, seed)
    m = {name: t.numpy() for name, t in model.state_dict().items()}
    rng = np.random.default_rng(seed)
    x, v = rng.normal(size=n_y + more), rng.normal(size=n_mv + n_dv)
    scaled = (v - m["v_center"]) / m["v_scale"]
    expected = m["a"] @ x + m["b"] @ scaled + m["c"]
    expected += m["w2"] @ np.tanh(m["w1"] @ np.concatenate([x, scaled]) + m["b1"])
    assert model(torch.from_numpy(np.concatenate([x, v]))).numpy() == pytest.approx(expected)
    assert model.measured(torch.from_numpy(x)).numpy() == pytest.approx(x[:n_y] * m["y_scale"] + m["y_center"])


@pytest.mark.parametrize("missed", [0.0, 2.0])
def test_white_noise_has_its_size_under_slow_errors_of_the_model(missed: float) -> None:
    n = 5000
    slow = missed * np.sin(2 * np.pi * np.arange(n) / 1000)
    runs = [(0.2 * np.random.default_rng(seed).normal(size=n) + slow)[:, None] for seed in (0, 1)]
    assert noise_of(runs) == pytest.approx([0.2], rel=0.03)


def test_a_batch_equals_its_rows() -> None:
    model = drawn()
    z = torch.from_numpy(np.random.default_rng(1).normal(size=(3, 5, 6)))
    rows = torch.stack([model(row) for row in z.reshape(-1, 6)]).reshape(3, 5, 4)
    assert torch.allclose(model(z), rows, atol=1e-14)


@pytest.mark.parametrize("n_hidden", [0, 3])
def test_its_file_brings_back_the_same_model(tmp_path: Path, n_hidden: int) -> None:
    model = drawn(n_hidden=n_hidden)
    model.save(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as file:
        arrays = {k: file[k] for k in file.files if k != "__model__"}
    again = Identified.from_arrays(model.config(), arrays)
    z = torch.ones(6, dtype=torch.float64)
    assert torch.equal(again(z), model(z))
    assert again.config() == {"n_y": 2, "n_mv": 1, "n_dv": 1, "n_x": 4, "n_hidden": n_hidden, "recorded": 0}


def test_a_rest_has_the_outputs_that_were_asked_for() -> None:
    model = drawn()
    y, v = torch.tensor([[1.0, -2.0]], dtype=torch.float64), torch.tensor([[0.3, 0.1]], dtype=torch.float64)
    assert torch.allclose(model.measured(model.at_rest(y, v)), y)


@pytest.mark.parametrize(
    "sizes", [(0, 1, 0, 1, 0), (1, 0, 0, 1, 0), (2, 1, 0, 1, 0), (1, 1, -1, 1, 0), (1, 1, 0, 1, -1)]
)
def test_sizes_that_cannot_be(sizes: tuple[int, ...]) -> None:
    with pytest.raises(ModelError, match="give n_y and n_mv >= 1"):
        Identified(*sizes)
