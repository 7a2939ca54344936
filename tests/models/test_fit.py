"""Trainers: Jacobians against autograd, convergence of Gauss-Newton, early stopping, the free-run objective."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.func import functional_call, jacrev, vmap

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.lagged.lagged import NNARX
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.models.training.fit import LBFGS, TRAINERS, Adam, LevenbergMarquardt
from loopwright.pipeline.models.training.objectives import (
    FreeRunWindows,
    Objective,
    Samples,
    input_jacobian,
    parameter_jacobian,
    scaled_output,
)


def network(hidden: tuple[int, ...], n_out: int = 1, residual: bool = True, seed: int = 0) -> tuple[MLP, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.uniform([0.0, 250.0, 0.0], [1.0, 480.0, 500.0], (40, 3))
    y = rng.normal(0.0, [0.3, 20.0][:n_out], (40, n_out)) + x[:, :n_out]
    net = MLP.scaled_to(x, y, hidden=hidden, residual=tuple(range(n_out)) if residual else ())
    net.reset(torch.Generator().manual_seed(seed))
    return net, x


def eq_15(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """z(t) = z(t-1) / (1 + z(t-1)^2) + u(t-1)^3, [chen2004, eq. 15]."""
    u = np.random.default_rng(seed).uniform(-1.2, 1.2, n)
    z = np.zeros(n)
    for t in range(1, n):
        z[t] = z[t - 1] / (1 + z[t - 1] ** 2) + u[t - 1] ** 3
    return z, u


def eq_15_windows(n: int, seed: int, steps: int, noise: float = 0.0) -> FreeRunWindows:
    z, u = eq_15(n, seed)
    y = z + noise * np.random.default_rng(seed + 100).normal(size=n)
    k = np.arange(1, n - steps)
    index = k[:, None] + np.arange(steps)
    return FreeRunWindows(y[k - 1, None], u[index - 1][:, :, None], y[index])


def sine(n: int = 300, noise: float = 0.0, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-3, 3, (n, 1))
    return Samples(x, np.sin(2 * x) + noise * rng.normal(size=x.shape))


def rms(objective: Objective, net: MLP) -> float:
    return math.sqrt(objective.loss(net).item())


CASES = [((6,), 1, True), ((6,), 2, False), ((5, 4), 2, True), ((4, 3, 5), 1, True)]


@pytest.mark.parametrize(("hidden", "n_out", "residual"), CASES)
def test_jacobians_equal_autograd(hidden: tuple[int, ...], n_out: int, residual: bool) -> None:
    net, rows = network(hidden, n_out, residual)
    x = torch.from_numpy(rows)
    parameters = dict(net.named_parameters())

    def unscaled(theta: dict[str, torch.Tensor], row: torch.Tensor) -> torch.Tensor:
        y = functional_call(net, theta, (row,))
        change = y - row[list(net.residual)] if net.residual else y
        return (change - net.y_center) / net.y_scale

    blocks = vmap(jacrev(unscaled), (None, 0))(parameters, x)
    expected = torch.cat([blocks[name].flatten(2) for name in parameters], dim=2)
    s, jac = parameter_jacobian(net, x)
    torch.testing.assert_close(jac, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(s, vmap(unscaled, (None, 0))(parameters, x), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(scaled_output(net, x), s, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(input_jacobian(net, x), vmap(jacrev(net))(x), rtol=1e-12, atol=1e-12)


def weighted_samples() -> tuple[MLP, Objective]:
    net, x = network((5, 4))
    rng = np.random.default_rng(1)
    return net, Samples(x, rng.normal(size=(len(x), 1)), rng.uniform(0, 2, len(x)))


def free_run() -> tuple[MLP, Objective]:
    rng = np.random.default_rng(2)
    model = NNARX(2, 2, n_mv=2, hidden=(5,), residual=True)
    model.net.reset(torch.Generator().manual_seed(0))
    model.net.y_scale.fill_(0.3)
    shapes = (30, 2), (30, 5, 2), (30, 4)
    return model.net, FreeRunWindows(*(rng.normal(size=s) for s in shapes))


@pytest.mark.parametrize("make", [weighted_samples, free_run])
@pytest.mark.parametrize("chunk", [7, 1000])
def test_normal_equations_equal_autograd(make, chunk: int) -> None:
    net, objective = make()
    loss = objective.loss(net)
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(net.parameters()))])
    value, half, hessian = objective.normal_equations(net, chunk)
    torch.testing.assert_close(value, loss.detach(), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(2 * half, gradient, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(hessian, hessian.T, rtol=1e-12, atol=1e-13)
    assert float(torch.linalg.eigvalsh(hessian).min()) > -1e-10


def test_free_run_jacobian_equals_autograd() -> None:
    net, objective = free_run()
    assert isinstance(objective, FreeRunWindows)
    past, u, future = (torch.from_numpy(a) for a in (objective.past, objective.u, objective.future))
    root = objective.future.size**-0.5 / net.y_scale
    names, values = zip(*net.named_parameters(), strict=True)
    model = NNARX(2, 2, n_mv=2, hidden=(5,), residual=True)

    def residual(*theta: torch.Tensor) -> torch.Tensor:
        parameters = {f"net.{n}": t for n, t in zip(names, theta, strict=True)}
        buffers = {f"net.{n}": b for n, b in net.named_buffers()}
        run = functional_call(Simulator(model), {f"model.{k}": v for k, v in (parameters | buffers).items()}, (past, u))
        return (root[:, None] * (run - future)).flatten()

    blocks = jacrev(residual, argnums=tuple(range(len(values))))(*values)
    jac = torch.cat([b.flatten(1) for b in blocks], dim=1)
    _, _, hessian = objective.normal_equations(net, 11)
    torch.testing.assert_close(hessian, jac.T @ jac, rtol=1e-11, atol=1e-12)


class Simulator(torch.nn.Module):
    def __init__(self, model: NNARX) -> None:
        super().__init__()
        self.model = model

    def forward(self, past: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return self.model.simulate(past, u)


def test_levenberg_marquardt_recovers_a_network_quadratically() -> None:
    """On a zero-residual problem near its solution Gauss-Newton's error is squared at each step."""
    net, x = network((4,), residual=False)
    truth = torch.cat([p.detach().flatten() for p in net.parameters()])
    with torch.no_grad():
        y = net(torch.from_numpy(x)).numpy()
        for p in net.parameters():
            p.add_(1e-2 * torch.randn(p.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    samples = Samples(x, y)
    trainer = LevenbergMarquardt(iterations=12, restarts=0, mu=1e-12, gain=0.0)
    history = trainer.fit(net, samples, samples, seed=0)
    found = torch.cat([p.detach().flatten() for p in net.parameters()])
    assert float((found - truth).norm()) < 1e-8
    errors = [e for e in history.train if e > 1e-9]
    orders = [math.log(b) / math.log(a) for a, b in pairwise(errors)]
    assert max(orders) > 1.6


@pytest.mark.parametrize("kind", sorted(TRAINERS))
def test_every_trainer_learns_repeats_itself_and_keeps_the_best(kind: str) -> None:
    train, validation = sine(noise=0.05), sine(100, 0.05, seed=1)
    trainer = TRAINERS[kind](iterations=60, **({"batch": 32} if kind == "adam" else {}))
    seen: list[int] = []
    nets = []
    for _ in range(2):
        net = MLP.scaled_to(train.x, train.y, hidden=(8,))
        history = trainer.fit(net, train, validation, seed=3, progress=lambda i, *_: seen.append(i))
        nets.append(net)
    assert history.validation[history.best] == min(history.validation)
    assert rms(validation, nets[0]) == pytest.approx(history.validation[history.best], rel=1e-12)
    assert history.validation[history.best] < 0.35
    assert all(torch.equal(a, b) for a, b in zip(nets[0].parameters(), nets[1].parameters(), strict=True))
    assert seen == [*range(len(history.train))] * 2


def test_the_loss_of_levenberg_marquardt_never_rises() -> None:
    net = MLP.scaled_to(sine().x, sine().y, hidden=(10,))
    history = LevenbergMarquardt(iterations=50).fit(net, sine(), sine(seed=1), seed=0)
    assert (np.diff(history.train) < 0).all()
    assert history.validation[history.best] < 1e-2


def test_early_stopping_ends_an_overfit() -> None:
    train, validation = sine(25, noise=0.3), sine(200, noise=0.3, seed=1)
    net = MLP.scaled_to(train.x, train.y, hidden=(12,))
    history = LevenbergMarquardt(iterations=300, patience=10).fit(net, train, validation, seed=0)
    assert history.stopped == "patience"
    assert len(history.train) - 1 <= history.best + 10
    assert history.validation[-1] > history.validation[history.best]


def test_restarts_are_never_worse_and_zero_continues() -> None:
    train, validation = sine(), sine(seed=1)
    errors = {}
    for restarts in (1, 4):
        net = MLP.scaled_to(train.x, train.y, hidden=(6,))
        history = LevenbergMarquardt(iterations=25, restarts=restarts).fit(net, train, validation, seed=0)
        errors[restarts] = min(history.validation)
    assert errors[4] <= errors[1]
    before = rms(validation, net)
    again = LevenbergMarquardt(iterations=25, restarts=0).fit(net, train, validation, seed=0)
    assert again.validation[again.best] <= before


def test_weights_move_the_error_to_the_rows_that_matter_less() -> None:
    """A straight-ish net cannot fit both halves of a kink; the weighted half wins."""
    x = np.linspace(-1, 1, 200)[:, None]
    y = np.where(x > 0, np.sin(9 * x), 0.5 * x)
    right = x[:, 0] > 0
    errors = {}
    for name, weight in {"equal": None, "right": np.where(right, 100.0, 1.0)}.items():
        net = MLP.scaled_to(x, y, hidden=(2,))
        samples = Samples(x, y, weight)
        LevenbergMarquardt(iterations=100, restarts=3).fit(net, samples, samples, seed=0)
        with torch.no_grad():
            errors[name] = float(np.abs(net(torch.from_numpy(x)).numpy() - y)[right].mean())
    assert errors["right"] < errors["equal"]


def test_free_run_objective_beats_one_step_under_noise() -> None:
    """With noise on y the one-step fit is biased; the free-run fit is not (errors in variables)."""
    errors = {}
    test = eq_15_windows(400, 9, 10)
    for steps in (1, 8):
        model = NNARX(1, 1, hidden=(10,))
        train, validation = eq_15_windows(800, 0, steps, noise=0.3), eq_15_windows(300, 5, steps, noise=0.3)
        one = eq_15_windows(800, 0, 1)
        model.net = MLP.scaled_to(np.column_stack([one.past[:, 0], one.u[:, 0, 0]]), one.future, hidden=(10,))
        LevenbergMarquardt(iterations=40).fit(model.net, train, validation, seed=0)
        with torch.no_grad():
            run = model.simulate(torch.from_numpy(test.past), torch.from_numpy(test.u)).numpy()
        errors[steps] = float(np.sqrt(np.mean((run - test.future) ** 2)))
    assert errors[8] < 0.6 * errors[1]


def test_rows_draws_a_subset() -> None:
    train = sine(5000)
    net = MLP.scaled_to(train.x, train.y, hidden=(10,))
    LevenbergMarquardt(iterations=40, rows=300).fit(net, train, sine(seed=1), seed=0)
    assert rms(train, net) < 2e-2


def test_wrong_data_are_one_clear_line() -> None:
    x = np.zeros((3, 1))
    for arguments, says in [
        ((x, np.zeros((2, 1))), "shapes"),
        ((np.zeros((0, 1)), np.zeros((0, 1))), "N > 0"),
        ((np.full((3, 1), np.inf), x), "not finite"),
        ((x, x, np.array([1.0, -1.0, 1.0])), "weights"),
        ((x, x, np.zeros(3)), "not all zero"),
    ]:
        with pytest.raises(ModelError, match=says):
            Samples(*arguments)
    net = MLP.scaled_to(sine().x, sine().y)
    with pytest.raises(ModelError, match="no finite validation error"):
        Adam(iterations=3, rate=1e300).fit(net, sine(), sine(), seed=0)
    assert LBFGS().memory > 0
