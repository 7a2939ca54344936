"""Soft limits of the predictive law: kept where a plan keeps them, and nothing changes without them."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
import torch
from identified_models import TOP, first_order, made_signals, random_model, scaled_model
from predictive_loops import closed, law_of
from scipy.optimize import brentq

from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import LawError, ParamsError
from loopwright.pipeline.laws.predictive.disturbance_model import loads_of
from loopwright.pipeline.laws.predictive.horizon import Moves, horizon_of
from loopwright.pipeline.laws.predictive.params import PredictiveParams, limits_of
from loopwright.pipeline.laws.predictive.predictive import Predictive
from loopwright.pipeline.laws.predictive.qp_solver import Cost, Planner
from loopwright.pipeline.laws.predictive.soft_limits import EPS, PRICE, SOFT, SoftLimits
from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.plants.equations import EquationPlant

SMALL = {"horizon": 12, "moves": 4}


def swinging() -> Identified:
    """Two conjugate poles, gain 2: its law overshoots a little."""
    radius, angle = 0.9, 0.35
    gain = 1 - 2 * radius * np.cos(angle) + radius**2
    a = np.array([[2 * radius * np.cos(angle), -(radius**2)], [1.0, 0.0]])
    return scaled_model(1, 1, 0, 2, a=a, b=np.array([[2 * gain], [0.0]]), rest=np.array([[1.0, 0, 0], [1, 0, 0]]))


def two_by_one(gain: float) -> Identified:
    """One MV moves two CVs, by 2 and by ``gain``."""
    return scaled_model(2, 1, 0, 2, a=np.diag([0.9, 0.8]), b=np.array([[0.2], [0.2 * gain]]), rest=np.eye(2, 4))


# ---------------------------------------------------------------------- without limits
@pytest.mark.parametrize("none", [{"cv_low": None}, {"cv_high": (None, None)}, {"cv_low": (None, None)}])
def test_no_limit_changes_no_bit(none: dict) -> None:
    model = random_model(1, n_y=2, n_mv=2)
    plain, law = law_of(model, horizon=10), law_of(model, horizon=10, **none)
    assert law.state_dict().keys() == plain.state_dict().keys()
    sp = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    for one, other in zip(closed(plain, model, sp), closed(law, model, sp), strict=True):
        np.testing.assert_array_equal(one, other)


def test_limits_that_are_far_away_leave_the_plan_as_it_is() -> None:
    model, sp = random_model(1, n_y=2, n_mv=2), np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2))
    plain, law = law_of(model, horizon=10), law_of(model, horizon=10, cv_low=(-TOP, -TOP), cv_high=(TOP, TOP))
    np.testing.assert_allclose(closed(law, model, sp)[1], closed(plain, model, sp)[1], atol=1e-9)


# ---------------------------------------------------------------------- the cost
def slope_at(beyond: float, price: float) -> float:
    """p'(b) as its formula stands."""
    return price * beyond**2 / ((abs(beyond) + SOFT) * np.sqrt(beyond**2 + EPS**2)) * np.sign(beyond)


def test_the_push_begins_at_the_limit_without_a_jump_and_grows_to_its_price() -> None:
    y = torch.linspace(-3, 3, 12_001, dtype=torch.float64)
    limits = SoftLimits(torch.tensor([-1.0]).double(), torch.tensor([0.5]).double(), 7.0, horizon=len(y))
    weight, slope = (t.numpy() for t in limits(y))
    beyond = (y - y.clamp(-1.0, 0.5)).numpy()
    np.testing.assert_allclose(slope, [slope_at(b, 7.0) for b in beyond], atol=1e-12)
    np.testing.assert_allclose(slope, weight * beyond)
    assert not weight[np.abs(beyond) < 1e-12].any()
    assert (np.diff(slope) >= -1e-12).all()  # the cost is convex
    assert np.abs(np.diff(weight)).max() < 0.25 * weight.max()  # in steps of .0005
    assert 6.9 < slope[-1] < 7.0
    assert -7.0 < slope[0] < -6.9


def test_a_variable_without_a_limit_is_never_pushed() -> None:
    limits = SoftLimits(torch.tensor([-np.inf, -1.0]), torch.tensor([1.0, np.inf]), 7.0, horizon=2)
    weight, slope = limits(torch.tensor([-9.0, 9.0, 2.0, -2.0], dtype=torch.float64))
    assert ((weight > 0) == torch.tensor([False, False, True, True])).all()
    assert (slope.sign() == torch.tensor([0, 0, 1, -1])).all()


@pytest.mark.parametrize("seed", [3, 4, 8])
def test_the_plan_costs_nearly_the_least_that_a_plan_can_cost(seed: int) -> None:
    """A linear model makes the cost convex, and a convex solver finds its minimum.

    Weights that appear where a sample crosses a limit let passes end beside the minimum, not at it; the solver's cost
    lacks the small rounding of the corner.
    """
    model, n = random_model(seed, n_y=2, n_mv=2, n_hidden=0), 15
    moves = Moves.over(n, 4, 2)
    horizon = horizon_of(model, loads_of(model, "outputs", n), moves, lambda z: z, n_cv=2)
    low, high, wanted = np.array([-np.inf, -0.1]), np.array([0.12, np.inf]), np.array([0.1, -0.3])
    limits = SoftLimits(torch.from_numpy(low), torch.from_numpy(high), 20.0, n)
    start, course = torch.zeros(1, 6, dtype=torch.float64), torch.from_numpy(np.tile(wanted, n))[None]
    applied, none = np.array([0.2, -0.1]), torch.zeros(1, moves.count, dtype=torch.float64)
    free = horizon(start, none)

    def cost(z: cp.Variable) -> cp.Expression:
        y = free.y[0].numpy() + free.slopes_t.numpy() @ z
        errors = cp.norm(cp.vstack([y - np.tile(wanted, n), np.full(2 * n, 0.1)]), 2, axis=0)
        beyond = cp.pos(y[0::2] - high[0]), cp.pos(low[1] - y[1::2])
        walls = [cp.sum(cp.norm(cp.vstack([b, np.full(n, EPS)]), 2, axis=0)) for b in beyond]
        change = cp.hstack([z[:2] - applied, z[2:] - z[:-2]])
        return np.tile([1.0, 0.5], n) @ errors + 20.0 * sum(walls) + 0.02 * cp.sum_squares(change)

    best = cp.Variable(moves.count)
    least = cp.Problem(cp.Minimize(cost(best)), [cp.abs(best) <= 1]).solve(solver=cp.CLARABEL)
    found = []
    for walls in (limits, None):
        planner = Planner(horizon, moves, Cost((1.0, 0.5), 0.02, 0.1, 0.25), passes=10, sweeps=8, limits=walls)
        found.append(float(cost(planner(start, course, torch.from_numpy(applied)[None], none)[0][0].numpy()).value))
    least, held, free_of_limits = np.array([least, *found]) - 20.0 * EPS * 2 * n  # less what sqrt(0 + eps^2) costs
    assert least * (1 - 1e-6) <= held < 1.25 * least
    assert free_of_limits > 4 * least


# ---------------------------------------------------------------------- closed loops
@pytest.mark.parametrize(("sp", "gain"), [(0.9, 1.0), (TOP, 1.3), (-TOP, 0.8), (0.7, 1.3)])
def test_a_set_point_beyond_a_limit_ends_at_the_limit(sp: float, gain: float) -> None:
    law, plant = (
        law_of(first_order(dead=1), **SMALL, cv_low=(-0.6,), cv_high=(0.8,)),
        first_order(gain=2 * gain, dead=1),
    )
    y, _, _ = closed(law, plant, np.full((80, 1), sp))
    assert abs(y[-1, 0] - np.clip(sp, -0.6, 0.8)) < 1e-3


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_overshoot_stays_within_the_limit_and_goes_beyond_without_it(sign: float) -> None:
    model, sp, high = swinging(), np.repeat([1.0, -0.5, 1.0], 40)[:, None], 1.005
    given = {"cv_high": (high,)} if sign > 0 else {"cv_low": (-high,)}
    held, free = (sign * closed(law_of(model, **p), model, sign * sp)[0] for p in (given, {}))
    assert free.max() - high > 0.02
    assert held.max() - high < 0.01
    assert abs(held[39, 0] - 1.0) < 0.005


@pytest.mark.parametrize("gain", [0.3, 1.0])
def test_a_limit_of_one_variable_goes_before_the_set_point_of_another(gain: float) -> None:
    """y1 wants 1.5 for which y2 would end at .75 gain; its limit is at .3 gain, where y1 is .6.

    The errors would gain less than l = (2 + gain)/gain of what y2 goes beyond, so it goes beyond by no more than the
    b at which the slope of the limit's cost is l.
    """
    model, sp = two_by_one(gain), np.tile([1.5, 0.0], (80, 1))
    free, held = (closed(law_of(model, **SMALL, cv_high=high), model, sp)[0] for high in (None, (None, 0.3 * gain)))
    most = (2 + gain) / gain
    allowed = brentq(lambda b: slope_at(b, PRICE) - most, 0.0, 1.0)
    assert free[-1, 1] > 0.6 * gain
    assert held[-1, 1] - 0.3 * gain < allowed
    assert held[:, 1].max() - 0.3 * gain < max(allowed, 0.01)
    assert 0.59 < held[-1, 0] < 0.6 + 2 / gain * allowed
    assert np.ptp(held[-20:], axis=0).max() < 1e-3


def test_a_network_keeps_its_limits_too() -> None:
    model = random_model(8, n_y=2, n_mv=2)
    model.c.copy_(-torch.tanh(model.b1) @ model.w2.T)  # zero, where the loop starts, is a rest
    sp = np.repeat([[0.1, 0.2], [-0.1, 0.19], [0.2, 0.15]], 12, axis=0)
    free, held = (closed(law_of(model, **SMALL, cv_high=high), model, sp)[0] for high in (None, (None, 0.2)))
    assert free[:, 1].max() > 0.21
    assert held[:, 1].max() < 0.202


def test_a_limit_that_no_plan_keeps_leaves_the_mv_at_its_end() -> None:
    """A load beyond the MV's reach: the MV stays at its end, and comes back as soon as the load has gone."""
    model = first_order()
    load = np.where(np.arange(100) < 50, 0.3, 0.0)
    y, mv, info = closed(law_of(model, **SMALL, cv_high=(0.5,)), model, np.zeros((100, 1)), load=load)
    assert y[49, 0] > 0.9
    assert mv[49, 0] == -1.0
    assert np.isfinite(info).all()
    np.testing.assert_allclose(y[-1], 0.0, atol=1e-3)


def test_a_search_does_not_see_the_limits_nor_the_recipe_and_its_law_has_them() -> None:
    """The trials' set points step over the record's range: most lie beyond the limit, where every law does as badly."""
    given = {"tuning": "search", "horizon": 8, "moves": 3, "passes": 1, "sweeps": 2}
    more = {"cv_high": (-2.5,), "preview": "ramp"}
    model = {"identified": first_order(pole=0.5)}
    plain, law = (Predictive.design(Predictive.Params(**given, **p), model, made_signals(), None) for p in ({}, more))
    assert law.analysis(None).figures == plain.analysis(None).figures
    assert law.planner.limits is not None
    assert law.n_state == plain.n_state + 2


# ---------------------------------------------------------------------- refusals
@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"cv_low": [1.0], "cv_high": [1.0]}, r"cv_low\[0\] is 1.0 and cv_high\[0\] 1.0; a low limit must be below"),
        ({"cv_low": [None, 2.0], "cv_high": [0.0, 1.0]}, r"cv_low\[1\] is 2.0 and cv_high\[1\] 1.0"),
        ({"cv_low": 1.0}, r"cv_low is 1.0; it must be a list"),
        ({"cv_high": ["hot"]}, r"cv_high\[0\] is 'hot'; it must be a number"),
    ],
)
def test_limits_that_make_no_sense_are_refused(values: dict, words: str) -> None:
    with pytest.raises(ParamsError, match=words):
        parse(Predictive.Params, values, "predictive")


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"cv_low": (0.0,)}, r"has 1 limits in cv_low; give one for each set point \(y0, y1\), null where"),
        ({"cv_high": (0.0, 1.0, 2.0)}, "has 3 limits in cv_high"),
        ({"cv_high": (None, 3.5)}, r"cv_high of y1 is 3.5, outside the signal's range \[-3, 3\] m; give a limit"),
        ({"cv_low": (float("nan"), None)}, "cv_low of y0 is nan, outside"),
        ({"cv_low": (None, -float("inf"))}, "cv_low of y1 is -inf, outside"),
    ],
)
def test_limits_that_do_not_fit_the_plant_are_refused(params: dict, words: str) -> None:
    with pytest.raises(LawError, match=words):
        limits_of(made_signals(2, 2), PredictiveParams(**params))
    with pytest.raises(LawError, match=words):
        law_of(random_model(0, n_y=2, n_mv=2), horizon=10, **params)


def test_check_refuses_them_before_a_model_is_there(plant: EquationPlant) -> None:
    Predictive.check_settings(Predictive.Params(cv_high=(0.9,)), plant.signals)
    with pytest.raises(LawError, match="cv_high of C_A is 9"):
        Predictive.check_settings(Predictive.Params(cv_high=(9.0,)), plant.signals)
