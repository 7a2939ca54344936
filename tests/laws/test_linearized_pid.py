"""The linearized PID against its formulas, sample by sample."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from law_loops import closed, sse
from nnarx_loops import designed, info, trained
from scipy.stats import chi2

from loopwright.pipeline.cases.ph_neutralization.case import PhNeutralizationCase
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ParamsError
from loopwright.pipeline.excitation import EXCITATIONS
from loopwright.pipeline.export.fusion import fused
from loopwright.pipeline.export.graph import law_graph
from loopwright.pipeline.laws.base import ControlLaw, in_units
from loopwright.pipeline.laws.gain_update import gain_update
from loopwright.pipeline.laws.linearized import LinearizedPid
from loopwright.pipeline.models.lagged.instantaneous import linearize
from loopwright.pipeline.models.lagged.lagged import NNARX

PH = PhNeutralizationCase()
UNIT = 100.0  # [ml/min] half the range of the base flow


def scenario(name: str):
    return PH.scenarios()[name][0]


@pytest.fixture(scope="module")
def model() -> NNARX:
    return trained(PH.plant, EXCITATIONS["random_steps"](samples=2000, hold=3), lags=2)


def ph_law(model: NNARX, **params) -> ControlLaw:
    return designed("linearized_pid", model, PH.plant, **params)


ADAPTIVE = {"adaptive": True, "penalty_start": 20.0, "penalty_low": 0.1, "eps_high": 0.2, "eps_low": 0.05}


class Plain:
    """The law as the formulas stand: plain Python, one sample at a time, the penalty doubled in a loop."""

    def __init__(self, model: NNARX, start: np.ndarray, **params) -> None:
        self.model, self.z = model, start
        self.p = in_units(LinearizedPid.Params(**params), PH.plant.signals, "linearized_pid")
        self.past, self.change, self.squares = None, np.zeros(3), []
        (self.mu, self.mu_low), self.offset = self.p.penalties, None

    def network(self, y, u) -> float:
        with torch.no_grad():
            return float(self.model(torch.tensor([*y, *u], dtype=torch.float64)))

    def gains(self, rho, v, c) -> np.ndarray:
        p = self.p
        numbers = (self.z, rho, [v], [c], [p.stiffness], p.weights, p.gain_low, p.gain_high, [1.0])
        return gain_update(*(torch.tensor(np.asarray(n, dtype=float)) for n in numbers)).numpy()

    def __call__(self, r, y, u) -> dict[str, float]:
        p, e, first = self.p, r - y, self.past is None
        y1, y2, u2, e1, e2, r1 = (y, y, u, e, e, r) if first else self.past
        surprise = y - self.network((y1, y2), (u, u2))
        alpha = 1.0 if first else p.offset_filter
        self.offset = alpha * surprise + (1 - alpha) * (self.offset or 0.0)
        lag = y if first else y - (1 - p.trust) * surprise
        goal = 2 * r - r1 if p.preview == "ramp" else r
        y_ahead = (lag, y1)
        phi = torch.tensor([*y_ahead, u, u], dtype=torch.float64)
        b = UNIT * float(linearize(self.model, phi).slopes[2])
        y0 = self.network(y_ahead, (u, u)) + self.offset
        rho = np.array([e - e1, (e + e1) / 2, e - 2 * e1 + e2])

        def error(du: float) -> float:
            return abs(self.network(y_ahead, (u + UNIT * du, u)) + self.offset - y0 - b * du)

        self.squares = [*self.squares, e * e][-(p.window or 1) :]
        loud = not p.window or sum(self.squares) > p.noise_variance * chi2.ppf(0.99, p.window)
        told = {"penalty": self.mu, "free": b > p.slope_min and loud}
        mu = self.mu if p.adaptive else p.penalty
        for _ in range(13):
            z = self.gains(rho, b * (goal - y0) / (b * b + mu), b * b + mu)
            found = error(rho @ z)
            if not p.adaptive or found <= p.eps_high:
                break
            mu, last = 2 * mu, mu
        else:
            mu = last
        if told["free"]:
            self.change = p.momentum * self.change + (1 - p.momentum) * (z - self.z)
            self.z = np.clip(self.z + self.change, p.gain_low, p.gain_high)
            self.mu = max(mu / 2, self.mu_low) if found < p.eps_low else mu
            told["penalty"] = mu
        else:
            self.change = np.zeros(3)
        self.past = (lag, y1, u, e, e1, r)
        return {
            **told,
            "mv": float(np.clip(u + UNIT * rho @ self.z, 850.0, 1050.0)),
            "offset": self.offset,
            "b": b / UNIT,
        }


FORMS = [
    {},
    {"penalty": 0.1, "stiffness": 0.5, "weights": (1.0, 0.2, 3.0), "gain_high": (0.6, 0.4, 0.5)},
    {"preview": "ramp", "offset_filter": 0.4, "trust": 0.3},
    {"momentum": 0.4, "window": 4, "noise_variance": 0.01},
    ADAPTIVE,
    {**ADAPTIVE, "eps_high": 0.03, "eps_low": 0.01, "momentum": 0.2, "window": 1, "noise_variance": 0.01},
    {
        "adaptive": True,
        "eps_high": 1e-4,
        "eps_low": 1e-5,
        "penalty_start": 0.05,
        "penalty_low": 0.02,
    },  # all doublings are used up
]


@pytest.mark.parametrize("params", FORMS, ids=str)
def test_equals_the_formulas_as_they_stand(model: NNARX, params: dict) -> None:
    law = ph_law(model, gains=(0.5, 0.3, 0.1), **params)
    plain = Plain(model, np.array([0.5, 0.3, 0.1]), **params)
    told = []
    track = closed(law, PH, scenario("set_point"), noise=0.02, seed=3)
    applied = np.concatenate([scenario("set_point").mv0, track.mv[:-1, 0]])
    for r, y, u in zip(track.sp[:, 0], track.measured[:, 0], applied, strict=True):
        told.append(plain(r, y, u))
    ours, theirs = info(law, track), {name: np.array([row[name] for row in told]) for name in told[0]}
    np.testing.assert_allclose(track.mv[:, 0], theirs["mv"], rtol=0, atol=1e-7)
    np.testing.assert_allclose(ours["offset"], theirs["offset"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours["b1"], theirs["b"], rtol=1e-9)
    np.testing.assert_array_equal(ours["updated"], theirs["free"])
    if "adaptive" in params:
        np.testing.assert_allclose(ours["penalty"], theirs["penalty"], rtol=1e-12)
    if "window" in params:
        assert 0 < theirs["free"].mean() < 1


def test_the_penalty_adapts(model: NNARX) -> None:
    law = ph_law(model, **ADAPTIVE)
    track = closed(law, PH, scenario("set_point"))
    found = info(law, track)
    assert sse(track) < 9.0  # the fixed penalty of 20 from which it starts: 43.4
    assert (found["linearization_error"] <= 0.2).all()
    assert found["penalty"][24] == pytest.approx(0.1)  # at rest
    assert found["penalty"][25] > 0.5  # after the set point's jump


def test_sign_that_is_given_goes_before_the_models(model: NNARX) -> None:
    up, down = (ph_law(model, plant_gain=sign, gains=(0.5, 0.2, 0.1)) for sign in ("positive", "negative"))
    inputs = [torch.tensor([v], dtype=torch.float64) for v in (8.0, 7.5)]
    applied, state = torch.tensor([930.0], dtype=torch.float64), torch.zeros(up.n_state, dtype=torch.float64)
    with torch.no_grad():
        first, second = (law(*inputs, torch.zeros(0), applied, state) for law in (up, down))
    assert first[0] > applied > second[0]
    # In the wrong sign every slope fails the guard: the gains stay.
    assert info_of(down, second)["updated"] == 0
    torch.testing.assert_close(second[0], applied - UNIT * 0.2 * 0.5)


def info_of(law: ControlLaw, step: tuple[torch.Tensor, ...]) -> dict[str, float]:
    return dict(zip(law.info, step[2].tolist(), strict=True))


def test_guard_keeps_the_gains(model: NNARX) -> None:
    law = ph_law(model, slope_min=1e6, gains=(0.4, 0.2, 0.1), momentum=0.5)
    track = closed(law, PH, scenario("set_point"))
    found = info(law, track)
    assert (found["updated"] == 0).all()
    np.testing.assert_allclose(found["kc"], 0.4 * UNIT)
    np.testing.assert_allclose(found["tau_i_s"], 0.4 / 0.2 * 60)
    np.testing.assert_allclose(found["tau_d_s"], 0.1 / 0.4 * 60)
    e = (track.sp - track.pv)[:, 0]
    e1, e2 = (np.concatenate([np.full(k, e[0]), e[:-k]]) for k in (1, 2))
    du = 0.4 * (e - e1) + 0.2 * (e + e1) / 2 + 0.1 * (e - 2 * e1 + e2)
    applied = np.concatenate([scenario("set_point").mv0, track.mv[:-1, 0]])
    np.testing.assert_allclose(track.mv[:, 0], np.clip(applied + UNIT * du, 850, 1050), rtol=0, atol=1e-9)


def test_first_gains_are_the_pid_that_the_central_model_asks_for(model: NNARX) -> None:
    """A linear model of two lags makes the minimum-variance law a PID: its gains give the same move."""
    law = ph_law(model, penalty=1.0, slope_min=1e6, gain_high=(100.0,) * 3)
    kc, ki, kd = law.gains.slots["gains"].start.tolist()
    slopes = linearize(model, model.net.x_center).slopes
    a1, a2, b = -float(slopes[0]), -float(slopes[1]), UNIT * float(slopes[2])
    e, e1, e2 = 0.3, 0.5, -0.2  # at a held set point, y(t-i) = r - e_i; MV at rest
    y0_below_r = e - a1 * (e - e1) - a2 * (e1 - e2)
    du = b * y0_below_r / (b**2 + 1.0)
    assert kc * (e - e1) + ki * (e + e1) / 2 + kd * (e - 2 * e1 + e2) == pytest.approx(du)


def test_an_mv_that_was_not_obeyed_is_no_windup(model: NNARX) -> None:
    """Stuck at its limit for long, the loop comes back as from a cold start there."""
    law = ph_law(model, stiffness=1e-9)
    r, stuck = torch.tensor([8.0], dtype=torch.float64), torch.tensor([850.0], dtype=torch.float64)
    state = torch.zeros(law.n_state, dtype=torch.float64)
    with torch.no_grad():
        for _ in range(60):
            _, state, _ = law(r, torch.tensor([6.0], dtype=torch.float64), torch.zeros(0), stuck, state)
        after, *_ = law(r, r, torch.zeros(0), stuck, state)
    assert after <= 1050.0
    assert abs(float(after) - 850.0) < 200.0  # an integral of sixty errors of 2 would be at the other end


@pytest.mark.parametrize(
    ("params", "most"),
    [
        ({}, 100),
        (ADAPTIVE, 120),
        ({**ADAPTIVE, "momentum": 0.4, "window": 5, "noise_variance": 1.0}, 150),
    ],
)
def test_few_operators(model: NNARX, params: dict, most: int) -> None:
    graph, _ = law_graph(ph_law(model, **params))
    assert len(fused(graph).graph.node) <= most


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"penalty": 0.0}, "penalty is 0"),
        ({"stiffness": -1.0}, "stiffness"),
        ({"weights": [1.0, 0.0, 1.0]}, "weights"),
        ({"gain_low": [1.0, 0.0, 0.0], "gain_high": [1.0, 1.0, 1.0]}, "gain_low"),
        ({"momentum": 1.0}, "momentum"),
        ({"window": 0, "noise_variance": 1.0}, "window"),
        ({"window": 5}, "belong together"),
        ({"window": 5, "noise_variance": 0.0}, "noise_variance"),
        ({"offset_filter": 0.0}, "offset_filter"),
        ({"trust": 1.5}, "trust"),
        ({"preview": "known"}, "preview"),
        ({"penalty": 20.0, "penalty_low": 30.0}, "penalty_low"),
        ({"eps_low": 0.3}, "eps_low"),
        ({"adaptive": True}, "eps_high"),
        ({"penalti": 1.0}, "did you mean 'penalty'"),
    ],
)
def test_wrong_numbers_are_named(values: dict, said: str) -> None:
    with pytest.raises(ParamsError, match=said):
        parse(LinearizedPid.Params, values, "linearized_pid")
