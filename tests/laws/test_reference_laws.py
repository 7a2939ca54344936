"""Laws that follow a reference model: their theory, their training, and closed loops over the reversible CSTR."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reversible_cstr_parts
import torch
from torch import Tensor

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.reversible_cstr.plant import ReversibleCstr
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws import LAWS, ControlLaw
from loopwright.pipeline.laws.reference.model_reference import ModelReference, ModelReferenceTwoError
from loopwright.pipeline.laws.reference.pi_reference import PiReference
from loopwright.pipeline.laws.reference.reference_law import Loops, PlantNetwork, Training
from loopwright.pipeline.laws.reference.reference_networks import (
    IncrementalNetwork,
    Trainable,
    TrainablePi,
    TwoErrorNetwork,
)
from loopwright.pipeline.laws.reference.reference_training import follow, train
from loopwright.pipeline.models.state_space import StateSpace
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.simulate import Trajectory, simulate_closed
from loopwright.pipeline.tuning.reference_model import ReferenceModel
from loopwright.pipeline.tuning.rules import AllPole

CASE = CASES["reversible_cstr"]
TRAINING = Training(noise=0.002, restarts=1, iterations=20, lanes=27)


@pytest.fixture(scope="module")
def reactor() -> EquationPlant:
    return CASE.plant


@pytest.fixture(scope="module")
def network(reactor: EquationPlant) -> StateSpace:
    model = reversible_cstr_parts.parts(reactor)["state_space"]
    assert isinstance(model, StateSpace)
    return model


@pytest.fixture(scope="module")
def signals(reactor: EquationPlant) -> Signals:
    return reactor.signals


def policies(signals: Signals, order: int = 2) -> list[Trainable]:
    return [
        IncrementalNetwork(signals, order, -1.0, 5),
        TwoErrorNetwork(signals, order, -1.0, 5),
        TrainablePi(signals, order, -1.0),
    ]


@pytest.fixture(scope="module")
def trained(reactor: EquationPlant, network: StateSpace, signals: Signals) -> dict[str, ControlLaw]:
    """Each law, trained for about a second."""
    made = {}
    for cls in (ModelReference, ModelReferenceTwoError, PiReference):
        params: Any = cls.Params(wn=0.05, training=TRAINING if cls is not PiReference else replace(TRAINING, decay=0.0))
        made[cls.name] = cls.design(params, {"state_space": network}, signals, reactor).eval()
    return made


def run(
    law: ControlLaw, name: str, noise: bool = False, plant: EquationPlant | None = None
) -> tuple[Trajectory, dict[str, float]]:
    """One of the case's tests through the torch module."""
    test = CASE.scenarios()[name][0]
    state = torch.zeros(law.n_state, dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.float64)

    def step(sp: np.ndarray, pv: np.ndarray, mv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal state
        with torch.no_grad():
            moved, state, info = law(torch.from_numpy(sp), torch.from_numpy(pv), none, torch.from_numpy(mv), state)
        return moved.numpy(), info.numpy()

    loop = simulate_closed(plant or CASE.plant, step, test, noise=CASE.noise_std if noise else None, seed=5)
    return loop, CASE.score(test, loop.pv, loop.mv)


# ---------------------------------------------------------------- derivatives
@pytest.mark.parametrize("which", range(3))
def test_an_actions_derivatives_are_those_of_its_mv(signals: Signals, which: int) -> None:
    policy = policies(signals)[which]
    rng = np.random.default_rng(1)
    theta = policy.drawn(rng)
    assert theta.shape == (policy.size,)
    seen = np.column_stack([rng.uniform(0.3, 0.6, (7, 2)), rng.uniform(1, 5, 7), rng.normal(0, 0.02, (7, 3))])
    seen[:, 4] = rng.uniform(0.3, 0.6, 7)
    action = policy.act(theta, seen)
    for column, slope in ((1, action.by_cv), (2, action.by_mv), (3, action.by_before)):
        step = np.zeros_like(seen)
        step[:, column] = 1e-6
        change = policy.act(theta, seen + step).mv - policy.act(theta, seen - step).mv
        np.testing.assert_allclose(slope, change / 2e-6, rtol=1e-6, atol=1e-6)
    for i in range(policy.size):
        step = 1e-6 * np.eye(policy.size)[i]
        change = policy.act(theta + step, seen).mv - policy.act(theta - step, seen).mv
        np.testing.assert_allclose(action.by_theta[:, i], change / 2e-6, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("which", range(3))
def test_sensitivities_through_time_are_the_gradient(network: StateSpace, signals: Signals, which: int) -> None:
    """J'r of the loops is minus half the gradient of their sum of squares; a wrong one still lowers it somewhat."""
    policy, plant, model = policies(signals)[which], PlantNetwork(network), ReferenceModel.optimal(2, 0.05)
    options = Training(noise=0.002, lanes=6, holds=2, hold=15)
    loops = Loops.drawn(plant, signals, options, np.random.default_rng(3))
    theta = policy.drawn(np.random.default_rng(4))

    def cost(at: np.ndarray) -> float:
        return follow(policy, at, plant, model, loops, 0.02, derivatives=False).cost * loops.sp.size

    found = follow(policy, theta, plant, model, loops, 0.02).slope
    steps = 1e-6 * np.eye(policy.size)
    gradient = np.array([(cost(theta + d) - cost(theta - d)) / 2e-6 for d in steps])
    np.testing.assert_allclose(-2 * found, gradient, rtol=1e-4, atol=1e-6 * np.abs(gradient).max())


def test_the_plant_networks_jacobian_and_rest(network: StateSpace, reactor: EquationPlant) -> None:
    plant = PlantNetwork(network)
    x, u = np.array([[0.45, 415.0], [0.55, 395.0]]), np.array([[1.7], [0.6]])
    after, jac = plant.step(x, u)
    with torch.no_grad():
        expected = network(torch.from_numpy(np.hstack([x, u]))).numpy()
    np.testing.assert_allclose(after, expected, rtol=1e-12)
    for i in range(3):
        step = np.zeros((2, 3))
        step[:, i] = 1e-5
        change = plant.step(x + step[:, :2], u + step[:, 2:])[0] - plant.step(x - step[:, :2], u - step[:, 2:])[0]
        np.testing.assert_allclose(jac[:, i], change / 2e-5, rtol=1e-5, atol=1e-9)
    states, mvs = plant.steady_curve(np.array([0.45, 415.0]), np.linspace(0.5, 5.5, 6))
    for state, mv in zip(states, mvs, strict=True):
        np.testing.assert_allclose(state, reactor.steady_state_at(state[0])[0], rtol=2e-3)
        np.testing.assert_allclose(mv, reactor.steady_state_at(state[0])[1], rtol=2e-2)


@pytest.mark.parametrize("name", ["model_reference", "model_reference_two_error", "pi_reference"])
def test_the_law_acts_as_what_was_trained(trained: dict[str, ControlLaw], name: str, signals: Signals) -> None:
    """The law's stage and the training's arithmetic are two texts of one controller."""
    law = trained[name]
    rng = np.random.default_rng(2)
    rows = 50
    sp, cv, mv = rng.uniform(0.3, 0.6, (rows, 1)), rng.uniform(0.3, 0.6, (rows, 1)), rng.uniform(1, 5, (rows, 1))
    course = np.hstack([cv + rng.normal(0, 0.01, (rows, 1)), rng.normal(0, 0.02, (rows, 1))])
    before = rng.normal(0, 0.01, (rows, 1))
    state = np.hstack([np.ones((rows, 1)), course, before, mv])
    pv = np.hstack([cv, rng.uniform(380, 425, (rows, 1))])
    with torch.no_grad():
        out = law(*(torch.from_numpy(a) for a in (sp, pv, np.zeros((rows, 0)), mv, state)))[0].numpy()[:, 0]
    if isinstance(law, PiReference):
        policy: Trainable = TrainablePi(signals, 2, -1.0)
        assert law.trained is not None
        theta = law.trained.theta
    else:
        policy, theta = law.network, law.trained.theta  # type: ignore[union-attr, assignment]
    asked = policy.act(theta, np.hstack([sp, cv, mv, before, course])).mv
    low, high = signals.mv[0].low, signals.mv[0].high
    assert np.any((asked > low) & (asked < high))
    np.testing.assert_allclose(out, np.clip(asked, low, high), rtol=1e-9, atol=1e-9)


# ---------------------------------------------------------------- theory
def test_no_weights_give_the_network_in_velocity_form_another_root(signals: Signals) -> None:
    """At rest its move is zero for zero error alone, trained or not, even with weights far from any training."""
    rng = np.random.default_rng(7)
    for sign in (-1.0, 1.0):
        network = IncrementalNetwork(signals, 3, sign, 6)
        for scale in (0.0, 1.0, 3.0):
            theta = network.drawn(rng) + scale * rng.standard_normal(network.size)
            error = rng.uniform(-0.2, 0.2, 400)
            y, u = rng.uniform(0.3, 0.6, 400), rng.uniform(0.4, 5.9, 400)
            at_rest = np.column_stack([y + error, y, u, error, y + error, np.zeros((400, 2))])
            move = network.act(theta, at_rest).mv - u
            assert (move * error * sign > 0).all()
            none = at_rest.copy()
            none[:, [0, 4]], none[:, 3] = y[:, None], 0.0
            np.testing.assert_allclose(network.act(theta, none).mv, u, atol=1e-13)


def test_no_weights_free_the_two_error_network_of_offset(signals: Signals, reactor: EquationPlant) -> None:
    """Without errors it has one MV, but two set points have two steady ones."""
    network = TwoErrorNetwork(signals, 2, -1.0, 4)
    rng = np.random.default_rng(8)
    levels = np.array([0.36, 0.46, 0.54])
    no_error = np.column_stack([levels, levels, [4.0, 1.7, 0.7], np.zeros(3), levels, np.zeros(3)])
    for _ in range(5):
        mv = network.act(network.drawn(rng) + rng.standard_normal(network.size), no_error).mv
        assert np.ptp(mv) == pytest.approx(0, abs=1e-12)
    assert np.ptp([reactor.steady_state_at(level)[1][0] for level in levels]) > 2


def test_a_pi_on_the_reference_is_a_pi(signals: Signals) -> None:
    law = PiReference(signals, ReferenceModel.optimal(2, 0.05), -40.0, 8.0)
    state = torch.tensor([1.0, 0.45, 0.0, 0.004, 2.0], dtype=torch.float64)
    values = [torch.tensor(v, dtype=torch.float64) for v in ([0.46], [0.44, 410.0], [], [2.0])]
    mv, after, told = law(*values, state)
    assert float(mv) == pytest.approx(2.0 - 40.0 * ((0.01 - 0.004) + 2.0 / 8.0 * 0.01))
    assert float(told) == 0.45
    phi, gamma = law.model.sampled(2.0)
    np.testing.assert_allclose(after[1:3], phi @ [0.45, 0.0] + gamma[:, 0] * 0.46, rtol=1e-12)


def test_a_new_course_begins_where_nobody_followed(trained: dict[str, ControlLaw]) -> None:
    """In manual the reference model stays at the measured CV; within a hundredth of the range it was followed."""
    law = trained["model_reference"]
    state = torch.tensor([1.0, 0.50, 0.03, 0.01, 2.0], dtype=torch.float64)

    def told(applied: float) -> float:
        mv = torch.tensor([applied], dtype=torch.float64)
        sp, pv = torch.tensor([0.5], dtype=torch.float64), torch.tensor([0.42, 410.0], dtype=torch.float64)
        info: Tensor = law(sp, pv, torch.zeros(0, dtype=torch.float64), mv, state)[2]
        return float(info)

    assert told(2.0) == told(2.03) == 0.50
    assert told(2.5) == told(1.0) == 0.42


# ---------------------------------------------------------------- closed loops over the true plant
def test_the_network_follows_the_reference_model(trained: dict[str, ControlLaw]) -> None:
    """The reference's lines, a second's training after: 0.0015 and 0.002 mol/l RMS, 2e-4 offset, IAE 0.35."""
    law = trained["model_reference"]
    _, found = run(law, "levels")
    assert found["tracking"] <= 0.0015
    assert found["max_asse"] <= 2e-4
    assert 38.0 <= found["iae"] <= 40.0
    assert run(law, "levels", noise=True)[1]["tracking"] <= 0.002
    assert run(law, "tin")[1]["iae"] <= 0.35
    assert law.analysis(CASE.plant).figures["other_roots"] == 0


def test_two_errors_leave_an_offset_and_an_integral_none(trained: dict[str, ControlLaw]) -> None:
    plain, pi = (run(trained[name], "levels")[1] for name in ("model_reference_two_error", "pi_reference"))
    assert plain["max_asse"] > 5e-3
    assert plain["tracking"] > 0.003
    assert pi["max_asse"] < 1e-4
    assert pi["tracking"] <= 0.0015


def test_unseen_drift_is_brought_back(trained: dict[str, ControlLaw], reactor: EquationPlant) -> None:
    """Slower reactions, a hotter feed and more heat loss at once, all twelve levels, and noise on top."""
    assert isinstance(reactor, ReversibleCstr)
    drifted = replace(reactor, k1=0.85 * reactor.k1, k2=0.85 * reactor.k2, T_in=440.0, h=2.6e-3)
    law = trained["model_reference"]
    assert run(law, "levels", plant=drifted)[1]["tracking"] <= 0.005
    assert run(law, "levels", noise=True, plant=drifted)[1]["tracking"] <= 0.006


def test_the_printed_pid_and_its_sign(reactor: EquationPlant, signals: Signals) -> None:
    """Independent figures: IAE 53.5, ITAE 2582, RMS 0.0090; with the printed sign the valve stays at an end."""
    params = {"tuning": "manual", "ti_s": 7.875, "td_s": 2.5397}
    cls = LAWS["pid"]
    found = run(cls.design(cls.Params(**params, kc=-3.15), {}, signals, reactor), "levels")[1]
    assert found["iae"] == pytest.approx(53.5, rel=0.01)
    assert found["itae"] == pytest.approx(2582, rel=0.02)
    assert found["tracking"] == pytest.approx(0.0090, rel=0.05)
    wrong, figures = run(cls.design(cls.Params(**params, kc=3.15), {}, signals, reactor), "levels")
    assert figures["max_asse"] > 0.1
    assert np.mean(np.isclose(wrong.mv, 6.0) | np.isclose(wrong.mv, 1 / 3)) > 0.5


# ---------------------------------------------------------------- what cannot be
def test_clear_errors(network: StateSpace, signals: Signals, reactor: EquationPlant) -> None:
    with pytest.raises(LawError, match="part 'state_space'"):
        ModelReference.design(ModelReference.Params(wn=0.05), {}, signals, reactor)
    with pytest.raises(LawError, match="needs kc and ti_s"):
        PiReference.Params(wn=0.05, tuning="manual", kc=-4.0)
    with pytest.raises(LawError, match=r"ti_s of the PID is 0\.0"):
        PiReference.Params(wn=0.05, tuning="manual", kc=-4.0, ti_s=0.0)
    with pytest.raises(LawError, match=r"kc of the PID is 0\.0"):
        PiReference.Params(wn=0.05, tuning="manual", kc=0.0, ti_s=1.0)
    with pytest.raises(LawError, match="natural frequency"):
        PiReference.design(PiReference.Params(tuning="manual", kc=-4.0, ti_s=1.0, wn=0.0), {}, signals, reactor)
    for name in ("lanes", "iterations", "hold"):
        with pytest.raises(ValueError, match=name):
            Training(**{name: 0})
    with pytest.raises(ValueError, match="noise"):
        Training(noise=-1.0)
    away = replace(signals, sp=(replace(signals.sp[0], low=0.7, high=0.9),))
    with pytest.raises(LawError, match="beyond the set points"):
        Loops.drawn(PlantNetwork(network), away, Training(), np.random.default_rng(0))


def test_a_training_repeats(network: StateSpace, signals: Signals) -> None:
    options = Training(noise=0.002, lanes=6, holds=1, hold=20, iterations=3, hidden=3)
    policy, model = IncrementalNetwork(signals, 2, -1.0, 3), ReferenceModel.optimal(2, 0.05)
    first, again = (train(policy, network, model, options) for _ in range(2))
    np.testing.assert_array_equal(first.theta, again.theta)
    assert first.history.shape == (4, 2)
    assert first.history[-1, 0] < first.history[0, 0]
    other = train(policy, network, model, replace(options, seed=1))
    assert not np.array_equal(first.theta, other.theta)


def test_a_plant_with_a_zero_is_tuned_by_its_lag(reactor: EquationPlant) -> None:
    lin = reactor.linearize(*reactor.steady_state_at(0.46))
    near = AllPole.near(lin)
    gain = -float((lin.c @ np.linalg.solve(lin.a, lin.b))[0, 0])
    assert near.b0 == pytest.approx(float((lin.c @ lin.b)[0, 0]))
    assert -near.b0 / float(near.poles[0].real) == pytest.approx(gain)
    with pytest.raises(LawError, match="no zero"):
        AllPole.of(lin)
