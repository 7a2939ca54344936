"""The loads of the predictive law with ``operate`` are those of its record: where they act, and how they change."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from identified_models import made_signals, random_model
from predictive_loops import law_of, row
from scipy import linalg

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.predictive import tuning
from loopwright.pipeline.laws.predictive.disturbance_model import recorded_changes
from loopwright.pipeline.laws.predictive.observer import NOISE_FLOOR
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.models.identified.dynamics import Dynamics, Stretch
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.identified.innovations import load_moves, with_loads

TOGETHER = np.array([[1.0, -0.8], [-0.8, 1.0]]) * 1e-4  # covariance of two loads' changes, scaled


def with_moves(model: Identified, moves: np.ndarray) -> Identified:
    """The model with these changes (n, n_y) of its record's loads."""
    return Identified.from_arrays(
        {**model.config(), "recorded": len(moves)},
        {name: value.numpy() for name, value in model.state_dict().items()} | {"load_moves": moves},
    )


def recorded(n_mv: int = 2) -> Identified:
    drawn = np.random.default_rng(5).multivariate_normal([0.0, 0.0], TOGETHER, 4_000)
    return with_moves(random_model(3, n_y=2, n_mv=n_mv), drawn)


def test_what_a_filter_foresees_of_loads_changes_as_much_as_they_do() -> None:
    """P = A P A' + Q - L S L', and a load keeps its row: the covariance of its estimate's changes is Q."""
    rng, n, noise = np.random.default_rng(0), 60_000, 0.1
    none = np.zeros((2, 0))
    plant = Dynamics(np.diag([0.9, 0.8]), np.zeros((2, 1)), np.zeros(2), np.zeros((0, 3)), np.zeros(0), none)
    model = with_loads(plant, 2)
    c, q = np.eye(2, 4), linalg.block_diag(np.zeros((2, 2)), TOGETHER)
    p = linalg.solve_discrete_are(model.a.T, c.T, q, noise**2 * np.eye(2))
    gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + noise**2 * np.eye(2))
    x, y = np.zeros(4), np.empty((n, 2))
    changes = rng.multivariate_normal([0.0, 0.0], TOGETHER, n)
    for k in range(n):
        y[k] = x[:2] + noise * rng.standard_normal(2)
        x = model.a @ x + np.r_[0.0, 0.0, changes[k]]
    moves = load_moves(
        type(model)(model.a, model.b, model.c, model.w1, model.b1, model.w2, gain), [Stretch(y, np.zeros((n, 1)))]
    )
    found = recorded_changes(with_moves(random_model(3, n_y=2, n_mv=2), moves)).numpy()
    np.testing.assert_allclose(found, np.diag(TOGETHER), rtol=0.05)


def test_a_law_with_operate_takes_its_loads_from_the_record_and_no_other_does() -> None:
    model = recorded()
    operated, plain, stated = (law_of(model, horizon=20, **p) for p in ({"operate": {}}, {}, {"loads": "mvs"}))
    assert operated.info[:2] == ("load_y0", "load_y1")
    assert plain.info[:2] == ("load_u0", "load_u1")
    for name, values in stated.state_dict().items():
        torch.testing.assert_close(plain.state_dict()[name], values, rtol=0, atol=0)
    without = law_of(random_model(3, n_y=2, n_mv=2), horizon=20, operate={})
    assert without.info[:2] == ("load_u0", "load_u1")
    own = law_of(model, horizon=20, operate={}, loads="mvs", caution=2.0)
    assert own.info[:2] == ("load_u0", "load_u1")


@pytest.mark.parametrize("caution", [1.0, 2.0])
def test_its_filter_has_the_records_changes_beside_the_usual_ones(caution: float) -> None:
    model = recorded()
    usual, law = (law_of(model, horizon=20, operate={}, loads=at, caution=caution) for at in ("outputs", "record"))
    n = law.observer.n_x
    beside = recorded_changes(model) / caution**2
    for name in ("q", "q_load"):
        before, after = (getattr(of.observer, name) for of in (usual, law))
        torch.testing.assert_close(after[n:, n:], before[n:, n:] + torch.diag(beside))
        torch.testing.assert_close(after[:n], before[:n], rtol=0, atol=0)
        assert float(before[n:, n:].diagonal().min()) > 0  # a load that the record never had is still found
    r = torch.clamp(model.noise, min=NOISE_FLOOR) ** 2
    torch.testing.assert_close(law.observer.place, usual.observer.place)
    assert float((beside / r).min()) > 0


def test_loads_that_moved_together_leave_no_offset_under_one_that_moves_alone() -> None:
    one = np.random.default_rng(2).normal(size=(2_000, 1)) * np.array([[0.01, -0.01]])
    model = with_moves(random_model(3, n_y=2, n_mv=2), one)
    law, x = law_of(model, horizon=20, operate={}), torch.zeros(model.n_x, dtype=torch.float64)
    state, mv = torch.zeros(law.n_state, dtype=torch.float64), row(0.0, 0.0)
    sp = model.measured(x)[:2] * 0.0
    with torch.no_grad():
        for _ in range(400):
            y = model.measured(x)
            mv, state, _ = law(sp, y, row(), mv, state)
            x = model(torch.cat([x, mv]))
            x[0] += 0.01
    assert (mv.abs() < 1).all()
    np.testing.assert_allclose(y.numpy(), sp.numpy(), atol=2e-3)


def test_a_search_moves_laws_with_the_loads_that_they_will_have(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[Any] = []

    def stands(trials: Any, law_of: Any, start: dict[str, float], damping: float | None) -> tuning.TunedLaw:
        law_of(start, damping)
        return tuning.TunedLaw(dict(start), damping, ())

    monkeypatch.setattr(tuning, "tuned", stands)
    params = Predictive.Params(operate={}, changes=3, tuning="search")
    found = tuning.searched_params(tried.append, recorded(), made_signals(2, 2), params, 12)
    assert [(p.operate, p.loads) for p in tried] == [(None, "record")]
    assert found.params.operate == {}


def test_a_record_without_loads_is_said() -> None:
    with pytest.raises(LawError, match="'record'"):
        law_of(random_model(3, n_y=2, n_mv=2), loads="record")
    with pytest.raises(ValueError, match="mvs, outputs, record"):
        Predictive.Params(loads="record's")
