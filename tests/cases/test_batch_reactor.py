"""The batch reactor against the reference's figures and its own balances."""

import numpy as np
import pytest

from loopwright.pipeline.cases.batch_reactor.plant import BatchReactor
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.simulation.simulate import simulate_open


@pytest.fixture(scope="module")
def plant() -> BatchReactor:
    return BatchReactor()


def test_temperatures_without_reaction(plant):
    temperatures = plant.steady_curve[0]
    assert temperatures[[0, -1]] == pytest.approx([39.3, 99.5], abs=0.05)
    for t in (40.0, 60.0, 99.0):
        x, mv = plant.steady_state_at(t)
        assert np.abs(np.array(plant.rate(x, mv, plant.dv_nominal, plant.parameters()))).max() < 1e-12
        assert 0 <= mv[0] <= 1


def test_a_temperature_out_of_reach_is_refused(plant):
    with pytest.raises(PlantError, match=r"39\.26 to 99\.5"):
        plant.steady_state_at(110.0)


def test_what_reacts_stays_in_the_balance(plant):
    x0, _ = plant.start
    x = simulate_open(plant, x0, np.full((50, 1), 0.8))
    converted = 1 - x[:, 0]
    assert (np.diff(x[:, 0]) < 0).all()
    assert (x[1:, 1] <= converted[1:]).all()  # some of the B has become C
    assert (x[1:, 1] > 0).all()


@pytest.mark.parametrize(("period_s", "lowest"), [(1.0, 141_818.0), (10.0, 19_417.0), (20.0, 13_252.0)])
def test_the_profile_is_out_of_reach_at_first(period_s, lowest):
    """Full heating until the profile is met, and no error after: the smallest sum of squares there is."""

    class Sampled(BatchReactor):
        pass

    Sampled.period_s, Sampled.substeps = period_s, max(1, round(period_s))
    plant = Sampled()
    n = round(1000 / period_s)
    target = 54 + 71 * np.exp(-2.5e-3 * period_s * np.arange(n + 1))
    x0, _ = plant.start
    heated = simulate_open(plant, x0, np.ones((n, 1)))[:, 2]
    met = int(np.argmax(heated >= target))
    assert period_s * met == pytest.approx(171, abs=period_s)
    assert np.sum((target - heated)[:met] ** 2) == pytest.approx(lowest, rel=1e-3)
