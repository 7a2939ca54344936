"""A predictive law without a past takes the plant for at rest, under loads that hold it there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from identified_models import random_model, scaled_model
from predictive_loops import NONE, law_of
from torch import Tensor

from loopwright.pipeline.laws.predictive.cold_rest import bent_rest, held_rest
from loopwright.pipeline.laws.predictive.disturbance_model import Where, loads_of
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.identified import Identified

PLACES: tuple[Where, ...] = ("mvs", "outputs")


def drawn(seed: int, *sizes: int) -> list[Tensor]:
    rng = np.random.default_rng(seed)
    return [torch.from_numpy(rng.uniform(-0.3, 0.3, n)) for n in sizes]


def first_move(law: Predictive, y: Tensor, mv: Tensor, sp: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """What the cold law asks for beyond the applied MV, and its info."""
    with torch.no_grad():
        asked, _, info = law(y if sp is None else sp, y, NONE, mv, torch.zeros(law.n_state, dtype=torch.float64))
    return asked - mv, info


def level() -> Identified:
    """An integrator behind a lag, which rests under no MV of its range by itself."""
    a, b = np.array([[1.0, 0.1], [0.0, 0.7]]), np.array([[0.0], [0.3]])
    return scaled_model(1, 1, 0, 2, a=a, b=b, c=np.array([0.03, 0.0]), rest=np.eye(2, 3), rest_cov=0.01 * np.eye(2))


@pytest.mark.parametrize("where", PLACES)
@pytest.mark.parametrize("seed", range(5))
def test_the_loads_hold_a_linear_model_at_any_rest(seed: int, where: Where) -> None:
    model = random_model(seed, n_y=2, n_mv=2, n_hidden=0)
    loads = loads_of(model, where, 30)
    y, v = drawn(seed, 2, 2)
    x, d = torch.split(held_rest(model, loads) @ torch.cat([y, v, torch.ones(1, dtype=torch.float64)]), [4, 2])
    ahead = model(torch.cat([x, v + loads.into_v @ d])) + loads.into_x @ d
    torch.testing.assert_close(ahead, x, atol=1e-4, rtol=0)
    torch.testing.assert_close(x[:2], y, atol=1e-4, rtol=0)


@pytest.mark.parametrize("where", PLACES)
@pytest.mark.parametrize("seed", range(5))
def test_on_set_point_a_cold_law_keeps_the_mv(seed: int, where: Where) -> None:
    """Of three plants in closed-loop records the MV moved by 9 to 22 % of its range at the first sample."""
    model = random_model(seed, n_y=2, n_mv=2, n_hidden=0)
    y, mv = drawn(100 + seed, 2, 2)
    moved, _ = first_move(law_of(model, loads=where), y, mv)
    assert moved.abs().max() < 1e-3


def test_states_may_have_any_size() -> None:
    """Only outputs and inputs are scaled: a blender of three loops had states beyond 8, and its MVs moved by 29 %."""
    model = random_model(2, n_y=2, n_mv=2, n_hidden=0)
    size = torch.tensor([1.0, 1.0, 300.0, 300.0]).double()
    for name in ("b", "c"):
        getattr(model, name).mul_(size if name == "c" else size[:, None])
    model.a.mul_(size[:, None] / size)
    y, mv = drawn(7, 2, 2)
    moved, _ = first_move(law_of(model), y, mv)
    assert moved.abs().max() < 1e-3


@pytest.mark.parametrize("mv", [-0.2, 0.0, 0.4])
@pytest.mark.parametrize("where", PLACES)
def test_a_level_is_kept_by_the_mv_that_keeps_it(where: Where, mv: float) -> None:
    moved, _ = first_move(law_of(level(), loads=where), torch.tensor([0.2]).double(), torch.tensor([mv]).double())
    assert moved.abs().max() < 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_a_network_under_a_load_is_kept_nearly(seed: int) -> None:
    model = random_model(seed, n_hidden=5)
    model.c.copy_(-torch.tanh(model.b1) @ model.w2.T)  # as the mean of a record, zero is a rest
    load, mv = drawn(200 + seed, 1, 1)
    x = torch.zeros(model.n_x, dtype=torch.float64)
    for _ in range(300):
        x = model(torch.cat([x, mv + load]))
    moved, _ = first_move(law_of(model), model.measured(x), mv)
    assert moved.abs().max() < 0.05 * load.abs().max() + 0.002


@pytest.mark.parametrize("where", PLACES)
@pytest.mark.parametrize(("load", "mv"), [(0.4, -0.6), (-0.3, 0.0), (0.2, 0.7), (-0.5, 0.5)])
def test_a_network_that_bends_much_is_kept_under_a_load(where: Where, load: float, mv: float) -> None:
    """Slopes in the middle of its curve are many times those at its ends: with them the MV moved by up to .25."""
    model = scaled_model(
        1, 1, 0, 2, 1, a=np.array([[0.8, 0.1], [0.0, 0.5]]), b=np.array([[0.02], [0.1]]), c=np.zeros(2),
        w1=np.array([[0.0, 0.0, 1.5]]), b1=np.zeros(1), w2=np.array([[0.2], [0.3]]),
        rest=np.array([[1.0, 0.0, 0.0], [0.0, 0.8, 0.0]]), rest_cov=0.01 * np.eye(2),
    )  # fmt: skip
    applied, x = torch.tensor([mv]).double(), torch.zeros(2, dtype=torch.float64)
    law = law_of(model, loads=where)
    loads = loads_of(model, where, 30)
    d = torch.tensor([load if where == "mvs" else 0.2 * load]).double()
    acting = d / loads.into_v[:1, 0] if where == "mvs" else d
    for _ in range(300):
        x = model(torch.cat([x, applied + loads.into_v @ acting])) + loads.into_x @ acting
    moved, _ = first_move(law, model.measured(x), applied)
    assert moved.abs().max() < 0.02


@pytest.mark.parametrize("where", PLACES)
def test_the_map_of_a_networks_rests_finds_them(where: Where) -> None:
    model = random_model(3, n_hidden=5)
    loads = loads_of(model, where, 30)
    found = bent_rest(model, loads, held_rest(model, loads), torch.tensor([[-1.0, 1.0]]).double())
    assert found is not None
    left = []
    for seed in range(20):
        mv, d = drawn(300 + seed, 1, 1)
        x = torch.zeros(model.n_x, dtype=torch.float64)
        for _ in range(400):
            x = model(torch.cat([x, mv + loads.into_v @ d])) + loads.into_x @ d
        g = torch.cat([x[:1], mv, torch.ones(1, dtype=torch.float64)])
        left.append(
            float((found.straight @ g + found.bent @ torch.tanh(found.into @ g) - torch.cat([x, d])).abs().max())
        )
    assert np.median(left) < 0.01


def test_a_model_that_rests_nowhere_has_no_map() -> None:
    model = random_model(1, n_hidden=4)
    model.a.copy_(1.2 * torch.eye(model.n_x, dtype=torch.float64))
    model.w2.mul_(0.0)
    model.b.mul_(0.0)
    model.c.fill_(40.0)
    loads = loads_of(model, "mvs", 30)
    assert bent_rest(model, loads, held_rest(model, loads), torch.tensor([[-1.0, 1.0]]).double()) is None


@pytest.mark.parametrize("mv", [-0.8, -0.4, 0.0, 0.4, 0.8])
def test_a_network_that_bends_much_and_has_no_load_is_kept(mv: float) -> None:
    """As a neutralization, whose gain changes tenfold: loads by the slopes in the middle threw it off its set point."""
    model = scaled_model(
        1, 1, 0, 1, 1, a=np.array([[0.8]]), b=np.array([[0.02]]), c=np.zeros(1), w1=np.array([[0.0, 3.0]]),
        b1=np.zeros(1), w2=np.array([[0.2]]), rest=np.array([[1.0, 0.0, 0.0]]), rest_cov=0.01 * np.eye(1),
    )  # fmt: skip
    applied, x = torch.tensor([mv]).double(), torch.zeros(1, dtype=torch.float64)
    for _ in range(300):
        x = model(torch.cat([x, applied]))
    moved, _ = first_move(law_of(model), model.measured(x), applied)
    assert moved.abs().max() < 1e-6


@pytest.mark.parametrize("where", PLACES)
def test_what_no_load_of_a_rest_explains_is_no_rest(where: Where) -> None:
    """A plant that is started far from where its MV would bring it: the load stays within what rests have."""
    model = random_model(1, n_hidden=0)
    law = law_of(model, loads=where)
    _, info = first_move(law, torch.tensor([50.0]).double(), torch.zeros(1, dtype=torch.float64))
    assert info[0].abs() == pytest.approx(float(law.largest * law.load_scale))
    if where == "mvs":  # as much as the MV's whole range
        assert info[0].abs() == pytest.approx(float(law.high - law.low), rel=1e-6)
