"""The local model network against its plant, and its validity functions against what they must be."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from henson_seborg_cstr_parts import POINTS, local_models
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.cases.henson_seborg_cstr.plant import HensonSeborgCstr
from loopwright.pipeline.errors import ModelError
from loopwright.pipeline.models import load_model
from loopwright.pipeline.models.local_models import LocalModels, Validity, spacing
from loopwright.pipeline.models.local_models_part import LocalModelsPart, free_run, operating_cv
from loopwright.pipeline.models.part import Source

EXPECTED = [  # C, T, q_c solved exactly
    (0.129825, 432.949, 110.0),
    (0.08506, 442.0, 98.984),
    (0.05854, 450.0, 88.324),
    (0.02947, 465.0, 68.791),
    (0.01463, 481.0, 50.438),
]
A1_A0_B = [  # of the transfer functions b/(s^2 + a1 s + a0) per minute
    (0.5162, 6.876, 0.0380),
    (4.379, 14.02, 0.0428),
    (9.667, 22.87, 0.0463),
    (26.65, 48.30, 0.0516),
    (61.34, 94.31, 0.0558),
]


@pytest.fixture(scope="module")
def plant() -> HensonSeborgCstr:
    return HensonSeborgCstr()


@pytest.fixture(scope="module")
def model(plant) -> LocalModels:
    return local_models(plant)


@pytest.fixture(scope="module")
def learnt(plant):
    part = LocalModelsPart(points=POINTS, mv_low=50.0, mv_high=110.0, mv_step=10.0, sizes=(3, 5))
    return part.learn(Source(None, plant.signals, plant=plant))


def test_operating_points_and_widths(model):
    found = np.hstack([model.x.numpy(), model.mv.numpy()])
    assert found == pytest.approx(np.array(EXPECTED), rel=1e-4)
    assert model.width.numpy() == pytest.approx([0.0134, 0.0107, 0.0083, 0.0066, 0.0045], abs=5e-5)


def test_local_transfer_functions(model):
    for lin, (a1, a0, b) in zip(model.linearizations(), A1_A0_B, strict=True):
        a = 60 * lin.a
        assert (-np.trace(a), np.linalg.det(a)) == pytest.approx((a1, a0), rel=3e-4)
        assert a[0, 1] * 60 * lin.b[1, 0] == pytest.approx(b, abs=6e-5)
        assert lin.b[0, 0] == 0.0  # relative degree two


@given(cv=st.floats(-1e3, 1e3))
@settings(max_examples=100, deadline=None)
def test_weights_are_a_partition_of_one(cv):
    validity = Validity(torch.tensor([0.1, 0.3, 0.2]).double(), torch.tensor([0.05, 0.02, 0.03]).double())
    rho = validity(torch.tensor([cv], dtype=torch.float64))
    assert (rho >= 0).all()
    assert float(rho.sum()) == pytest.approx(1.0, abs=1e-12)


def test_weights_are_the_normalized_gaussians(model):
    cv = np.linspace(0.01, 0.14, 40)
    z = np.exp(-0.5 * ((cv[:, None] - model.x[:, 0].numpy()) / model.width.numpy()) ** 2)
    rho = model.validity()(torch.from_numpy(cv)[:, None]).numpy()
    assert rho == pytest.approx(z / z.sum(axis=1, keepdims=True), abs=1e-12)


def test_one_local_model_is_exact_at_its_point_and_alone_far_from_the_others(plant):
    cvs = [0.02, 0.12]
    model = LocalModels.at_set_points(plant, cvs, 0.05)  # so narrow that they do not overlap
    for cv in cvs:
        x, mv = plant.steady_state_at(cv)
        phi, gamma = plant.linearize(x, mv).sampled(plant.period_s)
        dx, du = np.array([1e-3, 0.5]), np.array([2.0])
        got = model(torch.from_numpy(np.concatenate([x + dx, mv + du]))).numpy()
        assert got == pytest.approx(x + phi @ dx + gamma @ du, rel=1e-12)


def test_free_run_follows_the_staircase(learnt):
    m = learnt.metrics
    assert m["staircase"]["fit_C"] >= 96.0
    assert m["staircase"]["fit_T"] >= 98.0
    assert m["staircase"]["largest_error"] == pytest.approx(0.0091, abs=2e-4)
    assert m["up_down"]["fit_C"] > 94.0
    assert m["random"]["fit_C"] > 93.0


def test_it_is_only_roughly_right_between_its_points(learnt):
    assert learnt.metrics["steady_error"] == pytest.approx(-0.054, abs=2e-3)


def test_predictions_are_the_staircase_of_both(learnt, plant):
    curves = learnt.predictions
    assert curves["actual"].shape == curves["predicted"].shape == (7 * 500, 2)
    assert curves["predicted"] == pytest.approx(free_run(learnt.model, curves["actual"][0], curves["mv"]), abs=0)


def test_fewer_models_fit_worse(learnt):
    assert learnt.metrics["sizes"]["3"] < learnt.metrics["sizes"]["5"] - 5


def test_file_gives_the_same_model_back(model, tmp_path):
    model.save(tmp_path / "m.npz")
    again = load_model(tmp_path / "m.npz")
    z = torch.tensor([[0.1, 440.0, 100.0], [0.02, 470.0, 60.0]], dtype=torch.float64)
    assert torch.equal(again(z), model(z))


def test_spacing_is_the_mean_distance_to_the_neighbours():
    assert spacing(np.array([3.0, 0.0, 1.0])) == pytest.approx([2.0, 1.0, 1.5])


@pytest.mark.parametrize("point", [{"q_c": 300.0}, {"T": 442.0, "q_c": 99.0}, {"p": 1.0}, {}])
def test_an_operating_point_that_is_none_is_an_error(plant, point):
    with pytest.raises(ModelError, match=r"operating point|steady states"):
        operating_cv(plant, point)


def test_senseless_networks_are_errors(plant):
    with pytest.raises(ModelError, match="two or more different points"):
        LocalModels.at_set_points(plant, [0.1, 0.1], 0.3)
    with pytest.raises(ModelError, match="overlap"):
        LocalModels.at_set_points(plant, [0.1, 0.05], 0.0)
    with pytest.raises(ModelError, match="widths"):
        Validity(torch.zeros(2).double(), torch.zeros(2).double())
