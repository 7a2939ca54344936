"""The best rest of a linear plant is the linear program's: ranges by their ranks, then set points, then costs."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from identified_models import random_model, scaled_model
from scipy.optimize import linprog

from loopwright.pipeline.models.identified.identified import Identified
from loopwright.pipeline.optimal.economic import BestRest, RestProblem, RestWishes
from loopwright.pipeline.plants.identified import IdentifiedArrays, IdentifiedPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.serving.manifest import Signal

GAINS = np.array([[2.0, -0.8, 0.5], [0.6, 1.5, -0.4]])


def arrays_of(model: Identified) -> IdentifiedArrays:
    return IdentifiedArrays(**{f.name: getattr(model, f.name).numpy() for f in fields(IdentifiedArrays)})


def plant_of(gains: np.ndarray, n_sp: int = 1, pole: float = 0.8, dead: int = 0) -> IdentifiedPlant:
    """Lags with these gains, whose scaled numbers are the engineering ones."""
    n_y, n_mv = gains.shape
    model = scaled_model(
        n_y, n_mv, 0, n_y, a=np.eye(n_y) * pole, b=(1 - pole) * gains, rest=np.eye(n_y, n_y + n_mv + 1)
    )  # fmt: skip
    pv = tuple(Signal(f"y{i}", "m", -3.0, 3.0) for i in range(n_y))
    mv = tuple(Signal(f"u{i}", "V", -1.0, 1.0) for i in range(n_mv))
    return IdentifiedPlant(Signals(1.0, pv[:n_sp], pv, (), mv), arrays_of(model), most_dead_time=dead)


def asked(n_y: int, n_mv: int, **given: object) -> RestWishes:
    base = {
        "y_use": np.ones(n_y), "track": np.zeros(n_y), "y_low": np.full(n_y, -3.0), "y_high": np.full(n_y, 3.0),
        "rank": np.full(n_y, 3.0), "y_cost": np.zeros(n_y), "mv_low": -np.ones(n_mv), "mv_high": np.ones(n_mv),
        "mv_cost": np.zeros(n_mv), "held": np.full(n_mv, np.nan),
    }  # fmt: skip
    return RestWishes(**{name: np.asarray(value, dtype=np.float64) for name, value in (base | given).items()})


def best(plant: IdentifiedPlant, of: RestWishes, sp: float = 0.0) -> BestRest:
    found = RestProblem(plant).best(of, np.array([sp]), plant.parameters(), plant.dv_nominal, plant.start)
    assert found is not None
    return found


@pytest.mark.parametrize("dead", [0, 2])
@pytest.mark.parametrize("seed", range(4))
def test_the_cheapest_rest_is_the_linear_programs(seed: int, dead: int) -> None:
    rng = np.random.default_rng(seed)
    gains, y_cost, mv_cost = rng.normal(size=(2, 3)), rng.normal(size=2), rng.normal(size=3)
    low, high = -rng.uniform(0.1, 1, 2), rng.uniform(0.1, 1, 2)
    found = best(plant_of(gains, dead=dead), asked(2, 3, y_low=low, y_high=high, y_cost=y_cost, mv_cost=mv_cost))
    cost = mv_cost + y_cost @ gains
    program = linprog(cost, A_ub=np.vstack([gains, -gains]), b_ub=np.concatenate([high, -low]), bounds=[(-1, 1)] * 3)
    assert cost @ found.mv == pytest.approx(program.fun, abs=1e-4)
    assert found.y == pytest.approx(gains @ found.mv, abs=1e-6)
    assert not found.outside.any()


def test_a_set_point_comes_before_costs_and_a_range_before_a_set_point() -> None:
    plant, cost = plant_of(GAINS), [1.0, 1.0, 1.0]
    tracked = best(plant, asked(2, 3, track=[1, 0], mv_cost=cost), sp=0.7)
    assert tracked.y[0] == pytest.approx(0.7, abs=1e-4)
    shut_out = best(plant, asked(2, 3, track=[1, 0], y_high=[0.4, 3.0], mv_cost=cost), sp=0.7)
    assert shut_out.y[0] == pytest.approx(0.4, abs=1e-4)


@pytest.mark.parametrize("first", [0, 1])
def test_of_ranges_at_odds_the_one_of_the_first_rank_is_kept(first: int) -> None:
    """One MV alone drives both outputs upwards: y0 >= .5 and y1 <= .05 cannot be."""
    rank = [1.0, 4.0] if first == 0 else [4.0, 1.0]
    found = best(plant_of(GAINS[:, :1]), asked(2, 1, y_low=[0.5, -3], y_high=[3, 0.05], rank=rank))
    u = 0.25 if first == 0 else 0.05 / 0.6
    assert found.mv[0] == pytest.approx(u, abs=1e-4)
    assert found.outside[first] == 0
    assert found.outside[1 - first] == pytest.approx([0.5 - 2 * u, 0.6 * u - 0.05][1 - first], abs=1e-3)


def test_an_mv_that_is_held_stays_and_limits_of_operators_bind() -> None:
    found = best(plant_of(GAINS), asked(2, 3, mv_cost=[1, 1, 1], held=[np.nan, 0.3, np.nan], mv_low=[-0.5, -1, -0.2]))
    assert found.mv == pytest.approx([-0.5, 0.3, -0.2], abs=1e-4)


def test_a_level_that_integrates_rests_under_the_mv_that_balances_it() -> None:
    """y+ = y + .1 (u - .2): the level may be anywhere in its range, and the valve is where it balances."""
    model = scaled_model(1, 1, 0, 1, a=[[1.0]], b=[[0.1]], c=[-0.02], rest=np.eye(1, 3))
    s, u = (Signal("y", "m", -3.0, 3.0),), (Signal("u", "V", -1.0, 1.0),)
    plant = IdentifiedPlant(Signals(1.0, s, s, (), u), arrays_of(model), mv=np.array([0.2]))
    found = best(plant, asked(1, 1, y_low=[0.5], y_high=[1.0], y_cost=[1.0]))
    assert found.mv[0] == pytest.approx(0.2, abs=1e-5)
    assert found.y[0] == pytest.approx(0.5, abs=1e-4)


def test_a_network_rests_where_its_own_steps_leave_it() -> None:
    model = random_model(3, 2, 2)
    pv, mv = tuple(Signal(f"y{i}", "m", -3, 3) for i in range(2)), tuple(Signal(f"u{i}", "V", -1, 1) for i in range(2))
    plant = IdentifiedPlant(Signals(1.0, pv[:1], pv, (), mv), arrays_of(model))
    found = best(plant, asked(2, 2, mv_cost=[1.0, -0.5], y_low=[-0.2, -3.0], y_high=[0.4, 3.0]))
    x, p = plant.start[0], plant.parameters()
    for _ in range(600):
        x = plant.step(x, found.mv, plant.dv_nominal, p)
    assert plant.measured(x) == pytest.approx(found.y, abs=1e-4)
    assert -0.2 - 1e-4 <= found.y[0] <= 0.4 + 1e-4
