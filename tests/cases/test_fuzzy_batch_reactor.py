"""The plant that is a map: printed numbers, steady states, and being a stand-in for the reactor."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_plant import COLD, HOT, FuzzyBatchReactor
from loopwright.pipeline.cases.jacketed_batch_reactor.plant import JacketedBatchReactor
from loopwright.pipeline.errors import PlantError


def after(plant: FuzzyBatchReactor, x: np.ndarray, mv: np.ndarray) -> np.ndarray:
    return np.array(plant.transition(x, mv, plant.dv_nominal, plant.parameters()))[:, 0]


def test_signals_and_period_are_those_of_the_reactor() -> None:
    for name in ("state_signals", "pv_signals", "sp_signals", "mv_signals", "dv_signals", "period_s"):
        assert getattr(FuzzyBatchReactor, name) == getattr(JacketedBatchReactor, name), name


def test_at_a_centre_only_its_rule_counts() -> None:
    # Theta_w1 at 40 degC and Theta_w2 at 60 degC as printed, by hand.
    plant = FuzzyBatchReactor()
    hot = after(plant, np.array([30.0, 40.0]), np.array([0.5, HOT]))
    assert hot == pytest.approx([0.0033 * 40 + 0.9967 * 30, 0.9429 * 40 + 0.0395 * 30 + 10.5969 * 0.5 + 0.5273])
    cold = after(plant, np.array([30.0, 60.0]), np.array([0.2, COLD]))
    assert cold[1] == pytest.approx(0.9076 * 60 + 0.0466 * 30 - 12.2555 * 0.2 + 1.9179)


def test_a_parameter_changes_by_its_name_alone() -> None:
    plant = FuzzyBatchReactor()
    changed = plant.with_parameters({"b_hot_40": 1.1 * plant.b_hot_40})
    x, mv = np.array([30.0, 40.0]), np.array([1.0, HOT])
    assert (after(changed, x, mv) - after(plant, x, mv))[1] == pytest.approx(0.1 * plant.b_hot_40)
    assert after(changed, x, np.array([1.0, COLD])) == pytest.approx(after(plant, x, np.array([1.0, COLD])), abs=0)
    assert len(plant.parameter_names()) == 2 + 2 * 4 * 5


def test_every_parameter_has_an_effect_somewhere() -> None:
    plant = FuzzyBatchReactor()
    rng = np.random.default_rng(0)
    x = rng.uniform(12, 70, (60, 2))
    mv = np.column_stack([rng.uniform(0.1, 1, 60), np.tile([HOT, COLD], 30)])
    batch = plant.transition.map(60)
    dv = np.zeros((0, 60))
    nominal = np.tile(plant.parameters()[:, None], 60)
    before = np.array(batch(x.T, mv.T, dv, nominal))
    for i, name in enumerate(plant.parameter_names()):
        moved = nominal.copy()
        moved[i] *= 1.1
        assert np.abs(np.array(batch(x.T, mv.T, dv, moved)) - before).max() > 1e-6, name


def test_steady_states_are_fixed_points_of_the_map() -> None:
    plant = FuzzyBatchReactor()
    ts, xs, flow = plant.steady_curve
    for i in range(0, len(ts), 30):
        mv = np.array([abs(flow[i]), HOT if flow[i] >= 0 else COLD])
        assert after(plant, xs[i], mv) == pytest.approx(xs[i], abs=1e-11)
        assert np.abs(np.array(plant.rate(xs[i], mv, plant.dv_nominal, plant.parameters()))).max() < 1e-12
    x, mv = plant.steady_state_at(50.0)
    assert x == pytest.approx([50.0, 50.0])
    assert mv[1] == HOT
    with pytest.raises(PlantError, match=r"no steady state at T = 10\.0 degC: neither mode holds it"):
        plant.steady_state_at(10.0)


def test_one_step_is_that_of_the_difference_quotient() -> None:
    plant, x, mv = FuzzyBatchReactor(), np.array([25.0, 33.0]), np.array([0.3, HOT])
    rate = np.array(plant.rate(x, mv, plant.dv_nominal, plant.parameters()))[:, 0]
    assert x + plant.period_s * rate == pytest.approx(after(plant, x, mv), abs=1e-12)
