"""The partition sweep: the iterative least squares equal the QR, and its rows, file and picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.static.fuzzy_means import (
    FuzzyMeansRBF,
    grid_points,
    select_centres,
    solve_iterative,
    solve_qr,
    to_grid,
)
from loopwright.pipeline.models.static.rbf import design_matrix
from loopwright.pipeline.models.static.sweep import SweepResult, _cells, sweep
from loopwright.pipeline.pictures.model_pictures import draw


@pytest.fixture(scope="module")
def cstr() -> tuple[np.ndarray, ...]:
    """The paper's record: 60,000 random steps, 70 % of the pairs for training; x, y of both parts."""
    plant = PLANTS["thiosulfate_cstr"]()
    step, p, none = plant.stepper(), plant.parameters(), np.zeros(0)
    rng = np.random.default_rng(0)
    mv = rng.uniform(0.0, 500.0, 60_000)
    states = np.empty((len(mv) + 1, 2))
    states[0] = plant.steady_states(250.0)[0]
    for k in range(len(mv)):
        states[k + 1] = step(states[k], mv[k : k + 1], none, p)
    x = np.column_stack([states[:-1], states[1:, 0]])
    order = rng.permutation(len(mv))
    train, validation = order[:42_000], order[42_000:]
    return x[train], mv[train], x[validation], mv[validation]


def problem(cstr: tuple[np.ndarray, ...], c: int, n: int) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Responses, targets and cells of the first n training samples."""
    x, y = cstr[0][:n], cstr[1][:n]
    u = 2 * (x - x.min(axis=0)) / np.ptp(x, axis=0) - 1
    centres = torch.from_numpy(grid_points(select_centres(u, c), c))
    z = design_matrix(torch.from_numpy(u), centres, "thin_plate", 1.0)
    return z, torch.from_numpy(np.column_stack([y, np.sqrt(y)])), _cells(to_grid(u, c)[1])


@pytest.mark.parametrize("ridge", [0.0, 1e-3])
def test_iterations_reach_the_predictions_of_the_qr(cstr: tuple[np.ndarray, ...], ridge: float) -> None:
    z, y, cells = problem(cstr, 30, 12_000)
    exact = z @ solve_qr(z, y, ridge)
    residual = (y - exact).norm(dim=0)
    for tolerance in (1e-3, 1e-5, 1e-7):
        gap = (z @ solve_iterative(z, y, cells, ridge, tolerance=tolerance) - exact).norm(dim=0)
        assert bool((gap < 3 * tolerance * residual).all())


def test_the_iteration_is_really_used_and_needs_few_steps(cstr: tuple[np.ndarray, ...]) -> None:
    z, y, cells = problem(cstr, 30, 12_000)
    exact = z @ solve_qr(z, y)
    rough = z @ solve_iterative(z, y, cells, tolerance=1e-2)
    assert float((rough - exact).norm()) > 1e-6 * float((y - exact).norm())
    # A preconditioned condition number of about 2.5 gains a decade in two iterations.
    gap = (z @ solve_iterative(z, y, cells, tolerance=1e-5, limit=15) - exact).norm()
    assert 0 < float(gap) < 1e-4 * float((y - exact).norm())


@pytest.mark.parametrize("case", ["few rows", "dependent columns", "strata that tell nothing", "out of iterations"])
def test_where_the_sample_does_not_serve_the_qr_does(cstr: tuple[np.ndarray, ...], case: str) -> None:
    z, y, cells = problem(cstr, 12, 300 if case == "few rows" else 4000)
    limit = 60
    if case == "dependent columns":
        z = torch.cat([z, z[:, :3]], dim=1)
    elif case == "strata that tell nothing":
        cells = np.zeros_like(cells)
    elif case == "out of iterations":
        limit = 1
    expected = z @ solve_qr(z, y)
    found = z @ solve_iterative(z, y, cells, limit=limit)
    assert float((found - expected).norm()) < 1e-6 * float(y.norm())


def test_an_exact_fit_ends_the_iteration(cstr: tuple[np.ndarray, ...]) -> None:
    z, _, cells = problem(cstr, 12, 4000)
    y = z @ torch.linspace(-1, 1, z.shape[1], dtype=torch.float64)[:, None]
    assert float((z @ solve_iterative(z, y, cells) - y).norm()) < 1e-8 * float(y.norm())


def test_cells_are_numbered_without_gaps_and_only_equal_samples_share_one() -> None:
    near = np.random.default_rng(0).integers(0, 1000, (5000, 9)) // 400
    cells = _cells(near)
    assert np.array_equal(np.unique(cells), np.arange(cells.max() + 1))
    assert cells.max() + 1 == len(np.unique(near, axis=0))
    assert len(np.unique(np.column_stack([near, cells]), axis=0)) == cells.max() + 1


def test_the_papers_network_comes_out(cstr: tuple[np.ndarray, ...]) -> None:
    plant = PLANTS["thiosulfate_cstr"]()
    row = sweep(*cstr, partitions=[88], limits=(0.0, 500.0), regions=plant.regions).best
    assert 680 <= row.centres <= 800
    assert row.validation.rmse <= 22.0
    assert row.train.rmse < row.validation.rmse
    # What the overall RMSE hides: the middle region, which the controller needs, is the worst.
    hot, middle, cold = row.validation.regions.values()
    assert hot < cold < middle


@pytest.fixture(scope="module")
def result(cstr: tuple[np.ndarray, ...]) -> SweepResult:
    x, y, x_val, y_val = cstr
    regions = {"hot": (0.0, 0.3), "rest": (0.3, 1.0), "nowhere": (5.0, 6.0)}
    return sweep(x[:6000], y[:6000], x_val[:3000], y_val[:3000], partitions=[6, 20, 12], regions=regions, unit="K")


def test_rows_equal_the_estimator(cstr: tuple[np.ndarray, ...], result: SweepResult) -> None:
    x, y, x_val, y_val = cstr
    assert [row.partitions for row in result.rows] == [6, 12, 20]
    for row in result.rows:
        model = FuzzyMeansRBF(row.partitions).fit(x[:6000], y[:6000])
        error = model.predict(x_val[:3000]) - y_val[:3000]
        assert row.centres == len(model.centres_)
        assert row.validation.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
        assert row.train.r2 == pytest.approx(model.score(x[:6000], y[:6000]), abs=1e-6)
        hot = x_val[:3000, 0] < 0.3
        assert row.validation.regions["hot"] == pytest.approx(np.sqrt(np.mean(error[hot] ** 2)), rel=1e-3)
        assert set(row.validation.regions) == {"hot", "rest"}
    assert result.best.validation.rmse == min(row.validation.rmse for row in result.rows)


def test_the_file_holds_the_result(tmp_path: Path, result: SweepResult) -> None:
    path = tmp_path / "models" / "sweep.json"
    result.save(path)
    written = json.loads(path.read_text())
    assert written == json.loads(json.dumps(result.to_dict()))
    assert (written["chosen"], written["unit"]) == (result.best.partitions, "K")
    assert [p.name for p in path.parent.iterdir()] == ["sweep.json"]


def test_the_picture_is_written(tmp_path: Path, result: SweepResult) -> None:
    draw(result, tmp_path / "figures" / "sweep.png")
    assert (tmp_path / "figures" / "sweep.png").read_bytes().startswith(b"\x89PNG")


def test_away_from_a_terminal_one_line_is_printed(
    cstr: tuple[np.ndarray, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    x, y, x_val, y_val = (a[:500] for a in cstr)
    sweep(x, y, x_val, y_val, partitions=[4, 5])
    out, err = capsys.readouterr()
    assert out == ""
    assert err.strip().count("\n") == 0
    assert "2 networks" in err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"partitions": []}, "no partitions"),
        ({"partitions": [1, 4]}, "partitions is 1"),
        ({"ridge": -1.0}, "ridge is -1.0"),
        ({"y_train": np.zeros(7)}, "7 rows"),
        ({"x_val": np.full((50, 3), np.nan)}, "finite"),
    ],
)
def test_what_cannot_be_swept_is_refused(change: dict[str, object], says: str) -> None:
    x = np.random.default_rng(0).uniform(size=(50, 3))
    given = {"x_train": x, "y_train": x[:, 0], "x_val": x, "y_val": x[:, 0], "partitions": [4]}
    with pytest.raises(ModelError, match=says):
        sweep(**{**given, **change})  # type: ignore[arg-type]
