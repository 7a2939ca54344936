"""MLP and linearized models: exact against plain formulas, and the same in onnxruntime at full optimization."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models import MODELS, load_model
from loopwright.pipeline.models.local_models import LinearizedPlant
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.plants.equations import EquationPlant


def data(n: int = 200, n_in: int = 3, n_out: int = 1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.uniform([0.0, 250.0, 0.0][:n_in], [1.0, 480.0, 500.0][:n_in], (n, n_in))
    return x, x[:, :n_out] + rng.normal(0.0, 0.1, (n, n_out))


def network(hidden=(8, 6), seed: int = 0, **options) -> MLP:
    net = MLP.scaled_to(*data(), hidden=hidden, **options)
    net.reset(torch.Generator().manual_seed(seed))
    return net


def run_onnx(module: torch.nn.Module, *inputs: torch.Tensor) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own deprecations
        program = torch.onnx.export(module, inputs, dynamo=True, external_data=False, verbose=False)
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    session = ort.InferenceSession(program.model_proto.SerializeToString(), options, providers=["CPUExecutionProvider"])
    feeds = {i.name: v.numpy() for i, v in zip(session.get_inputs(), inputs, strict=True)}
    return session.run(None, feeds)[0]


class Both(torch.nn.Module):
    """Prediction at one point, and at candidates of its last input."""

    def __init__(self, net: MLP) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: torch.Tensor, candidates: torch.Tensor) -> torch.Tensor:
        return torch.cat([self.net(x), self.net.sections(x[:2], candidates)[:, 0]])


def test_forward_is_the_formula() -> None:
    net = network(residual=(0,))
    x = data(20, seed=1)[0]
    p = {k: v.numpy() for k, v in net.state_dict().items()}
    a = (x - p["x_center"]) / p["x_scale"]
    for layer in range(2):
        a = np.tanh(a @ p[f"weights.{layer}"] + p[f"biases.{layer}"])
    y = p["y_center"] + p["y_scale"] * (a @ p["weights.2"] + p["biases.2"]) + x[:, :1]
    with torch.no_grad():
        np.testing.assert_allclose(net(torch.from_numpy(x)).numpy(), y, rtol=1e-12, atol=1e-13)


def test_scaling_maps_the_data_to_the_unit_box() -> None:
    x, y = data()
    net = MLP.scaled_to(x, y)
    z = (torch.from_numpy(x) - net.x_center) / net.x_scale
    assert z.min(dim=0).values.numpy() == pytest.approx(-1.0)
    assert z.max(dim=0).values.numpy() == pytest.approx(1.0)
    s = (torch.from_numpy(y) - net.y_center) / net.y_scale
    assert (float(s.mean()), float(s.std(correction=0))) == pytest.approx((0.0, 1.0), abs=1e-12)


@given(shape=st.lists(st.integers(1, 3), max_size=3), hidden=st.lists(st.integers(1, 5), min_size=1, max_size=3))
@settings(max_examples=25, deadline=None)
def test_a_batch_equals_its_rows(shape: list[int], hidden: list[int]) -> None:
    net = network(tuple(hidden), residual=(1,))
    x = torch.rand(*shape, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 300
    with torch.no_grad():
        batch, rows = net(x), torch.stack([net(row) for row in x.reshape(-1, 3)])
    assert batch.shape == (*shape, 1)
    torch.testing.assert_close(batch.reshape(-1, 1), rows, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("hidden", [(7,), (6, 5), (4, 4, 4)])
def test_sections_equal_forward_of_every_candidate(hidden: tuple[int, ...]) -> None:
    net = network(hidden, residual=(0,))
    x = torch.from_numpy(data(5)[0])
    candidates = torch.linspace(0, 500, 9, dtype=torch.float64)[:, None].expand(5, -1, -1)
    whole = torch.cat([x[:, None, :2].expand(-1, 9, -1), candidates], dim=-1)
    torch.testing.assert_close(net.sections(x[:, :2], candidates), net(whole), rtol=1e-12, atol=1e-13)


def test_onnxruntime_agrees_on_rank_1_at_full_optimization() -> None:
    """``reset`` leaves the last bias at zero, which once let a fusion round the output scale to float32."""
    net = network((8, 8, 8), residual=(0,)).eval()
    candidates = torch.linspace(0, 500, 16, dtype=torch.float64)[:, None]
    inputs = torch.from_numpy(data(1, seed=3)[0][0]), candidates
    both = Both(net)
    np.testing.assert_allclose(run_onnx(both, *inputs), both(*inputs).detach().numpy(), rtol=1e-12, atol=1e-13)


def test_file_gives_the_same_network(tmp_path: Path) -> None:
    net = network(residual=(0,))
    net.save(tmp_path / "net.npz")
    again = load_model(tmp_path / "net.npz")
    x = torch.from_numpy(data(9)[0])
    assert isinstance(again, MLP)
    assert torch.equal(again(x), net(x))


def test_reset_is_reproducible_and_spreads_the_units() -> None:
    net, other = network((40,), seed=5), network((40,), seed=5)
    assert torch.equal(net.weights[0], other.weights[0])
    assert not torch.equal(net.weights[0], network((40,), seed=6).weights[0])
    # Nguyen and Widrow: every unit's slope has the length 0.7 h^(1/n).
    assert net.weights[0].norm(dim=0).detach().numpy() == pytest.approx(0.7 * 40 ** (1 / 3))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: MLP(3, 1, ()), "at least one"),
        (lambda: MLP(3, 1, (4, 0)), "at least one unit"),
        (lambda: MLP(3, 1, (4,), residual=(3,)), "one column of 0..2"),
        (lambda: MLP(3, 2, (4,), residual=(0,)), "per output"),
        (lambda: MLP.scaled_to(np.ones((5, 2)), np.arange(5.0)[:, None]), "input column 0"),
        (lambda: MLP.scaled_to(np.arange(5.0)[:, None], np.full((5, 1), np.nan)), "output column 0"),
        (lambda: MLP.scaled_to(np.arange(5.0), np.arange(5.0)), "shapes"),
        (lambda: LinearizedPlant(2, 1, 0, 0.5), "n_pv=0"),
    ],
)
def test_wrong_arguments_are_one_clear_line(make, says: str) -> None:
    with pytest.raises(ModelError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_linearized_keeps_the_steady_state_and_the_plant_s_slope(plant: EquationPlant, tmp_path: Path) -> None:
    model = LinearizedPlant.at_set_point(plant, 0.66612814)
    x0 = torch.cat([model.x, model.mv])
    torch.testing.assert_close(model(x0), model.pv, rtol=1e-12, atol=1e-12)
    step = plant.stepper()
    size = np.array([1e-4, 0.03, 0.05])
    for i in range(3):
        nudge = np.eye(3)[i] * size[i]
        up, down = x0.numpy() + nudge, x0.numpy() - nudge
        rest = plant.dv_nominal, plant.parameters()
        slope = (step(up[:2], up[2:], *rest) - step(down[:2], down[2:], *rest)) / (2 * size[i])
        assert model.one_period[i].numpy() == pytest.approx(slope, rel=1e-3, abs=1e-7)
    model.save(tmp_path / "linear.npz")
    again = load_model(tmp_path / "linear.npz")
    assert torch.equal(again(x0 + 1), model(x0 + 1))
    assert model.linearization().eigenvalues[0] == pytest.approx(0.4548, abs=1e-3)
    np.testing.assert_allclose(run_onnx(model, x0 + 1), model(x0 + 1).numpy(), rtol=1e-12)


def test_kinds_are_registered() -> None:
    assert {"mlp", "nnarx", "linearized"} <= set(MODELS)
    # A kind of part may learn a model of another kind; what a file says must name one that reads it.
    assert all(MODELS[part.model.kind].model is part.model for part in MODELS.values())
