"""The linear model of an NNARX at a point, against autograd, and its course along the newest MV."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models.lagged.instantaneous import AlongMv, arx, linearize
from loopwright.pipeline.models.lagged.lagged import NNARX

SHAPES = [
    (n_y, n_u, hidden, residual)
    for n_y, n_u in ((1, 1), (3, 2))
    for hidden in ((4,), (5, 4), (6, 5, 4))
    for residual in (False, True)
]


def network(n_y: int, n_u: int, hidden: tuple[int, ...], residual: bool, n_mv: int = 1, delay: int = 1) -> NNARX:
    rng = np.random.default_rng(3)
    x = rng.uniform(-2, 7, (50, n_y + n_u * n_mv))
    model = NNARX.scaled_to(x, 3 + 9 * rng.normal(size=(50, 1)), n_y=n_y, n_u=n_u, hidden=hidden, residual=residual)
    if (n_mv, delay) != (1, 1):
        model = NNARX(n_y, n_u, n_mv, delay, hidden, residual)
    model.net.reset(torch.Generator().manual_seed(4))
    return model.eval()


@pytest.fixture(params=SHAPES, ids=str)
def model(request: pytest.FixtureRequest) -> NNARX:
    return network(*request.param)


def points(model: NNARX, *batch: int) -> torch.Tensor:
    rng = np.random.default_rng(5)
    return torch.from_numpy(rng.uniform(-4, 9, (*batch, model.n_y + model.n_u)))


def autograd(model: NNARX, phi: torch.Tensor) -> torch.Tensor:
    return vmap(jacrev(model))(phi)[:, 0].detach()


def test_linearize_is_the_gradient(model: NNARX) -> None:
    phi = points(model, 40)
    value, slopes = linearize(model, phi)
    torch.testing.assert_close(value, model(phi).detach(), rtol=0, atol=0)
    torch.testing.assert_close(slopes, autograd(model, phi), rtol=1e-12, atol=1e-12)
    for batch in ((), (2, 3)):
        at = points(model, *batch)
        assert linearize(model, at).slopes.shape == at.shape


def test_tangent_plane_touches_the_network(model: NNARX) -> None:
    phi, step = points(model, 20), torch.from_numpy(np.random.default_rng(6).normal(size=(20, model.n_y + model.n_u)))
    tangent = linearize(model, phi)
    torch.testing.assert_close(tangent.predict(0 * step), model(phi).detach(), rtol=0, atol=0)
    errors = [(tangent.predict(h * step) - model(phi + h * step)).abs().max().item() for h in (1e-2, 1e-3)]
    assert errors[1] == pytest.approx(errors[0] / 100, rel=0.3)  # of second order


def test_arx_in_the_signs_of_equation_9(model: NNARX) -> None:
    phi = points(model, 20)
    a, b, bias = arx(model, phi)
    lags_y, lags_u = phi[:, : model.n_y], phi[:, model.n_y :]
    y = bias - (a * lags_y).sum(-1, keepdim=True) + (b * lags_u).sum(-1, keepdim=True)
    torch.testing.assert_close(y, model(phi).detach(), rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(torch.cat([-a, b], dim=-1), autograd(model, phi), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("unit", [1.0, 100.0, -0.5])
def test_along_the_newest_mv(model: NNARX, unit: float) -> None:
    phi = points(model, 40)
    ray = AlongMv(model, unit)
    value, slope = ray.value_and_slope(phi)
    size = autograd(model, phi).abs().max().item() * max(1.0, abs(unit))
    torch.testing.assert_close(value, model(phi).detach(), rtol=1e-12, atol=1e-12 * size)
    torch.testing.assert_close(value, ray.value(phi), rtol=0, atol=0)
    column = autograd(model, phi)[:, model.n_y : model.n_y + 1]
    torch.testing.assert_close(slope, unit * column, rtol=1e-12, atol=1e-12 * size)
    step = torch.linspace(-1, 1, 40, dtype=torch.float64)[:, None]
    further = phi.clone()
    further[:, model.n_y] += unit * step[:, 0]
    torch.testing.assert_close(ray.value(phi + step * ray.newest), model(further).detach(), rtol=1e-11, atol=1e-11)


def test_a_newest_mv_that_does_not_act_at_once_is_refused() -> None:
    for n_mv, delay in ((2, 1), (1, 2)):
        with pytest.raises(ModelError, match=f"{n_mv} MVs and delay {delay}"):
            AlongMv(network(2, 2, (4,), True, n_mv, delay))
