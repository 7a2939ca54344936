"""The observer laws over an identified model: the horizon and the observed PV that they choose, and their loops."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch
from identified_models import first_order, made_signals, scaled_model
from shipped import required

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.laws.inverse.from_identified import (
    CALM_EIGENVALUE,
    CLEAR_OVER_NOISE,
    HorizonChoice,
    linearized,
)
from loopwright.pipeline.laws.inverse.inverse_dob import ObserverLaw
from loopwright.pipeline.laws.suitability import require_fit
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.manifest import Signal

NAMES = ["inverse_dob", "forward_dob"]
LEVEL, JACKET = Signal("y", "m", -3.0, 3.0), Signal("jacket", "K", -2.0, 2.0)
SIGNALS = Signals(1.0, (LEVEL,), (LEVEL, JACKET), (), (Signal("u", "V", -1.0, 1.0),))
NOISE = 0.03
NUMBERS = {**required("inverse_dob"), "observer_gain": 0.3, "band": 0.1}


def cascade(dead: int, noise: tuple[float, float] = (NOISE, NOISE)) -> Identified:
    """The MV moves the jacket at once, and the jacket the level, gain 2, after ``dead`` further periods."""
    n = 2 + dead
    a, b, rest = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((n, 4))
    a[0, 0], a[1, 1], b[1, 0] = 0.9, 0.6, 0.4
    a[0, -1] += 0.2
    for i in range(dead):
        a[2 + i, 1 + i] = 1.0
    rest[0, 0], rest[1:, 1] = 1.0, 1.0
    return scaled_model(2, 1, 0, n, a=a, b=b, rest=rest, noise=np.array(noise), dead=np.array([float(dead)]))


def chosen(model: Identified, signals: Signals = SIGNALS) -> HorizonChoice:
    return HorizonChoice.of(model, signals, None, None)


def designed(name: str, model: Identified, signals: Signals = SIGNALS, **params: Any) -> ObserverLaw:
    law = LAWS[name].design(LAWS[name].Params(**{**NUMBERS, **params}), {"identified": model}, signals, None).eval()
    assert isinstance(law, ObserverLaw)
    return law


def loop(law: ControlLaw, model: Identified, sp: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """CV and MV (n,) under an unmeasured load at the MV."""
    x, state = torch.zeros(model.n_x, dtype=torch.float64), torch.zeros(law.n_state, dtype=torch.float64)
    mv, rows = torch.zeros(1, dtype=torch.float64), []
    with torch.no_grad():
        for r, d in zip(sp, load, strict=True):
            pv = model.measured(x)
            mv, state, _ = law(torch.tensor([r]), pv, torch.zeros(0), mv, state)
            rows.append((float(pv[0]), float(mv[0])))
            x = model(torch.cat([x, mv + d]))
    y, u = np.array(rows).T
    return y, u


@pytest.mark.parametrize("dead", [0, 1, 4])
def test_the_horizon_reaches_beyond_the_dead_time_and_its_loop_is_calm(dead: int) -> None:
    found = chosen(cascade(dead))
    assert found.horizon >= dead + 2  # the level answers the jacket one period later, and then the dead time passes
    assert found.radius <= CALM_EIGENVALUE
    assert found.clearness >= CLEAR_OVER_NOISE
    assert chosen(cascade(dead + 1)).horizon > found.horizon


@pytest.mark.parametrize(("pole", "noise"), [(0.5, 0.01), (0.9, 0.01), (0.9, 0.1), (0.98, 0.01)])
def test_of_a_lag_the_horizon_is_the_first_with_a_clear_answer(pole: float, noise: float) -> None:
    """A lag's answer to half the range after h periods is gain (1 - pole^h), and every inverse of it is calm."""
    model = first_order(pole)
    model.noise[:] = noise
    answer = 2.0 * (1 - pole ** np.arange(1, 201))
    assert chosen(model, made_signals()).horizon == 1 + int((answer >= CLEAR_OVER_NOISE * noise).argmax())


def test_the_observed_pv_is_the_one_that_answers_best_beside_its_noise() -> None:
    assert SIGNALS.pv[chosen(cascade(0)).observed].name == "jacket"
    assert chosen(cascade(0)).ratios == pytest.approx([0.0, 0.4 / NOISE], abs=1e-6)
    model = first_order()
    both = scaled_model(
        2, 1, 0, 2, a=np.diag([0.9, 0.6]), b=np.array([[0.2], [0.4]]), rest=np.eye(2, 4), noise=np.array([0.01, 0.03])
    )
    assert chosen(both).observed == 0  # 20 standard deviations against 13
    assert chosen(model, made_signals()).observed == 0


def test_an_inverse_response_is_looked_past() -> None:
    """-0.1 after one period, and a steady gain of 3: an inverse over the first periods would run away."""
    a, b = np.array([[0.9, 0.2], [0.0, 0.5]]), np.array([[-0.1], [0.5]])
    model = scaled_model(1, 1, 0, 2, a=a, b=b, rest=np.eye(2, 3))
    matrix, column = linearized(model, made_signals())
    np.testing.assert_allclose(matrix, a, atol=1e-9)
    np.testing.assert_allclose(column, b[:, 0], atol=1e-9)
    x, answers = np.zeros(2), []
    for _ in range(60):
        x = a @ x + b[:, 0]
        answers.append(x[0])
    found = chosen(model, made_signals())
    assert answers[found.horizon - 1] * answers[-1] > 0
    assert found.radius <= CALM_EIGENVALUE


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dead", [0, 1, 4])
def test_loops_reach_their_set_points_and_reject_a_load(name: str, dead: int) -> None:
    model = cascade(dead)
    law = designed(name, model)
    sp, load = np.repeat([0.8, -1.0, 0.4, 0.4], 80), np.repeat([0.0, 0.0, 0.0, 0.3], 80)
    y, u = loop(law, model, sp, load)
    for end in (79, 159, 239, 319):
        assert abs(y[end] - sp[end]) < 0.02  # of a range of 6
    assert np.abs(np.diff(u)[-20:]).max() < 0.02  # at rest at the end: nothing rings
    plain, _ = loop(law, model, np.full(160, 0.4), np.zeros(160))
    assert abs(plain[-1] - 0.4) < 0.02


@pytest.mark.parametrize("name", NAMES)
def test_explicit_values_win_and_the_report_is_told(name: str) -> None:
    law = designed(name, cascade(0))
    (note,), figures = law.analysis(None).notes, law.analysis(None).figures
    assert figures["horizon"] == law.choice.horizon
    assert f"The law looks {law.choice.horizon} periods ahead" in note
    assert "Disturbances are observed on jacket, whose answer within one period is 13.3" in note
    other = designed(name, cascade(0), horizon=9, observed="y")
    assert (other.choice.horizon, other.choice.observed, other.observed) == (9, 0, 0)
    assert "The law looks 9 periods ahead" in other.analysis(None).notes[0]
    with pytest.raises(LawError, match=re.escape("observed is 'T'; the process variables are y, jacket")):
        designed(name, cascade(0), observed="T")
    with pytest.raises(ValueError, match="horizon is 0; give 1 to 200 periods"):
        LAWS[name].Params(**NUMBERS, horizon=0)


@pytest.mark.parametrize("name", NAMES)
def test_parts_of_the_law_s_own_come_first(name: str, parts: dict[str, Any], signals: Signals) -> None:
    cls = LAWS[name]
    assert cls.needs(cls.Params(**NUMBERS), ["identified"]) == ("identified",)
    assert set(cls.needs(cls.Params(**NUMBERS), [*cls.parts, "identified"])) == set(cls.parts)
    assert set(cls.needs(cls.Params(**NUMBERS), ["identified", "forward"])) == set(cls.parts)
    assert not cls.design(cls.Params(**NUMBERS), parts, signals, None).analysis(None).notes
    with pytest.raises(LawError, match="horizon is 4, but the set has parts of the law's own; give `horizon` to its"):
        cls.design(cls.Params(**NUMBERS, horizon=4), parts, signals, None)


def plant(model: Identified, signals: Signals) -> IdentifiedPlant:
    names = ("a", "b", "c", "w1", "b1", "w2", "y_center", "y_scale", "v_center", "v_scale", "rest")
    return IdentifiedPlant(signals, IdentifiedArrays(**{name: getattr(model, name).numpy() for name in names}))


@pytest.mark.parametrize("name", NAMES)
def test_it_is_withheld_where_no_pv_answers_at_once(name: str) -> None:
    for dead in (0, 1, 4):
        require_fit(LAWS[name], plant(cascade(dead), SIGNALS))
    require_fit(LAWS[name], plant(first_order(), made_signals()))
    words = f"law '{name}' is withheld: no PV answers within 1 sample after u0 moves (y0 answers after 5), and the law"
    with pytest.raises(LawError, match=re.escape(words)):
        require_fit(LAWS[name], plant(first_order(dead=4), made_signals()))
