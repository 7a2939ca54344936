"""The plant's text, and what is derived from it, against figures of the reference and against theory."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from made_up_plant import Lag

from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.plants.equations import EquationPlant


@pytest.fixture(scope="module")
def cstr() -> ThiosulfateCstr:
    return ThiosulfateCstr()


HOT, MIDDLE, COLD = (0.07545, 376.27), (0.66613, 308.499), (0.98717, 271.66)


def test_three_steady_states(cstr):
    states = cstr.steady_states(250.0)
    assert len(states) == 3
    for x, (c, t) in zip(states, (HOT, MIDDLE, COLD), strict=True):
        assert x[0] == pytest.approx(c, abs=1e-5)
        assert x[1] == pytest.approx(t, abs=5e-3)
        rate = cstr.rate(x, [250.0], cstr.dv_nominal, cstr.parameters())
        assert np.abs(np.array(rate)).max() < 1e-8


@pytest.mark.parametrize(
    ("branch", "eigenvalues"),
    [(0, (-0.27, -3.37)), (1, (0.4548, -0.1854)), (2, (-0.204 - 0.015j, -0.204 + 0.015j))],
)
def test_eigenvalues(cstr, branch, eigenvalues):
    found = cstr.linearize(cstr.steady_states(250.0)[branch], np.array([250.0])).eigenvalues
    # Half a unit of the last digit that the reference prints.
    digits = {0: 5e-3, 1: 1e-4, 2: 5e-4}[branch]
    assert np.abs(found - np.array(eigenvalues)).max() < digits


def test_turning_points(cstr):
    found = np.array([[*x, mv] for x, mv in cstr.turning_points()])
    assert found[:, 0] == pytest.approx([0.2556, 0.9029], abs=1e-4)
    assert found[:, 1:] == pytest.approx(np.array([[339.4, 165.8], [290.6, 297.9]]), abs=0.05)


def test_eigenvalue_crosses_zero_at_a_turning_point(cstr):
    for x, mv in cstr.turning_points():
        assert np.abs(cstr.linearize(x, np.array([mv])).eigenvalues).min() < 1e-7


def test_steady_mv_is_the_explicit_one(cstr):
    # Both balances of the CSTR solved by hand for the jacket temperature at a given concentration.
    for c in (0.05, 0.3, 0.66613, 0.95):
        rate = cstr.F / cstr.V * (1 - c) / 2
        t = -cstr.E / (cstr.R * np.log(rate / (cstr.k0 * c**2)))
        heat = cstr.rho * cstr.cp
        q = cstr.F / cstr.V * (cstr.T_in - t) + 2 * cstr.minus_dH / heat * rate
        x, mv = cstr.steady_state_at(c)
        assert x == pytest.approx([c, t], rel=1e-10)
        assert mv[0] == pytest.approx(t - q * cstr.V * heat / cstr.UA, rel=1e-9)


def test_the_exact_inverse_would_ring(cstr):
    lin = cstr.linearize(cstr.steady_states(250.0)[1], np.array([250.0]))
    zeros = lin.sampled_zeros(cstr.period_s)
    assert zeros.real == pytest.approx([-1.046], abs=5e-4)
    assert zeros.imag == pytest.approx([0.0])


def test_inverse_of_the_sampled_plant_has_its_zeros_as_eigenvalues(cstr):
    lin = cstr.linearize(cstr.steady_states(250.0)[1], np.array([250.0]))
    phi, gamma = lin.sampled(cstr.period_s)
    # mv = -(c gamma)^-1 c phi x makes the next CV zero.
    closed = phi - gamma @ np.linalg.solve(lin.c[:1] @ gamma, lin.c[:1] @ phi)
    expected = np.sort_complex([0.0, *lin.sampled_zeros(cstr.period_s)])
    assert np.sort_complex(np.linalg.eigvals(closed)) == pytest.approx(expected, abs=1e-9)


def test_regions_are_bounded_by_the_turning_points(cstr):
    assert tuple(cstr.regions) == ("low", "middle", "high")
    assert cstr.region(np.array([HOT[0], MIDDLE[0], COLD[0], 0.2555, 0.2557])).tolist() == [0, 1, 2, 0, 1]
    assert cstr.region(np.full((2, 3), 0.5)).shape == (2, 3)
    assert tuple(Lag().regions) == ("all",)
    assert Lag().region(np.array([-1.0, 5.0])).tolist() == [0, 0]


def exact_transition(plant: EquationPlant) -> ca.Function:
    """(x, mv, dv, p) -> x one period later by CVODES at tight tolerances; a plant that is a map is that map."""
    if type(plant).transition is not EquationPlant.transition:
        return plant.transition
    x, mv, dv, p = (ca.SX.sym(n, plant.rate.numel_in(i)) for i, n in enumerate("xmdp"))
    dae = {"x": x, "p": ca.vertcat(mv, dv, p), "ode": plant.rate(x, mv, dv, p)}
    options = {"abstol": 1e-12, "reltol": 1e-10, "max_num_steps": 100_000}
    solver = ca.integrator("exact", "cvodes", dae, 0.0, plant.period_s / plant.time_unit_s, options)
    x0, m0, d0, p0 = (ca.MX.sym(n, s.numel()) for n, s in zip("xmdp", (x, mv, dv, p), strict=True))
    return ca.Function("exact", [x0, m0, d0, p0], [solver(x0=x0, p=ca.vertcat(m0, d0, p0))["xf"]])


def with_substeps(substeps: int) -> EquationPlant:
    """The first case's plant with another number of RK4 substeps a period."""
    return type("Resolved", (ThiosulfateCstr,), {"substeps": substeps})()


@pytest.mark.parametrize("name", PLANTS)
def test_rk4_is_the_exact_transition(name):
    plant = PLANTS[name]()
    reference = exact_transition(plant)
    low, high = (np.array([getattr(s, end) for s in plant.mv_signals]) for end in ("low", "high"))
    _, xs, _ = plant.steady_curve
    spans = np.array([s.high - s.low for s in plant.state_signals])
    for share in np.random.default_rng(1).random(12):
        x, mv = xs[int(share * len(xs))], low + (high - low) * (7 * share % 1)
        rk4, exact = (
            np.array(f(x, mv, plant.dv_nominal, plant.parameters()))[:, 0] for f in (plant.transition, reference)
        )
        assert np.abs((rk4 - exact) / spans).max() < 1e-6
        assert plant.stepper()(x, mv, plant.dv_nominal, plant.parameters()) == pytest.approx(rk4, rel=1e-13)


@pytest.mark.parametrize("name", PLANTS)
def test_a_meter_gives_the_measurement_to_the_last_bit(name):
    plant = PLANTS[name]()
    measure, xs = plant.meter(), plant.steady_curve[1][:20]
    found = [measure(x) for x in xs]  # each in an array of its own
    assert np.array_equal(np.array(found), np.array([plant.measure(x) for x in xs]))


def test_rk4_has_order_four(cstr):
    x, mv = np.array([0.5, 330.0]), np.array([250.0])

    def end(substeps: int) -> np.ndarray:
        return np.array(with_substeps(substeps).transition(x, mv, cstr.dv_nominal, cstr.parameters()))[:, 0]

    truth = end(1600)
    errors = [np.abs(end(n) - truth)[1] for n in (40, 80, 160)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders == pytest.approx([4.0, 4.0], abs=0.2)


def test_five_substeps_are_too_few(cstr):
    x, mv = np.array([0.98, 330.0]), np.array([500.0])
    coarse = np.array(with_substeps(5).transition(x, mv, cstr.dv_nominal, cstr.parameters()))[:, 0]
    fine = np.array(cstr.transition(x, mv, cstr.dv_nominal, cstr.parameters()))[:, 0]
    assert not np.abs(coarse - fine).max() < 1.0


@pytest.mark.parametrize("plant", [ThiosulfateCstr(), Lag()], ids=lambda p: p.name)
def test_symbolic_parameters_are_the_fields(plant):
    rng = np.random.default_rng(2)
    x = np.array([rng.uniform(s.low, s.high) for s in plant.state_signals])
    mv = np.array([rng.uniform(s.low, s.high) for s in plant.mv_signals])
    for name in plant.parameter_names():
        value = 1.1 * getattr(plant, name)
        through_vector = plant.rate(x, mv, plant.dv_nominal, plant.parameters({name: value}))
        through_field = replace(plant, **{name: value}).derivative(ca.DM(x), ca.DM(mv), ca.DM(0, 1))
        assert np.array(through_vector).ravel() == pytest.approx(np.array(ca.DM(through_field)).ravel(), rel=1e-12)
        unchanged = plant.rate(x, mv, plant.dv_nominal, plant.parameters())
        assert not np.allclose(np.array(through_vector), np.array(unchanged), rtol=1e-9), f"{name} has no effect"


@pytest.mark.parametrize("name", PLANTS)
def test_parameters_and_signals_have_units(name):
    assert all(PLANTS[name].parameter_units().values())
    assert all(s.unit for s in (*PLANTS[name].state_signals, *PLANTS[name].mv_signals))


def test_wrong_names_and_points_are_plant_errors(cstr):
    with pytest.raises(PlantError, match=r"no parameter 'UAA'; it has V, F, .*UA"):
        cstr.parameters({"UAA": 1.0})
    with pytest.raises(PlantError, match="no parameter"):
        cstr.with_parameters({"temperature": 1.0})
    with pytest.raises(PlantError, match=r"no steady state at C_A = 1.7 mol/l; it has some from 0\.00"):
        cstr.steady_state_at(1.7)


def test_lag_in_minutes_is_sampled_in_seconds():
    lag = Lag()
    lin = lag.linearize(np.zeros(1), np.zeros(1))
    decay = np.exp(-lag.period_s / (60 * lag.tau))
    assert lin.eigenvalues == pytest.approx([-1 / (60 * lag.tau)])
    phi, gamma = lin.sampled(lag.period_s)
    assert phi == pytest.approx(np.array([[decay]]))
    assert gamma == pytest.approx(np.array([[lag.gain * (1 - decay)]]))
    x = lag.stepper()(np.array([3.0]), np.array([1.0]), lag.dv_nominal, lag.parameters())
    assert x == pytest.approx([2.0 + decay], rel=1e-8)
    assert lag.steady_state_at(30.0)[1] == pytest.approx([1.5])
    assert lag.turning_points() == []


def test_a_plant_travels_to_another_process(cstr):
    assert cstr.regions
    copy = pickle.loads(pickle.dumps(cstr))
    assert copy == cstr
    x = np.array(MIDDLE)
    args = x, np.array([250.0]), cstr.dv_nominal, cstr.parameters()
    assert copy.stepper()(*args) == pytest.approx(cstr.stepper()(*args), rel=0)
