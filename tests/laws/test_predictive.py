"""The predictive law against independent computations, and in closed loops on plants that are not its model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from identified_models import first_order, made_signals, random_model, scaled_model
from predictive_loops import NONE, closed, law_of, row
from torch import Tensor

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.export.gate import export
from loopwright.pipeline.laws.predictive.disturbance_model import Where, loads_of
from loopwright.pipeline.laws.predictive.horizon import Moves, horizon_of
from loopwright.pipeline.laws.predictive.horizon_check import horizon_for, settling_times, step_responses
from loopwright.pipeline.laws.predictive.observer import (
    BOOST,
    CALMING,
    FIRST_LOAD,
    FULL,
    INNOVATION_FORGETTING,
    OUTLIER,
    RISE,
    SWING_WEIGHT,
    Noises,
    Observer,
    StateEstimate,
    load_variance,
)
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.laws.predictive.qp_solver import Cost, Planner
from loopwright.pipeline.laws.predictive.tuning import (
    FORGETS,
    TRAVEL_COST,
    TriedNumbers,
    judged,
    searched,
    tuned,
)
from loopwright.pipeline.laws.predictive.tuning_loops import LOOPS, LoopErrors, TuningLoops, _late, side_by_side
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.models.static.mlp import MLP
from loopwright.pipeline.plants.noise import noise_and_change
from loopwright.pipeline.tuning.calm_choice import CALM_COST, calmest
from loopwright.serving import Controller
from loopwright.serving.manifest import Signal

few = settings(max_examples=8, deadline=None)
seeds = st.integers(0, 2**16)


def same(z: Tensor) -> Tensor:
    return z


# ---------------------------------------------------------------------- moves
@given(horizon=st.integers(1, 60), moves=st.integers(1, 12), n_mv=st.integers(1, 3), ramps=st.booleans())
@settings(max_examples=60, deadline=None)
def test_moves_cover_the_horizon_and_grow(horizon: int, moves: int, n_mv: int, ramps: bool) -> None:
    if moves > horizon:
        with pytest.raises(LawError, match=f"{moves} moves do not fit in a horizon of {horizon}"):
            Moves.over(horizon, moves, n_mv)
        return
    plan = Moves.over(horizon, moves, n_mv, ramps=ramps)
    starts = np.array([*plan.starts, horizon])
    assert starts[0] == 0
    assert (np.diff(starts) >= 1).all()
    np.testing.assert_allclose(plan.profile.sum(axis=1), 1.0)
    constant = torch.ones(plan.count, dtype=torch.float64)
    np.testing.assert_allclose(plan.courses(constant), 1.0)
    np.testing.assert_allclose(constant.numpy() @ plan.shift, 1.0)


@given(seed=seeds, ramps=st.booleans())
@few
def test_a_shifted_plan_is_the_plan_one_sample_later(seed: int, ramps: bool) -> None:
    moves = Moves.over(20, 8, 2, ramps=ramps)
    plan = np.random.default_rng(seed).normal(size=moves.count)
    now, later = (moves.courses(torch.from_numpy(p)).numpy() for p in (plan, plan @ moves.shift))
    for start in moves.starts:
        np.testing.assert_allclose(later[start], now[min(start + 1, 19)])
    change = np.diff(np.vstack([np.zeros(2), plan.reshape(-1, 2)]), axis=0)
    assert plan @ moves.curvature @ plan == pytest.approx(float((change**2).sum()))


# ---------------------------------------------------------------------- free run
@pytest.mark.parametrize("n_hidden", [0, 5])
@pytest.mark.parametrize(("ramps", "where"), [(False, "mvs"), (True, "outputs")])
@given(seed=seeds)
@settings(max_examples=8, deadline=None)
def test_the_run_and_its_slopes_are_those_of_the_model(seed: int, n_hidden: int, ramps: bool, where: Where) -> None:
    model = random_model(seed, n_y=2, n_mv=2, n_dv=1, n_hidden=n_hidden)
    moves = Moves.over(14, 5, 2, ramps=ramps)
    loads, rng = loads_of(model, where, 14), np.random.default_rng(seed)
    horizon = horizon_of(model, loads, moves, lambda z: 0.5 * z + 0.1, n_cv=2)
    x, d, dv, plan = (torch.from_numpy(rng.normal(size=n)) for n in (4, 2, 1, moves.count))

    def run(plan: Tensor) -> Tensor:
        at, found = x, []
        for mv in 0.5 * moves.courses(plan) + 0.1:
            at = model(torch.cat([at, torch.cat([mv, dv]) + loads.into_v @ d])) + loads.into_x @ d
            found.append(at[:2])
        return torch.cat(found)

    predicted = horizon(torch.cat([x, d, dv])[None], plan[None])
    torch.testing.assert_close(predicted.y[0], run(plan), rtol=1e-6, atol=1e-7)
    slopes = torch.autograd.functional.jacobian(run, plan)
    torch.testing.assert_close(predicted.slopes_t, slopes, rtol=1e-5, atol=1e-6)
    assert torch.equal(predicted.slopes, predicted.slopes_t.T)


# ---------------------------------------------------------------------- plan
@pytest.mark.parametrize("rate", [None, 0.05])
@pytest.mark.parametrize("sp", [0.3, 5.0])
def test_the_plan_is_the_minimum_of_its_cost(sp: float, rate: float | None) -> None:
    """A linear model makes the cost convex: many passes end where a convex solver does, also at the bounds."""
    model = random_model(3, n_y=2, n_mv=2, n_hidden=0)
    moves = Moves.over(15, 4, 2, ramps=rate is not None)
    horizon = horizon_of(model, loads_of(model, "outputs", 15), moves, same, n_cv=2)
    rates = None if rate is None else torch.full((2,), rate, dtype=torch.float64)
    planner = Planner(horizon, moves, Cost((1.0, 0.5), 0.2, 0.1, 0.3), passes=60, sweeps=30, rate=rates)
    start, applied, wanted = torch.zeros(1, 6, dtype=torch.float64), row(0.2, -0.1)[None], row(sp, -0.2)[None]
    plan, ahead = planner(start, wanted.repeat(1, 15), applied, torch.zeros(1, moves.count, dtype=torch.float64))

    z = cp.Variable(moves.count)
    free = horizon(start, torch.zeros_like(plan))
    slopes, at_rest = free.slopes_t.numpy(), free.y[0].numpy()
    error = at_rest + slopes @ z - np.tile(wanted[0].numpy(), 15)
    lengths = cp.norm(cp.vstack([error, np.full(30, 0.1)]), 2, axis=0)
    change = cp.hstack([z[:2] - applied[0].numpy(), z[2:] - z[:-2]])
    bounds = [cp.abs(z) <= 1]
    if rate is not None:
        bounds.append(cp.abs(change) <= rate * moves.lengths)
    cp.Problem(cp.Minimize(np.tile([1.0, 0.5], 15) @ lengths + 0.2 * cp.sum_squares(change)), bounds).solve(
        solver=cp.CLARABEL
    )
    if rate is None:
        np.testing.assert_allclose(plan[0], z.value, atol=2e-4)
        np.testing.assert_allclose(ahead[0], (at_rest + slopes @ z.value)[:2], atol=1e-3)
    np.testing.assert_allclose(plan[0, :2], z.value[:2], atol=2e-4)


def test_the_first_move_is_that_of_a_dense_quadratic_program() -> None:
    """Errors far below eps count by their square: one pass is the textbook's unconstrained MPC."""
    model, sp = first_order(pole=0.8, gain=1.0, dead=1), 1e-4
    law = law_of(model, horizon=10, moves=4, eps=10.0, move_weight=0.5, damping=0.0, passes=1, sweeps=400)
    mv, _, _ = law(row(sp), row(0.0), NONE, row(0.0), torch.zeros(law.n_state, dtype=torch.float64))
    ends = [*law.moves.starts, 10]
    answer = np.array([0.0, *(1 - 0.8 ** np.arange(1, 11))])  # of a unit step at sample 0, dead time 1
    s = np.zeros((10, 4))
    for j in range(4):
        for k in range(10):
            since, till = k - ends[j], k - ends[j + 1]
            s[k, j] = (answer[since] if since >= 0 else 0.0) - (answer[till] if till >= 0 else 0.0)
    d = np.eye(4) - np.eye(4, k=-1)
    mu = 0.5 * (10 - 1) / 10
    plan = np.linalg.solve(s.T @ s / 10 + 2 * mu * d.T @ d, s.T @ np.full(10, sp) / 10)
    assert mv.item() == pytest.approx(plan[0], rel=1e-6)


# ---------------------------------------------------------------------- observer
@pytest.mark.parametrize("where", ["mvs", "outputs"])
@given(seed=seeds)
@settings(max_examples=8, deadline=None)
def test_the_filter_is_the_textbook_s_on_a_linear_model(seed: int, where: Where) -> None:
    """Corrections one output after another equal the joint one; the covariance grows as the formulas say."""
    model = random_model(seed, n_y=2, n_mv=2, n_hidden=0)
    q_x, q_d, rng = 0.02, 1e-3, np.random.default_rng(seed)
    loads = loads_of(model, where, 20)
    observer, n_a = Observer(model, loads, Noises(q_x, q_d)), 6
    r = np.diag(model.noise.numpy() ** 2)
    into = (loads.into_x + model.b @ loads.into_v).numpy()
    f = np.block([[model.a.numpy(), into], [np.zeros((2, 4)), np.eye(2)]])
    b, c, h = np.vstack([model.b, np.zeros((2, 2))]), np.r_[model.c, 0, 0], np.eye(2, n_a)
    share, begun = loads.share.numpy(), loads.begun.numpy()
    q = np.diag([*(q_x * np.diag(r)), 0, 0, *(q_d * np.diag(r) @ share)])
    mean, p, drift, square, signed = np.zeros(n_a), observer.first.numpy(), np.zeros(2), np.zeros(2), np.zeros(2)
    assert p[4, 4] == FIRST_LOAD**2
    none = torch.zeros(1, 2, dtype=torch.float64)
    found = StateEstimate(
        torch.zeros(1, n_a, dtype=torch.float64), observer.first, none, torch.cat([none, none], dim=-1)
    )
    for k in range(30):
        y, v = 0.02 * rng.normal(size=2) + (k > 15), rng.normal(size=2)
        mean, p = f @ mean + b @ v + c, f @ p @ f.T + q
        error = y - h @ mean
        scaled = np.clip(error / np.sqrt(np.diag(h @ p @ h.T + r)), -OUTLIER, OUTLIER)
        drift = drift + INNOVATION_FORGETTING * (scaled - drift)
        bounded = scaled * np.abs(scaled)
        square, signed = square + CALMING * (np.abs(bounded) - square), signed + CALMING * (bounded - signed)
        calm = np.maximum(1 + SWING_WEIGHT * (square - np.abs(signed) - 1), 1)
        boost = (
            np.clip(drift**2 * (2 - INNOVATION_FORGETTING) / (RISE * INNOVATION_FORGETTING) / calm - 1, 0, FULL) / FULL
        )
        for i in range(2):
            for x in begun[..., i]:
                g = np.r_[x, np.eye(2)[i]]
                p = p + BOOST * q_d * (boost * np.diag(r)) @ share[:, i] * np.outer(g, g) / len(begun)
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        mean, p = mean + gain @ error, p - gain @ h @ p
        found, shown = observer(torch.from_numpy(y)[None], torch.from_numpy(v)[None], found)
        np.testing.assert_allclose(found.mean[0], mean, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(found.covariance, p, rtol=1e-6, atol=1e-11)
        np.testing.assert_allclose(shown[0], boost, atol=1e-6)


@pytest.mark.parametrize("where", ["mvs", "outputs"])
def test_the_covariance_goes_by_the_jacobian_of_the_network(where: Where) -> None:
    model = random_model(1, n_y=1, n_hidden=5)
    loads = loads_of(model, where, 20)
    observer, z, v = Observer(model, loads, Noises(0.01, 2e-4)), torch.linspace(-1, 1, 5).double(), row(0.3)

    def run(z: Tensor) -> Tensor:
        x, d = z[:4], z[4:]
        return torch.cat([model(torch.cat([x, v + loads.into_v @ d])) + loads.into_x @ d, d])

    f = torch.autograd.functional.jacobian(run, z).numpy()
    past = StateEstimate(z[None], observer.first, row(0.0)[None], row(0.0, 0.0)[None])
    mean, covariance = observer.predicted(v[None], past)
    torch.testing.assert_close(mean[0], run(z))
    np.testing.assert_allclose(covariance, f @ observer.first.numpy() @ f.T + observer.q.numpy(), rtol=1e-9, atol=1e-12)


def test_a_load_at_the_mv_has_begun_when_it_shows() -> None:
    """A lag of pole a behind d samples: growth 1/3 at once after the dead time; 5 % of the effect after its first."""
    model = first_order(pole=0.9, gain=2.0, dead=3)
    loads = loads_of(model, "mvs", 60)
    assert loads.into_v.item() == pytest.approx(1 / 3 / 0.2)
    np.testing.assert_allclose(loads.begun[:, 0, 0], [(1 - 0.9**k) * 10 / 3 for k in (1, 3)])
    assert not loads.into_x.any()
    for alone in (loads_of(model, "outputs", 60), loads_of(random_model(0, n_y=1, n_mv=2), "mvs", 60)):
        assert not alone.at_mvs
        assert torch.equal(alone.into_x, torch.eye(*alone.into_x.shape, dtype=torch.float64))


@pytest.mark.parametrize("alternating", [False, True])
def test_innovations_of_both_signs_are_no_load(alternating: bool) -> None:
    model = first_order(pole=0.5)
    observer = Observer(model, loads_of(model, "outputs", 12), Noises(0.01, 1e-5))
    past = StateEstimate(row(0.0, 0.0)[None], observer.first, row(0.0)[None], row(0.0, 0.0)[None])
    boosts = []
    for k in range(40):
        size = 0.2 * (-1.0 if alternating and k // 4 % 2 else 1.0)
        predicted = observer.predicted(row(0.0)[None], past)[0][0, 0].item()
        past, boost = observer(row(predicted + size)[None], row(0.0)[None], past)
        boosts.append(boost.item())
    assert boosts[3] == 1.0
    assert (max(boosts[-8:]) < 0.6) is alternating


def test_a_load_s_variance_goes_with_the_noise() -> None:
    model = first_order()
    model.noise[:] = 0.03
    assert load_variance(model).item() == pytest.approx(1e-3)


# ---------------------------------------------------------------------- settling
def test_the_horizon_is_the_settling_time() -> None:
    """A lag of pole a settles to 10 % in ln .1/ln a samples, and later by its dead time; a level none at all."""
    for pole, dead, samples in ((0.9, 0, 22), (0.9, 4, 26), (0.5, 0, 12), (0.995, 0, 50), (1.0, 0, 12)):
        model = first_order(pole=min(pole, 0.999), dead=dead)
        if pole == 1.0:
            model.a[0, 0], model.b[0, 0] = 1.0, 0.05
        assert horizon_for(model, same) == samples
    late_level = first_order(dead=9)
    late_level.a[0, 0], late_level.a[0, -1] = 1.0, 0.05
    assert horizon_for(late_level, same) == 2 * 9 + 2
    answers = step_responses(first_order(pole=0.8), same)
    np.testing.assert_allclose(settling_times(answers), np.ceil(np.log(0.1) / np.log(0.8)))


@pytest.mark.parametrize("n_hidden", [0, 3])
def test_an_unstable_model_is_refused(n_hidden: int) -> None:
    model = random_model(0, n_hidden=n_hidden)
    model.a *= 1.1 / 0.85
    with pytest.raises(LawError, match="identified model is unstable"):
        law_of(model)


# ---------------------------------------------------------------------- closed loops
@given(gain=st.floats(0.6, 1.6), load=st.floats(-0.1, 0.1), sp=st.floats(-1.0, 1.0))
@few
def test_a_wrong_gain_and_a_load_leave_no_offset(gain: float, load: float, sp: float) -> None:
    law, plant = law_of(first_order(gain=2.0, dead=1)), first_order(gain=2.0 * gain, dead=1)
    reach = 2.0 * gain - abs(load) / 0.1
    y, _, info = closed(law, plant, np.full((150, 1), sp), load=np.full(150, load))
    if abs(sp) < 0.95 * reach:
        assert abs(y[-1, 0] - sp) < 1e-3
        assert info[-1, law.info.index("next_y0")] == pytest.approx(y[-1, 0], abs=2e-3)


def test_a_network_leaves_no_offset_either() -> None:
    model, plant = random_model(5, n_y=2, n_mv=2), random_model(5, n_y=2, n_mv=2)
    plant.b *= 1.2
    plant.c += 0.02
    reachable = [plant.measured(x) for x in (settled(plant, row(0.3, -0.2)), settled(plant, row(-0.4, 0.1)))]
    sp = np.repeat(np.array([y.numpy() for y in reachable]), 200, axis=0)
    y, _, _ = closed(law_of(model), plant, sp)
    np.testing.assert_allclose(y[[199, 399]], sp[[199, 399]], atol=3e-3)


def settled(plant: Identified, mv: Tensor) -> Tensor:
    x = torch.zeros(plant.n_x, dtype=torch.float64)
    for _ in range(300):
        x = plant(torch.cat([x, mv]))
    return x


def test_noise_and_a_gain_error_lead_to_no_lock_up() -> None:
    """Gain +20 %, noise of 5 % of a set point's step: the MV stays off its limits, the PV near its set points."""
    law, plant = law_of(first_order(gain=2.0, dead=2)), first_order(gain=2.4, dead=2)
    sp = np.repeat([0.5, -0.5, 1.0, 0.0], 80)[:, None]
    y, mv, _ = closed(law, plant, sp, noise=0.05)
    late = (np.arange(len(sp)) % 80) >= 30
    assert np.abs(y - sp)[late].mean() < 0.05
    assert (np.abs(mv[late]) < 0.99).all()


def test_a_load_that_steps_is_followed_at_once_and_noise_is_not() -> None:
    law, plant = law_of(first_order(), loads="outputs"), first_order()
    load = np.where(np.arange(160) >= 80, 0.1, 0.0)
    _, _, info = closed(law, plant, np.zeros((160, 1)), load=load, noise=0.01)
    found, boost = info[:, law.info.index("load_y0")], info[:, law.info.index("boost_y0")]
    assert np.abs(found[20:80]).max() < 0.02
    assert boost[20:80].max() < 0.2
    assert boost[80:84].max() > 0.9
    np.testing.assert_allclose(found[90:], 0.1, atol=0.03)


def test_a_measured_disturbance_is_met_before_it_is_seen_in_the_output() -> None:
    model = first_order(pole=0.8, dead=0, disturbance=1.0)
    dv = np.where(np.arange(60) >= 20, 0.5, 0.0)
    y, mv, _ = closed(law_of(model), model, np.zeros((60, 1)), dv=dv)
    assert abs(mv[20, 0] + 0.25) < 0.05
    assert np.abs(y).max() < 0.02


def test_an_unreachable_set_point_winds_nothing_up() -> None:
    law, plant = law_of(first_order()), first_order(gain=1.8)
    sp = np.repeat([2.9, 0.5], [200, 60])[:, None]
    y, mv, _ = closed(law, plant, sp)
    assert mv[150, 0] == pytest.approx(1.0, abs=1e-6)
    assert mv[200, 0] < 0.5
    assert abs(y[220, 0] - 0.5) < 0.05


def test_a_slow_actuator_is_planned_for() -> None:
    """With a rate the plan brakes in time: less overshoot than of a law that is only cut to the rate."""
    plant = first_order(pole=0.9, gain=4.0, dead=2)
    sp = np.full((120, 1), 2.0)
    signals = made_signals()
    knowing, cut = (Predictive(signals, plant, Predictive.Params(mv_rate=r)).eval() for r in (0.04, None))
    cut.rate = row(0.04)
    (y, mv, _), (loose, _, _) = (closed(law, plant, sp) for law in (knowing, cut))
    assert np.abs(np.diff(mv[:, 0], prepend=0.0)).max() <= 0.04 * (1 + 1e-12)
    assert y.max() < loose.max()
    assert y.max() < 2.1
    assert abs(y[-1, 0] - 2.0) < 1e-3


def test_speed_moves_faster_and_caution_follows_loads_slower() -> None:
    model, sp = first_order(), np.repeat([[0.5]], 40, axis=0)
    moved = [closed(law_of(model, speed=s, passes=4), model, sp)[1][0, 0] for s in (0.03, 0.1, 0.3)]
    assert moved[0] < moved[1] < moved[2]
    load = np.full(40, 0.02)
    found = [closed(law_of(model, caution=c), model, 0 * sp, load=load)[2][8, 0] for c in (1.0, 5.0)]
    assert found[1] < found[0]


def test_more_mvs_disturbances_a_rate_limits_and_a_recipe_export(tmp_path) -> None:
    model = random_model(2, n_y=2, n_mv=2, n_dv=1, n_x=5, n_hidden=4)
    more = {"mv_rate": 0.1, "cv_low": (None, -1.0), "cv_high": (None, 1.0), "preview": "ramp"}
    law = law_of(model, horizon=8, moves=2, passes=1, sweeps=2, **more)
    manifest = export(law, tmp_path / "law.onnx", case="made", provenance={})
    assert manifest.info == ("load_u0", "load_u1", "next_y0", "next_y1", "boost_y0", "boost_y1")
    assert Controller(tmp_path / "law.onnx").cold_state().shape == (law.n_state,)


# ---------------------------------------------------------------------- tuning
class Numbered(torch.nn.Module):
    """Stands for a law: only its numbers' logarithms."""

    def __init__(self, numbers: dict[str, float]) -> None:
        super().__init__()
        self.register_buffer("logs", torch.tensor(list(numbers.values()), dtype=torch.float64).log())


class Bowl:
    """Trials whose errors are known: the squares of the numbers' logarithms from their best values."""

    best = row(2.0, 0.4, 0.3, 26.0)

    def run(self, laws: Numbered, count: int) -> LoopErrors:
        error = 1 + (laws.logs.reshape(count, 4) - self.best.log()).square().sum(dim=-1, keepdim=True).numpy()
        return LoopErrors(error.repeat(LOOPS, axis=1), error.repeat(LOOPS, axis=1), np.zeros((count, 2)))


def test_the_search_takes_what_costs_least() -> None:
    start = {"speed": 1.0, "caution": 1.0, "jumps": 1.0, "horizon": 20.0}
    best, tried = searched(Bowl(), Numbered, start)  # type: ignore[arg-type]
    assert list(best.numbers.values()) == pytest.approx(Bowl.best.tolist())
    assert tried[0].numbers == start
    assert tried[0].cost == pytest.approx(1.0)
    assert len({tuple(c.numbers.values()) for c in tried}) == len(tried)


def test_of_numbers_that_err_nearly_the_same_the_calmest_are_taken() -> None:
    """Their travel counts once, by its size, and not in the limit."""
    rows = ((1.0, 3.0), (1.04, 1.0), (1.049, 2.0), (1.06, 0.1))
    made = [TriedNumbers({}, error + TRAVEL_COST * travel, travel=travel) for error, travel in rows]
    assert [c.error for c in made] == pytest.approx([error for error, _ in rows])
    assert calmest(made) is made[1]


def noisy_disturbance(noise: float, change: float = 0.05) -> Identified:
    """A lag whose measured disturbance has noise."""
    model = first_order(disturbance=1.5)
    model.dv_noise.fill_(noise)
    model.dv_change.fill_(change)
    return model


def test_noise_of_a_measured_disturbance_moves_the_mv_less_by_its_level() -> None:
    """MVs on set point under noise of the disturbance alone; a step of it is still met, a few periods later."""
    noise, travel, last = 0.2 * np.random.default_rng(0).normal(size=300), [], []
    for model in (noisy_disturbance(0.0), noisy_disturbance(0.2)):
        law = law_of(model)
        x, mv, state, moves = row(0.0), row(0.0), torch.zeros(law.n_state).double(), []
        for k in range(300):
            dv = row(0.4 if k >= 60 else 0.0)
            mv, state, _ = law(row(0.0), x, dv + noise[k], mv, state)
            x = model(torch.cat([x, mv, dv]))
            moves.append(float(mv))
        travel.append(float(np.abs(np.diff(moves[:60])).sum()))
        last.append(moves[-200:])
    assert travel[1] < 0.4 * travel[0]
    assert np.mean(last[1]) == pytest.approx(-0.3, abs=0.06)  # 1.5 * .4 / 2 against it


def test_a_level_that_is_found_in_a_record_leaves_no_offset() -> None:
    """A slow disturbance under noise: the estimate of its change is never zero, and its steps are met in the end."""
    rng, noise = np.random.default_rng(2), 0.2
    recorded = 0.3 * np.sin(np.arange(4000) / 500) + noise * rng.normal(size=4000)
    law = law_of(model := noisy_disturbance(*(float(sd[0]) for sd in noise_and_change([recorded[:, None]]))))
    assert 0.1 < float(law.follow) < 0.5
    dv = np.repeat([0.0, 0.4], [60, 540])
    x, mv, state, found = row(0.0), row(0.0), torch.zeros(law.n_state).double(), []
    for value in dv:
        mv, state, _ = law(row(0.0), x, row(value + noise * rng.normal()), mv, state)
        x = model(torch.cat([x, mv, row(value)]))
        found.append(float(x))
    assert np.mean(found[-300:]) == pytest.approx(0, abs=0.01)  # of .3 without a controller


def test_a_law_with_a_level_is_exported(tmp_path: Path) -> None:
    """Of two disturbances one has noise; the file steps as the module does."""
    model = random_model(3, n_dv=2)
    model.dv_noise.copy_(torch.tensor([0.0, 0.1]))
    model.dv_change.copy_(torch.tensor([0.1, 0.05]))
    law, path = law_of(model, horizon=8, moves=2, passes=1, sweeps=2), tmp_path / "law.onnx"
    assert law.kept["level"] == 2
    assert law.follow[0] == 1
    assert law.follow[1] < 1
    export(law, path, case="x", provenance={})
    assert Controller(path).manifest.n_state == law.n_state


def test_a_disturbance_without_noise_needs_no_level() -> None:
    """A state more with noise alone."""
    plain, noisy = (law_of(noisy_disturbance(noise)) for noise in (0.0, 0.2))
    assert noisy.n_state == plain.n_state + 1
    assert "level" not in plain.kept


def test_the_noise_of_disturbances_is_in_the_trials() -> None:
    quiet, noisy = (TuningLoops.draw(noisy_disturbance(sd), made_signals(n_dv=1), 15, seed=0) for sd in (0.0, 0.2))
    assert not quiet.dv_noise.any()
    assert float(noisy.dv_noise.std()) == pytest.approx(0.2, rel=0.1)
    assert torch.equal(quiet.noise, noisy.noise)
    laws = law_of(noisy_disturbance(0.2))
    moved = [float(trials.run(side_by_side([laws]), 1).travel.sum()) for trials in (quiet, noisy)]
    assert moved[1] > 1.05 * moved[0]


def test_the_loads_of_a_record_go_on_in_the_loops() -> None:
    """From nothing, elsewhere in each loop, beside steps at the MVs; without a record nothing of it is there."""
    model, moves = first_order(), 0.01 * np.random.default_rng(0).normal(size=(3_000, 1))
    known = Identified.from_arrays(
        {**model.config(), "recorded": len(moves)},
        {name: value.numpy() for name, value in model.state_dict().items()} | {"load_moves": moves},
    )
    plain, drawn = (TuningLoops.draw(of, made_signals(), 15, seed=0) for of in (model, known))
    load, quiet = drawn.load[..., 0].numpy(), drawn.quiet
    assert not plain.load[:, :LOOPS].any()
    assert not load[:quiet].any()
    for i in range(LOOPS):
        assert np.ptp(load[quiet:, i]) > 0
        rows = np.diff(load[quiet:, i])
        assert any(np.allclose(rows, moves[at + 1 : at + 1 + len(rows), 0]) for at in range(3_000 - len(rows)))
    assert len({float(of[-1]) for of in load.T[:LOOPS]}) == LOOPS
    np.testing.assert_array_equal(plain.bias.numpy(), drawn.bias.numpy())


@pytest.mark.parametrize(
    ("calm_from", "given", "found"), [(0.0, None, 0.1), (0.2, None, 0.25), (9.0, None, None), (9.0, 0.3, 0.3)]
)
def test_the_damping_is_the_least_that_the_loops_stand(
    calm_from: float, given: float | None, found: float | None
) -> None:
    class Shaken(Bowl):
        def growth(self, law: Any) -> float:
            return 1.0 if law.damping >= calm_from else 1e6

    def law_of(numbers: Any, damping: float | None) -> Any:
        law: Any = Numbered(numbers)
        law.damping = damping
        return law

    start = {"speed": 1.0, "caution": 1.0, "jumps": 1.0, "horizon": 20.0}
    best = tuned(Shaken(), law_of, start, given)  # type: ignore[arg-type]
    assert best.damping == found
    assert list(best.numbers.values()) == pytest.approx(Bowl.best.tolist())


def test_a_law_that_calms_at_its_last_numbers_alone_is_damped_more() -> None:
    """The loops stand .1 at the first numbers, and .5 at those that the search chooses."""

    class Shaken(Bowl):
        def growth(self, law: Any) -> float:
            return 1.0 if law.damping >= (0.1 if float(law.logs[0]) == 0 else 0.5) else 1e6

    def law_of(numbers: Any, damping: float | None) -> Any:
        law: Any = Numbered(numbers)
        law.damping = damping
        return law

    start = {"speed": 1.0, "caution": 1.0, "jumps": 1.0, "horizon": 20.0}
    assert tuned(Shaken(), law_of, start).damping == 0.5  # type: ignore[arg-type]


def test_trials_see_a_difference_grow() -> None:
    """The law forgets one; a law that turns over with every thousandth of the PV does not."""
    model, signals = first_order(pole=0.9), made_signals()
    trials = TuningLoops.draw(model, signals, 12, seed=1)
    assert trials.growth(law_of(model, horizon=12)) < FORGETS

    class Sawtooth(torch.nn.Module):
        n_state = 0

        def forward(self, sp: Any, pv: Any, dv: Any, mv: Any, state: Any) -> Any:
            return torch.remainder(1e3 * pv, 1.0), state, state

    assert trials.growth(Sawtooth()) > FORGETS  # type: ignore[arg-type]


def test_the_cost_weighs_relative_errors_and_travel() -> None:
    even = np.full((2, LOOPS), 2.0)
    uneven = np.array([[2.0] * LOOPS, [2.0] * (LOOPS - 1) + [8.0]])
    given = LoopErrors(even[:1], even[:1], np.zeros((1, 2)))
    found = judged(
        LoopErrors(even, uneven, np.array([[0.0, 0.0], [2.0, 4.0]])), given, [{"speed": 1.0}, {"speed": 2.0}]
    )
    assert found[0].cost == 1.0
    assert found[1].cost == pytest.approx(0.5 + 0.5 * 3.0 / 2.0 + 3 * TRAVEL_COST)
    made = {"speed": 2.0, "set_points": 1.0, "loads": 1.5, "travel": 3.0, "error": 1.25, "cost": found[1].cost}
    assert found[1].row() == pytest.approx(made)


def test_laws_side_by_side_are_the_laws() -> None:
    model = random_model(4, n_y=2, n_mv=2)
    laws = [law_of(model, horizon=10, moves=3, speed=s, caution=c) for s, c in ((1.0, 1.0), (2.0, 0.5), (0.5, 4.0))]
    trials = TuningLoops.draw(model, laws[0].signals, 10, seed=1)
    together = trials.run(side_by_side(laws), 3)
    for i, law in enumerate(laws):
        alone = trials.run(law, 1)
        np.testing.assert_allclose(together.set_points[i], alone.set_points[0], rtol=1e-9)
        np.testing.assert_allclose(together.loads[i], alone.loads[0], rtol=1e-9)
        np.testing.assert_allclose(together.travel[i], alone.travel[0], rtol=1e-9)


def test_trials_tell_a_good_law_from_a_sluggish_one_and_are_the_same_again() -> None:
    model = first_order(pole=0.9)
    signals, law = made_signals(), law_of(model, horizon=12)
    trials, again = (TuningLoops.draw(model, signals, 12, seed=1) for _ in range(2))
    good = trials.run(law, 1)
    np.testing.assert_array_equal(good.set_points, again.run(law, 1).set_points)
    slow, cautious = (law_of(model, horizon=12, **n) for n in ({"speed": 0.02}, {"caution": 1e4}))
    assert trials.run(slow, 1).set_points.mean() > 1.2 * good.set_points.mean()
    assert trials.run(cautious, 1).loads.mean() > 1.2 * good.loads.mean()


def test_set_points_of_trials_are_within_reach_of_their_own_plants() -> None:
    """Also under a gain that is too low; those of a level, which has no rest, lie within its record."""
    model = first_order(pole=0.9, gain=2.0)
    trials = TuningLoops.draw(model, made_signals(), 30, seed=0)
    error = trials.run(law_of(model, horizon=30), 1)
    assert error.set_points.max() < 4.0
    assert trials.sp.abs().max() < 2.0
    level = first_order(pole=0.9)
    level.a[0, 0], level.b[0, 0] = 1.0, 0.05
    drawn = TuningLoops.draw(level, made_signals(), 20, seed=0).sp[:, :LOOPS]
    assert drawn.std() > 0.5
    assert drawn.abs().max() <= 1.5


def test_a_level_beside_an_output_that_rests_leaves_it_its_set_points() -> None:
    """y0 is a level filled by u0, y1 = u1 at rest, behind a lag: the set points of y1 are MVs within reach."""
    a, b = np.diag([1.0, 0.8]), np.diag([0.1, 0.2])
    model = scaled_model(2, 2, 0, 2, a=a, b=b, rest=np.eye(2, 5))
    sp = TuningLoops.draw(model, made_signals(2, 2), 15, seed=0).sp[:, :LOOPS]
    assert sp[..., 0].std() > 0.5
    assert sp[..., 1].std() > 0.3
    assert sp[..., 1].abs().max() <= 0.8
    assert sp[..., 0].abs().max() <= 1.5


def test_a_searched_law_costs_no_more_than_the_given_one() -> None:
    params = Predictive.Params(tuning="search", horizon=8, moves=3, passes=1, sweeps=2)
    law = Predictive.design(params, {"identified": first_order(pole=0.5)}, made_signals(), None)
    figures = law.analysis(None).figures
    assert figures["cost"] <= figures["cost_given"]
    assert figures["horizon"] == law.moves.horizon
    table = law.analysis(None).table
    assert len(table) == figures["tried"]
    assert [row["cost"] for row in table] == sorted(row["cost"] for row in table)
    assert table[0]["jumps"] == figures["jumps"]
    (taken,) = [row for row in table if row["taken"]]
    assert {n: taken[n] for n in ("speed", "caution", "jumps", "horizon", "cost")}.items() <= figures.items()
    assert taken["error"] <= (1 + CALM_COST) * min(row["error"] for row in table)
    assert {row["jumps"] for row in table} > {1.0}
    assert not law_of(first_order()).analysis(None).figures


def test_the_calmer_law_of_a_search_moves_less_and_has_the_same_signals() -> None:
    params = Predictive.Params(tuning="search", horizon=8, moves=3, passes=1, sweeps=2, speed=2.0)
    model = first_order(pole=0.5)
    law = Predictive.design(params, {"identified": model}, made_signals(), None)
    calm = law.calmed()
    assert calm is not None
    assert (calm.n_state, calm.info, calm.moves.horizon) == (law.n_state, law.info, law.moves.horizon)
    plant, sp = first_order(pole=0.5, gain=3.5), np.full((40, 1), 0.8)
    travels = [np.abs(np.diff(closed(one, plant, sp)[1], axis=0, prepend=0.0)).sum() for one in (law, calm)]
    assert travels[1] < 0.7 * travels[0]
    assert law_of(first_order()).calmed() is None


def test_plants_of_the_trials_err_as_far_as_the_record_leaves_open_and_no_less_than_plants_change() -> None:
    model, signals = first_order(), made_signals()
    certain = TuningLoops.draw(model, signals, 12, seed=0)
    assert certain.gain[:3, 0].tolist() == pytest.approx([1.0, 1.25, 0.8])
    assert certain.pace[:3, 0].tolist() == pytest.approx([1.0, 1 / 1.15, 1.15])
    assert certain.late[:3, 0].tolist() == [0.0, 0.5, 0.0]
    for name, sd in (("gain_sd", 0.2), ("pace_sd", 0.3)):
        getattr(model, name)[:] = sd
    open_to = TuningLoops.draw(model, signals, 12, seed=0)
    assert open_to.gain[1, 0] == pytest.approx(1.4)
    assert open_to.pace[2, 0] == pytest.approx(1.6)


@pytest.mark.parametrize("late", [0.3, 1.0, 2.4])
def test_a_plant_that_answers_later_is_moved_by_the_mv_of_so_many_samples_before(late: float) -> None:
    course = torch.linspace(0, 1, 9).double() ** 2  # of an MV, over samples
    whole, rest = torch.tensor([int(late), 0]), torch.tensor([[late - int(late)], [0.0]], dtype=torch.float64)
    for k in range(4, 9):
        acted = [course[k - i].expand(3, 2, 1) for i in range(5)]
        found = _late(acted, whole, rest)
        assert found.shape == (3, 2, 1)
        expected = np.interp(k - late, np.arange(9), course.numpy())
        np.testing.assert_allclose(found[:, 0, 0].numpy(), expected, rtol=1e-12)
        np.testing.assert_allclose(found[:, 1, 0].numpy(), float(course[k]), rtol=1e-12)


def test_errors_of_dead_time_go_beyond_a_sample() -> None:
    """Twice what is open, and at most a quarter of the horizon."""
    model = first_order()
    for sd, latest in ((0.1, 0.5), (1.5, 3.0), (40.0, 5.0)):
        open_to = model.state_dict() | {"dead_sd": torch.tensor([sd]).double()}
        known = Identified.from_arrays(model.config(), {name: value.numpy() for name, value in open_to.items()})
        trials = TuningLoops.draw(known, made_signals(), 20, seed=0)
        assert float(trials.late.max()) == latest
        farthest = trials.late[:, 0] > 0.5
        assert farthest.sum() == 2 * (latest > 0.5)
        assert trials.gain[farthest].eq(1.0).all()
        assert trials.pace[farthest].eq(1.0).all()
        assert np.isfinite(trials.run(law_of(known, horizon=20), 1).set_points).all()


def test_errors_of_pace_leave_a_stable_plant_stable() -> None:
    """A state that swings from sample to sample would grow under x + 1.15 (F(x) - x); larger models have such ones."""
    a, b = np.array([[0.9, 0.02], [0.0, -0.95]]), np.array([[0.1], [0.5]])
    model = scaled_model(1, 1, 0, 2, a=a, b=b, rest=np.eye(2, 3))
    trials = TuningLoops.draw(model, made_signals(), 15, seed=0)
    outcome = trials.run(law_of(model, horizon=15), 1)
    assert max(outcome.set_points.max(), outcome.loads.max()) < 10.0


def test_errors_of_pace_leave_alone_what_only_remembers() -> None:
    """y is the MV of two samples ago, whatever the pace: the state between holds the MV, and not a share of it."""
    a, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    trials = TuningLoops.draw(scaled_model(1, 1, 0, 2, a=a, b=b, rest=np.eye(2, 3)), made_signals(), 15, seed=0)
    x, v = torch.rand(2 * LOOPS, 2).double(), torch.rand(2 * LOOPS, 1).double()
    ahead = trials.ahead(x, v)
    assert ahead[:, 0].tolist() == x[:, 1].tolist()
    assert ahead[:, 1].tolist() == v[:, 0].tolist()


def test_noise_of_the_trials_has_the_colour_and_the_strength_of_the_model_s() -> None:
    model = first_order()
    model.noise[:], model.colour[:] = 0.02, 0.75
    noise = TuningLoops.draw(model, made_signals(), 60, seed=0).noise[..., 0].numpy()
    assert noise.std() == pytest.approx(0.04, rel=0.05)
    assert np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1] == pytest.approx(0.75, abs=0.1)


def test_a_share_of_the_jumps_leaves_as_much_of_the_observer_s_boost() -> None:
    model = first_order()
    loads = loads_of(model, "mvs", 12)
    whole, third = (Observer(model, loads, Noises(0.01, 2e-4, jumps)).place for jumps in (1.0, 0.3))
    np.testing.assert_allclose(third, 0.3 * whole)


# ---------------------------------------------------------------------- refusals
@pytest.mark.parametrize(
    ("name", "value"),
    [(n, v) for n in ("speed", "caution", "jumps", "move_weight", "q_x", "q_d") for v in (0.0, -1.0, float("nan"))]
    + [("damping", -0.1), ("horizon", 7), ("moves", 0), ("passes", 0), ("sweeps", 0)],
)
def test_numbers_that_make_no_plan_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is {value}; it must be"):
        Predictive.Params(**{name: value})


def test_what_does_not_fit_is_refused_in_words() -> None:
    model = first_order()
    with pytest.raises(LawError, match="has 2 weights; give one for each set point"):
        law_of(model, weights=(1.0, 2.0))
    with pytest.raises(ValueError, match="each must be above 0"):
        Predictive.Params(weights=(0.0,))
    with pytest.raises(LawError, match="1 outputs, 1 MVs and 0 measured disturbances; the plant has 2 set points"):
        Predictive(made_signals(2, 2), model, Predictive.Params())
    with pytest.raises(LawError, match=r"needs a part 'identified' .* is of kind mlp"):
        Predictive.design(Predictive.Params(), {"identified": MLP(2)}, made_signals(), None)
    valve = made_signals()
    discrete = type(valve)(1.0, valve.sp, valve.pv, (), (Signal("valve", "-", 0.0, 1.0, (0.0, 1.0)),))
    with pytest.raises(LawError, match="valve has only the values"):
        Predictive.design(Predictive.Params(), {"identified": model}, discrete, None)


def test_a_model_that_hides_its_scaling_gives_the_same_law() -> None:
    """Other units, and a model scaled to another MV range than the signal's: the same loop."""
    plain = first_order()
    other = scaled_model(
        1, 1, 0, 1, a=plain.a, b=plain.b * 0.5, c=plain.b[:, 0] * 0.1, rest=plain.rest,
        v_scale=np.array([0.5]), v_center=np.array([0.1]),
    )  # fmt: skip
    sp = np.repeat([0.5, -0.8], 30)[:, None]
    runs = [closed(law_of(model, horizon=20), plain, sp)[1] for model in (plain, other)]
    np.testing.assert_allclose(runs[0], runs[1], atol=2e-3)
