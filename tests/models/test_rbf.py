"""The fuzzy-means RBF: its one pass, its least squares, its torch module and its graph."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models import MODELS, load_model
from loopwright.pipeline.models.static.fuzzy_means import FuzzyMeansRBF, grid_points, select_centres
from loopwright.pipeline.models.static.rbf import BASES, RBF, design_matrix

CHECKS = """
from sklearn.utils.estimator_checks import check_estimator
from loopwright.pipeline.models.static.fuzzy_means import FuzzyMeansRBF
for estimator in (FuzzyMeansRBF(), FuzzyMeansRBF(5, basis="gaussian", ridge=1e-6)):
    results = check_estimator(estimator, on_skip="warn", on_fail="raise")
    assert len(results) > 40 and all(r["status"] == "passed" for r in results), results
print("all passed")
"""


def test_scikit_learns_checks_pass_with_nothing_excused_or_skipped() -> None:
    # scipy reads the variable when it is imported, so only a process of its own can set it.
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", CHECKS],
        env={**os.environ, "SCIPY_ARRAY_API": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stdout.strip() == "all passed", run.stderr[-2000:]


def one_pass(u: np.ndarray, c: int) -> np.ndarray:
    """Fuzzy means, sample by sample, as eqs. 4-7 say it."""
    grid = np.linspace(-1, 1, c)
    half_width = 1 / (c - 1)
    centres: list[tuple[int, ...]] = []
    for sample in u:
        distances = [np.linalg.norm(sample - grid[list(i)]) for i in centres]
        if not any((d / half_width) ** 2 / u.shape[1] <= 1 + 1e-9 for d in distances):
            centres.append(tuple(int(np.argmin(np.abs(grid - v))) for v in sample))
    return np.array(centres)


@given(st.integers(1, 4), st.integers(2, 12), st.integers(1, 400), st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_the_pass_equals_the_loop_over_samples(n_in: int, c: int, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (n, n_in)) ** rng.choice([1, 3])
    # Rounding alone decides on a sample halfway between two grid points.
    between = (u + 1) * (c - 1) / 2 % 1
    u = u[(np.abs(between - 0.5) > 1e-9).all(axis=1)]
    assume(len(u))
    np.testing.assert_array_equal(select_centres(u, c), one_pass(u, c))


@given(st.integers(1, 3), st.integers(2, 9), st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_every_sample_is_covered_and_no_centre_is_chosen_twice(n_in: int, c: int, seed: int) -> None:
    # Multiples of half the spacing hit grid points and the corners between them exactly.
    u = np.random.default_rng(seed).integers(0, 2 * c - 1, (200, n_in)) / (c - 1) - 1
    index = select_centres(u, c)
    assert len(np.unique(index, axis=0)) == len(index)
    assert index.min() >= 0
    assert index.max() <= c - 1
    distance = np.linalg.norm(u[:, None] - grid_points(index, c), axis=2).min(axis=1)
    assert distance.max() <= np.sqrt(n_in) / (c - 1) * (1 + 1e-9)


def curved(n: int = 600, n_out: int = 1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.uniform([0.0, 250.0, 0.0], [1.0, 420.0, 1.0], (n, 3))
    y = np.column_stack(
        [200 * np.sin(3 * x[:, 0]) * x[:, 2] + (x[:, 1] - 300) ** 2 / 100 * (k + 1) for k in range(n_out)]
    )
    return x, y


@pytest.mark.parametrize("basis", BASES)
def test_the_residual_is_orthogonal_to_every_response(basis: str) -> None:
    x, y = curved()
    model = FuzzyMeansRBF(5, basis=basis).fit(x, y[:, 0])
    u = 2 * (x - model.low_) / model.span_ - 1
    z = design_matrix(torch.from_numpy(u), torch.from_numpy(model.centres_), basis, model.width).numpy()
    residual = y[:, 0] - z @ model.weights_[0]
    assert np.abs(z.T @ residual).max() < 1e-8 * np.linalg.norm(y)
    np.testing.assert_allclose(model.predict(x), z @ model.weights_[0], rtol=0, atol=1e-8)
    best = np.linalg.lstsq(z, y[:, 0], rcond=None)[0]
    np.testing.assert_allclose(z @ model.weights_[0], z @ best, rtol=0, atol=1e-6)


def test_more_partitions_fit_better_and_ridge_shrinks_the_weights() -> None:
    x, y = curved()
    error = [np.std(FuzzyMeansRBF(c).fit(x, y).predict(x) - y) for c in (3, 6, 12)]
    assert error[0] > error[1] > error[2]
    norms = [np.linalg.norm(FuzzyMeansRBF(6, ridge=r).fit(x, y).weights_) for r in (0.0, 1e-3, 1.0)]
    assert norms[0] > norms[1] > norms[2]


def test_ridge_solves_the_penalized_equations() -> None:
    x, y = curved()
    model = FuzzyMeansRBF(4, ridge=0.1).fit(x, y[:, 0])
    u = 2 * (x - model.low_) / model.span_ - 1
    z = design_matrix(torch.from_numpy(u), torch.from_numpy(model.centres_), "thin_plate", 1.0).numpy()
    expected = np.linalg.solve(z.T @ z + 0.1 * np.eye(z.shape[1]), z.T @ y[:, 0])
    np.testing.assert_allclose(model.weights_[0], expected, rtol=1e-6)


def test_outputs_are_fitted_together_as_they_are_alone() -> None:
    x, y = curved(n_out=2)
    both = FuzzyMeansRBF(6).fit(x, y).predict(x)
    for k in range(2):
        np.testing.assert_allclose(both[:, k], FuzzyMeansRBF(6).fit(x, y[:, k]).predict(x), atol=1e-8)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"partitions": 1}, "partitions is 1"),
        ({"partitions": 4.0}, "whole number"),
        ({"basis": "cubic"}, "thin_plate, gaussian"),
        ({"width": 0.0}, "width is 0.0"),
        ({"ridge": -1.0}, "ridge is -1.0"),
    ],
)
def test_a_parameter_out_of_range_is_named(wrong: dict[str, object], says: str) -> None:
    x, y = curved(20)
    with pytest.raises(ModelError, match=says):
        FuzzyMeansRBF(**wrong).fit(x, y)


def plain_form(net: RBF, x: np.ndarray) -> np.ndarray:
    """The unlimited output in extended precision with the distance squared term by term."""
    wide = np.longdouble
    c, w = net.centres.numpy().T.astype(wide), net.weights.numpy().astype(wide)
    u = 2 * (x.astype(wide) - net.low.numpy()) / net.span.numpy() - 1
    d2 = ((u[:, None] - c) ** 2).sum(axis=-1)
    return (0.5 * d2 * np.log(np.maximum(d2, 1e-30))) @ w.T


def test_the_expanded_distance_does_no_harm_at_or_near_a_centre() -> None:
    x, y = curved(3000)
    model = FuzzyMeansRBF(12).fit(x, y)
    net = model.to_torch()
    at = model.low_ + model.span_ * (model.centres_ + 1) / 2
    rng = np.random.default_rng(1)
    for points in (at, at + 1e-7 * model.span_ * rng.normal(size=at.shape), at + 1e-3 * model.span_):
        # The weighted sum itself cancels: its terms are up to a million times the output.
        error = np.abs(net(torch.from_numpy(points)).numpy() - plain_form(net, points))
        assert error.max() < 1e-9 * np.ptp(y)


def test_batches_equal_rows() -> None:
    x, y = curved(n_out=2)
    net = FuzzyMeansRBF(6).fit(x, y).to_torch()
    batch = torch.from_numpy(x[:12]).reshape(3, 4, 3)
    out = net(batch)
    assert out.shape == (3, 4, 2)
    rows = torch.stack([net(row) for row in batch.reshape(12, 3)])
    torch.testing.assert_close(out.reshape(12, 2), rows, rtol=0, atol=1e-9)


@pytest.mark.parametrize("basis", BASES)
def test_the_gradient_is_finite_at_a_centre(basis: str) -> None:
    x, y = curved()
    net = FuzzyMeansRBF(5, basis=basis).fit(x, y).to_torch()
    at = (net.low + net.span * (net.centres[:, 0] + 1) / 2).requires_grad_()
    net(at).sum().backward()
    assert at.grad is not None
    assert bool(torch.isfinite(at.grad).all())


def test_a_saved_network_is_the_same_network(tmp_path: Path) -> None:
    x, y = curved()
    net = FuzzyMeansRBF(6, basis="gaussian", width=0.3).fit(x, y).to_torch()
    net.save(tmp_path / "a" / "rbf.npz")
    again = load_model(tmp_path / "a" / "rbf.npz")
    assert type(again) is MODELS["rbf"].model is RBF
    assert torch.equal(net(torch.from_numpy(x)), again(torch.from_numpy(x)))
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["rbf.npz"]


def test_shapes_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ModelError, match="4 centres"):
        RBF.of(np.zeros((4, 3)), np.zeros((1, 5)), np.zeros(3), np.ones(3))
    with pytest.raises(ModelError, match="cubic"):
        RBF(3, 4, basis="cubic")  # type: ignore[arg-type]


@pytest.mark.parametrize(("basis", "n_out"), [("thin_plate", 1), ("thin_plate", 2), ("gaussian", 1)])
def test_the_graph_equals_the_module_under_full_optimization(tmp_path: Path, basis: str, n_out: int) -> None:
    x, y = curved(n_out=n_out)
    net = FuzzyMeansRBF(8, basis=basis).fit(x, y).to_torch()
    path = tmp_path / "rbf.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of torch's exporter about itself
        warnings.simplefilter("ignore", FutureWarning)
        torch.onnx.export(
            net, (torch.from_numpy(x[0]),), path, dynamo=True, external_data=False, verbose=False, input_names=["x"]
        )
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    centres = net.low + net.span * (net.centres[:, :20].T + 1) / 2
    for row in np.vstack([x[:50], centres.numpy()]):
        found = session.run(None, {"x": row})[0]
        np.testing.assert_allclose(found, net(torch.from_numpy(row)).numpy(), rtol=1e-9, atol=1e-9)
