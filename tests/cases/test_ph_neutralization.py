"""The pH plant against the reference's figures, and its titration curve against a bracketing solver."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.pipeline.cases.ph_neutralization.plant import PhNeutralization, PhNeutralization15s, ph_of

PK1, PK2 = 6.35, 10.25


@pytest.fixture(scope="module")
def plant() -> PhNeutralization:
    return PhNeutralization()


def charge(ph: float, wa: float, wb: float) -> float:
    carbonate = (1 + 2 * 10 ** (ph - PK2)) / (1 + 10 ** (PK1 - ph) + 10 ** (ph - PK2))
    return wa + 10 ** (ph - 14) + wb * carbonate - 10 ** (-ph)


def test_ph_is_the_bracketed_root():
    w = ca.SX.sym("w", 2)
    root = ca.Function("root", [w], [ph_of(w[0], w[1], PK1, PK2)])
    rng = np.random.default_rng(0)
    wa, wb = rng.uniform(-3e-3, 3e-3, 3000), np.append(10 ** rng.uniform(-6, -2, 2900), np.zeros(100))
    found = np.array(root.map(3000)(np.vstack([wa, wb])))[0]
    wanted = [brentq(charge, 0, 14, args=pair, xtol=1e-14, rtol=1e-14) for pair in zip(wa, wb, strict=True)]
    assert np.abs(found - wanted).max() < 1e-12


def test_derivative_of_the_root_is_the_implicit_one():
    w = ca.SX.sym("w", 2)
    slopes = ca.Function("slopes", [w], [ca.jacobian(ph_of(w[0], w[1], PK1, PK2), w)])
    for wa, wb in ((-4.36e-4, 5.28e-4), (-5.07e-4, 5.15e-4), (1e-3, 1e-4), (-2e-3, 0.0)):
        ph = brentq(charge, 0, 14, args=(wa, wb), xtol=1e-15, rtol=1e-15)
        by_ph = (charge(ph + 1e-5, wa, wb) - charge(ph - 1e-5, wa, wb)) / 2e-5
        implicit = [-1 / by_ph, -(charge(ph, wa, 1.0) - charge(ph, wa, 0.0)) / by_ph]
        assert np.array(slopes([wa, wb]))[0] == pytest.approx(implicit, rel=1e-7)


def test_nominal_steady_state(plant):
    (x,) = plant.steady_states(936.0)
    assert x[0] == pytest.approx(14.009, abs=2e-3)
    assert x[1:] == pytest.approx([-4.360e-4, 5.276e-4], abs=1e-7)
    assert float(plant.measure(x)[0]) == pytest.approx(7.026, abs=5e-4)


@pytest.mark.parametrize(("ph", "q3", "gain"), [(7.0, 933.0, 0.0084), (8.0, 991.0, 0.0433), (9.0, 1020.5, 0.0172)])
def test_base_flow_and_static_gain(plant, ph, q3, gain):
    x, mv = plant.steady_state_at(ph)
    lin = plant.linearize(x, mv)
    assert mv[0] == pytest.approx(q3, abs=0.05)
    assert float((-lin.c @ np.linalg.solve(lin.a, lin.b))[0, 0]) == pytest.approx(gain, abs=5e-5)
    assert -1 / lin.eigenvalues.real.min() == pytest.approx(90, abs=5)


def test_gain_is_largest_at_8_23(plant):
    cv, _, mv = plant.steady_curve
    gain = np.gradient(cv, mv)
    inside = (cv > 6.5) & (cv < 9.0)
    assert cv[inside][gain[inside].argmax()] == pytest.approx(8.23, abs=0.01)
    assert gain[inside].max() / gain[inside].min() == pytest.approx(9.4, abs=0.05)


def test_the_faster_sampled_tank_is_the_same_tank(plant):
    fast = PhNeutralization15s()
    x, mv = plant.steady_state_at(7.5)
    slow_step, fast_step, p = plant.stepper(), fast.stepper(), plant.parameters()
    for _ in range(4):
        x = fast_step(x, mv + 30.0, fast.dv_nominal, p)
    start, _ = plant.steady_state_at(7.5)
    assert x == pytest.approx(slow_step(start, mv + 30.0, plant.dv_nominal, p), rel=1e-9)
