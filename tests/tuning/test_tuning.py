"""Tuning rules against the theory they come from."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.pipeline.errors import LawError, PlantError
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.steady import Linearization
from loopwright.pipeline.tuning.loop_search import DevelopmentLoops
from loopwright.pipeline.tuning.reduction import LagWithDeadTime, minimal
from loopwright.pipeline.tuning.rules import (
    AllPole,
    PidSettings,
    imc_pid,
    itae_pid,
    optimized_imc,
    peak_sensitivity,
    robust_imc,
    sampled_loop,
    simc_pid,
)

MIDDLE = 0.66613


def linear(a: list[list[float]], b: list[float], c: list[float]) -> Linearization:
    n = len(a)
    return Linearization(np.zeros(n), np.zeros(1), np.array(a), np.array(b)[:, None], np.array([c]))


def second_order(b0: float, a1: float, a0: float) -> Linearization:
    """b0/(s^2 + a1 s + a0)."""
    return linear([[0.0, 1.0], [-a0, -a1]], [0.0, b0], [1.0, 0.0])


def first_order(gain: float, tau: float) -> Linearization:
    return linear([[-1 / tau]], [gain / tau], [1.0])


@pytest.fixture(scope="module")
def middle(plant: EquationPlant) -> Linearization:
    return plant.linearize(*plant.steady_state_at(MIDDLE))


def closed_loop_poles(process: AllPole, s: PidSettings) -> np.ndarray:
    """Roots of the continuous loop without filter: Ti s prod(s - p) + b0 Kc (Td Ti s^2 + Ti s + 1)."""
    own = np.real(np.poly(process.poles))
    plant_side = np.polymul([s.ti_s, 0.0], own)
    return np.roots(np.polyadd(plant_side, process.b0 * s.kc * np.array([s.td_s * s.ti_s, s.ti_s, 1.0])))


def test_transfer_function_of_the_cstr(middle: Linearization) -> None:
    process = AllPole.of(middle)
    np.testing.assert_allclose(process.poles, [0.4548, -0.1854], atol=1e-3)
    s = 0.3 + 0.7j
    exact = middle.c[0] @ np.linalg.solve(s * np.eye(2) - middle.a, middle.b[:, 0])
    assert process.b0 / np.prod(s - process.poles) == pytest.approx(exact, rel=1e-10)


def test_states_that_do_not_count_are_not_counted(middle: Linearization) -> None:
    """A state that the MV does not reach, one that the PV does not see, and other units of the states."""
    a = np.block([[middle.a, np.ones((2, 1)), np.zeros((2, 1))], [np.zeros((1, 2)), np.array([[-3.0, 0.0]])],
                  [np.array([[0.2, -0.1, 0.0, 0.4]])]])  # fmt: skip
    b, c = np.vstack([middle.b, [[0.0], [1.0]]]), np.array([[*middle.c[0], 0.5, 0.0]])
    unit = np.array([1e-4, 30.0, 1.0, 1e3])
    big = Linearization(np.zeros(4), np.zeros(1), a * unit[:, None] / unit, b * unit[:, None], c / unit)
    small = minimal(big)
    assert small.a.shape == (2, 2)
    np.testing.assert_allclose(small.eigenvalues, middle.eigenvalues, rtol=1e-8)
    at = 0.3 + 0.7j
    exact = middle.c[0] @ np.linalg.solve(at * np.eye(2) - middle.a, middle.b[:, 0])
    assert small.c[0] @ np.linalg.solve(at * np.eye(2) - small.a, small.b[:, 0]) == pytest.approx(exact, rel=1e-9)
    assert AllPole.of(big).b0 == pytest.approx(AllPole.of(middle).b0, rel=1e-8)
    assert minimal(middle).a is middle.a


def test_moments_of_a_lag_and_of_two() -> None:
    assert LagWithDeadTime.of(first_order(-3.0, 40.0)) == LagWithDeadTime(
        pytest.approx(-3.0), pytest.approx(40.0), pytest.approx(0.0, abs=1e-9)
    )
    tau1, tau2 = 30.0, 8.0
    two = LagWithDeadTime.of(second_order(5.0 / (tau1 * tau2), 1 / tau1 + 1 / tau2, 1 / (tau1 * tau2)))
    assert two.gain == pytest.approx(5.0)
    assert two.tau_s == pytest.approx(np.hypot(tau1, tau2))
    assert two.dead_time_s == pytest.approx(tau1 + tau2 - np.hypot(tau1, tau2))


@pytest.mark.parametrize("ratio", [0.1, 0.4, 1.0])
def test_itae_follows_a_step_of_the_lag_that_it_is_made_for(ratio: float) -> None:
    """On a lag with dead time, finely sampled: little overshoot, and settled within some dead and lag times."""
    tau, gain, steps = 10.0, -2.0, 40
    theta = ratio * tau
    rule, h = itae_pid(LagWithDeadTime(gain, tau, theta), 0.0), theta / steps
    u, y, e1, e2, decay = [0.0] * steps, [0.0], 0.0, 0.0, np.exp(-h / tau)
    while len(y) * h < 4 * theta + 4 * tau:
        e = 1.0 - y[-1]
        u.append(u[-1] + rule.kc * (e - e1 + h / rule.ti_s * e + rule.td_s / h * (e - 2 * e1 + e2)))
        y.append(decay * y[-1] + (1 - decay) * gain * u[-1 - steps])
        e1, e2 = e, e1
    assert max(y) < 1.1
    assert np.abs(np.array(y[round(0.8 * len(y)) :]) - 1).max() < 0.05


def test_itae_counts_the_sampling_as_dead_time_and_scales() -> None:
    ideal = itae_pid(LagWithDeadTime(2.0, 10.0, 3.0), 0.0)
    assert itae_pid(LagWithDeadTime(2.0, 10.0, 1.0), 4.0) == ideal
    assert itae_pid(LagWithDeadTime(2.0, 10.0, 0.0), 3.0, sampling=1.0) == ideal
    slower = itae_pid(LagWithDeadTime(-1.0, 20.0, 6.0), 0.0)
    assert (slower.kc, slower.ti_s, slower.td_s) == pytest.approx((-2 * ideal.kc, 2 * ideal.ti_s, 2 * ideal.td_s))


@given(st.floats(0.3, 5.0))
@settings(max_examples=30, deadline=None)
def test_imc_of_the_unstable_plant_gives_the_filters_poles(middle: Linearization, lambda_s: float) -> None:
    """The closed loop is (alpha s + 1)/(lambda s + 1)^2 and what cancels: the plant's stable pole."""
    process = AllPole.of(middle)
    poles = closed_loop_poles(process, imc_pid(process, lambda_s))
    expected = np.sort([-1 / lambda_s, -1 / lambda_s, process.poles[1].real])
    np.testing.assert_allclose(np.sort(poles.real), expected, rtol=2e-4)
    assert np.abs(poles.imag).max() < 1e-3 / lambda_s


@given(st.floats(0.2, 3.0), st.floats(0.3, 3.0), st.floats(0.2, 2.0), st.sampled_from([-2.0, 0.5]))
@settings(max_examples=40, deadline=None)
def test_imc_of_stable_plants_gives_the_filters_pole(lambda_s: float, wn: float, zeta: float, gain: float) -> None:
    process = AllPole.of(second_order(gain, 2 * zeta * wn, wn**2))
    s = imc_pid(process, lambda_s)
    at = 0.1 + 1.3j
    g = process.b0 / np.prod(at - process.poles)
    loop = s.kc * (1 + 1 / (s.ti_s * at) + s.td_s * at) * g
    assert loop / (1 + loop) == pytest.approx(1 / (lambda_s * at + 1), rel=1e-9)


@pytest.mark.parametrize("pole", [-0.5, 0.5])
def test_imc_of_one_pole_is_a_pi(pole: float) -> None:
    process = AllPole.of(linear([[pole]], [2.0], [1.0]))
    settings_ = imc_pid(process, 0.7)
    assert settings_.td_s == 0
    assert closed_loop_poles(process, settings_).real.max() < 0


def test_imc_stabilizes_the_sampled_cstr(middle: Linearization, plant: EquationPlant) -> None:
    """Continuous IMC is always stable; sampled at 0.5 s, too short a filter is not."""
    process = AllPole.of(middle)

    def radius(lambda_s: float) -> float:
        return float(np.abs(np.linalg.eigvals(sampled_loop(middle, imc_pid(process, lambda_s), plant.period_s))).max())

    assert all(radius(v) < 1 for v in (1.0, 1.2, 1.6, 2.5, 4.0))
    assert radius(0.8) > 1
    assert peak_sensitivity(middle, imc_pid(process, 0.1), plant.period_s) == float("inf")
    settings_ = robust_imc(middle, plant.period_s)
    assert np.abs(np.linalg.eigvals(sampled_loop(middle, settings_, plant.period_s))).max() < 1


def test_peak_sensitivity_of_a_known_loop() -> None:
    """An integrator under P control, kh = 1/2: L = 1/2/(z - 1), |S| largest at z = -1: 1/(1 - 1/4)."""
    integrator = linear([[0.0]], [1.0], [1.0])
    peak = peak_sensitivity(integrator, PidSettings(0.5, 1e9), 1.0)
    assert peak == pytest.approx(4 / 3, rel=1e-3)


def test_robust_imc_keeps_its_peak() -> None:
    stable = second_order(1.0, 1.5, 0.5)
    loose, tight = robust_imc(stable, 0.2, peak=1.3), robust_imc(stable, 0.2, peak=1.8)
    assert peak_sensitivity(stable, tight, 0.2) <= 1.8
    assert peak_sensitivity(stable, loose, 0.2) <= 1.3
    assert abs(tight.kc) > abs(loose.kc)


def test_simc_is_skogestads_example() -> None:
    """Two time constants and a delay with tau_c = theta: Kc = tau1/(2 k theta), tauI = min(tau1, 8 theta)."""
    gain, tau1, tau2, theta = 3.0, 10.0, 2.0, 0.5
    process = AllPole.of(second_order(gain / (tau1 * tau2), 1 / tau1 + 1 / tau2, 1 / (tau1 * tau2)))
    ideal = simc_pid(process, 2 * theta, theta)
    kc, tau_i, tau_d = tau1 / (2 * gain * theta), min(tau1, 8 * theta), tau2
    assert ideal.kc == pytest.approx(kc * (1 + tau_d / tau_i))
    assert ideal.ti_s == pytest.approx(tau_i + tau_d)
    assert ideal.td_s == pytest.approx(tau_i * tau_d / (tau_i + tau_d))
    pi = simc_pid(AllPole.of(first_order(gain, tau1)), 2 * theta, theta)
    assert (pi.kc, pi.ti_s, pi.td_s) == (pytest.approx(kc), pytest.approx(tau_i), 0.0)


UNSTABLE_WITH_ZERO = linear([[0.2, 1.0], [0.0, -1.0]], [1.0, 1.0], [1.0, 0.5])
INTEGRATOR_WITH_ZERO = linear([[0.0, 1.0], [0.0, -1.0]], [0.0, 1.0], [1.0, 0.5])  # its matrix is singular


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (lambda: simc_pid(AllPole.of(second_order(1.0, 0.3, -0.1)), 0.5), "stable real poles"),
        (lambda: simc_pid(AllPole.of(second_order(1.0, 0.1, 1.0)), 0.5), "stable real poles"),
        (lambda: imc_pid(AllPole.of(second_order(1.0, -3.0, 2.0)), 0.5), "two poles in the right half plane"),
        (lambda: imc_pid(AllPole.of(first_order(1.0, 1.0)), 0.0), "lambda_s is 0"),
        (lambda: AllPole.of(linear([[0.0, 1.0], [-1.0, -1.0]], [0.0, 1.0], [1.0, 0.5])), "no zero"),
        (lambda: AllPole.of(linear([[-1.0, 1.0], [0.0, -1.0]], [1.0, 1.0], [1.0, 0.5])), "`optimized` or `itae`"),
        (lambda: AllPole.near(UNSTABLE_WITH_ZERO), "no zero.* choose tuning `manual`"),
        (lambda: AllPole.near(INTEGRATOR_WITH_ZERO), "no zero.* choose tuning `manual`"),
        (lambda: AllPole.of(linear([[-1.0, 0.0], [0.0, -2.0]], [1.0, 0.0], [0.0, 1.0])), "does not act"),
        (lambda: robust_imc(second_order(1.0, -20.0, -30.0), 0.5), "no IMC filter"),
        (lambda: LagWithDeadTime.of(second_order(1.0, 0.3, -0.1)), "needs a stable plant"),
        (lambda: LagWithDeadTime.of(second_order(1.0, 0.1, 1.0)), "moments"),
        (lambda: itae_pid(LagWithDeadTime(1.0, 2.0, 0.0), 30.0), "up to the time constant"),
    ],
)
def test_what_a_rule_cannot_do_is_said(rule, message: str) -> None:
    with pytest.raises(LawError, match=message):
        rule()


def test_optimized_imc_finds_the_cheapest(middle: Linearization) -> None:
    process = AllPole.of(middle)
    asked: list[int] = []

    def cost(rows) -> np.ndarray:
        asked.append(len(rows))
        wanted = imc_pid(process, 1.5)
        return np.array([abs(np.log(r.kc / wanted.kc)) + 0.1 * abs(r.set_point_weight - 0.55) for r in rows])

    base = PidSettings(1.0, 1.0, filter_s=0.1, tracking_s=3.0, set_point_weight=0.7)
    found = optimized_imc(process, 0.5, cost, base)
    assert found.kc == pytest.approx(imc_pid(process, 1.5).kc, rel=0.15)
    assert abs(found.set_point_weight - 0.55) < 0.06
    assert (found.filter_s, found.tracking_s) == (0.1, 3.0)
    assert sum(asked) < 100
    assert optimized_imc(process, 0.5, cost, base, optimize_weight=False).set_point_weight == 0.7
    with pytest.raises(LawError, match="no IMC filter gave a finite closed loop"):
        optimized_imc(process, 0.5, lambda rows: np.full(len(rows), np.inf), base)


def test_development_loops_start_at_rest(plant: EquationPlant) -> None:
    loops = DevelopmentLoops.draw(plant, (1, 2), 3, 5)
    assert loops.sp.shape == (15, 2, 1)
    assert (np.diff(loops.sp[..., 0].reshape(3, 5, 2), axis=1) == 0).all()
    np.testing.assert_allclose(loops.x0[:, 0], loops.sp[0, :, 0], rtol=1e-9)
    still = DevelopmentLoops.draw(plant, (1,), 1, 4)

    def hold(sp, pv, dv, mv_applied, state):
        return mv_applied, state, mv_applied

    assert still.run(hold, 0, candidates=2).cost.max() < 1e-6


def test_time_weighted_errors_count_what_comes_late(plant: EquationPlant) -> None:
    """An MV that never moves: the error stays as it is over each hold, but for the plant's own motion."""
    loops = DevelopmentLoops.draw(plant, (3,), 2, 6)

    def hold(sp, pv, dv, mv_applied, state):
        return mv_applied, state, mv_applied

    plain, weighted = (loops.run(hold, 0, time_weighted=w).cost[0] for w in (False, True))
    step = abs(loops.sp[6, 0, 0] - loops.sp[0, 0, 0])
    assert plain == pytest.approx(step / 2, rel=1e-3)
    assert weighted == pytest.approx(step / 2 * 2.5, rel=1e-3)  # mean of 0..5 over the hold with an error


def test_development_loops_must_be_asked_for(plant: EquationPlant) -> None:
    with pytest.raises(PlantError, match="need seeds"):
        DevelopmentLoops.draw(plant, (), 3, 5)


@given(st.floats(0.0, 3.0), st.floats(0.3, 5.0), st.sampled_from([-2.0, 0.5]))
@settings(max_examples=30, deadline=None)
def test_imc_of_a_lag_with_dead_time_gives_the_filter_where_pade_is_exact(
    theta: float, lambda_s: float, gain: float
) -> None:
    """With the dead time as (1 - s theta/2)/(1 + s theta/2) the closed loop is that numerator over lambda s + 1."""
    tau, at = 4.0, 0.07 + 0.4j
    s = imc_pid(LagWithDeadTime(gain, tau, theta), lambda_s)
    g = gain / (tau * at + 1) * (1 - at * theta / 2) / (1 + at * theta / 2)
    loop = s.kc * (1 + 1 / (s.ti_s * at) + s.td_s * at) * g
    assert loop / (1 + loop) == pytest.approx((1 - at * theta / 2) / (lambda_s * at + 1), rel=1e-9)


def test_a_plant_that_no_lag_resembles_is_taken_with_dead_time() -> None:
    """Four equal lags start without a slope: the lag with dead time has their area, mean and variance."""
    n, tau = 4, 5.0
    a = (np.eye(n, k=-1) - np.eye(n)) / tau
    chain = linear(a.tolist(), [2.0 / tau, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    found = AllPole.near(chain)
    assert isinstance(found, LagWithDeadTime)
    assert (found.gain, found.tau_s) == (pytest.approx(2.0), pytest.approx(tau * np.sqrt(n)))
    assert found.dead_time_s == pytest.approx(n * tau - tau * np.sqrt(n))


@pytest.mark.parametrize("late", [0.0, 1.0, 3.0, 2.4])
def test_a_loop_with_dead_time_is_that_of_the_plant_with_a_shift_register(late: float) -> None:
    """Each sample of dead time is a state of a sampled plant; a part of one blends two of them."""
    lin, s = first_order(2.0, 10.0), PidSettings(0.8, 9.0, 0.5, filter_s=0.2)
    whole, part = int(late), late - int(late)
    phi, gamma = lin.sampled(1.0)
    n = 1 + whole + 1
    a, b = np.zeros((n, n)), np.zeros((n, 1))
    taps = np.zeros(whole + 2)
    taps[whole], taps[whole + 1] = 1 - part, part
    a[0, 0], a[0, 1:], b[0, 0] = phi[0, 0], gamma[0, 0] * taps[1:], gamma[0, 0] * taps[0]
    b[1, 0], a[2:, 1:-1] = 1.0, np.eye(whole)
    shifted = SimpleNamespace(sampled=lambda _: (a, b), c=np.eye(1, n))
    poles, wanted = (np.linalg.eigvals(m) for m in (sampled_loop(lin, s, 1.0, late), sampled_loop(shifted, s, 1.0)))
    largest, others = (np.sort(np.abs(v))[::-1][:4] for v in (poles, wanted))
    assert largest == pytest.approx(others, abs=1e-9)
    assert peak_sensitivity(lin, s, 1.0, late) == pytest.approx(peak_sensitivity(shifted, s, 1.0), rel=1e-9)


def test_a_dead_time_makes_rules_slower() -> None:
    quick = AllPole.of(first_order(2.0, 10.0))
    late = replace(quick, dead_time_s=3.0)
    assert imc_pid(late, 2.0) == imc_pid(quick, 5.0)
    assert simc_pid(late, 1.0, 2.0) == simc_pid(quick, 7.0, 2.0)
    with pytest.raises(LawError):
        imc_pid(replace(AllPole.of(second_order(1.0, 0.3, -0.1)), dead_time_s=1.0), 1.0)
