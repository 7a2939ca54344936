"""The local controller network: its figures in closed loop, its bumps, its wind-up, and how one knob tunes it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from henson_seborg_cstr_parts import local_models
from shipped import required

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.henson_seborg_cstr.plant import HensonSeborgCstr
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import LawError, ParamsError
from loopwright.pipeline.laws import LAWS
from loopwright.pipeline.laws.local.local_controllers import LocalControllers, StabilityTest
from loopwright.pipeline.laws.local.pid_networks import one_knob
from loopwright.pipeline.plants.steady import Linearization
from loopwright.pipeline.tuning.rules import PidSettings, sampled_loop
from loopwright.pipeline.tuning.stability import FrozenLoops, spectral_radius

CASE = CASES["henson_seborg_cstr"]
TESTS = ("up", "down", "jump")
# law, its numbers, IAE up, down, jump [mol/l min], largest overshoot up and down
FIGURES = [
    ("local_pid_network", "gains", (0.0365, 0.0392, 0.0613), (0.13, 0.28)),
    ("local_pid_network", "outputs", (0.0606, 0.0632, 0.0605), (0.60, 0.61)),
    ("local_pid_network", "velocity", (0.0749, 0.0408, 0.0823), (1.35, 0.27)),
    ("auto_pid_network", "gains", (0.0302, 0.0296, 0.0452), (0.18, 0.19)),
]


@pytest.fixture(scope="module")
def plant() -> HensonSeborgCstr:
    return HensonSeborgCstr()


def designed(name: str, **params) -> LocalControllers:
    cls, plant = LAWS[name], HensonSeborgCstr()
    law = cls.design(cls.Params(**required(name) | params), {"local_models": local_models(plant)}, plant.signals, plant)
    assert isinstance(law, LocalControllers)
    return law.eval()


@cache
def scores(name: str, blending: str) -> dict[str, dict[str, float]]:
    """The case's figures of up, down and jump, whose loops run side by side."""
    law, plant = designed(name, blending=blending), HensonSeborgCstr()
    tests = [CASE.scenarios()[t][0] for t in TESTS]
    n = max(t.samples for t in tests)
    sp = np.stack([np.append(t.sp[:, 0], np.full(n - t.samples, t.sp[-1, 0])) for t in tests], axis=1)
    x, mv = np.array([t.x0 for t in tests]).T, torch.tensor(np.array([t.mv0 for t in tests]))
    state, dv = torch.zeros(3, law.n_state, dtype=torch.float64), torch.empty(3, 0, dtype=torch.float64)
    advance, p = plant.transition.map(3), np.tile(plant.parameters()[:, None], (1, 3))
    pvs, mvs = np.empty((n, 3, 2)), np.empty((n, 3, 1))
    with torch.inference_mode():
        for k in range(n):
            pvs[k] = x.T
            mv, state, _ = law(torch.from_numpy(sp[k])[:, None], torch.from_numpy(pvs[k]), dv, mv, state)
            mvs[k] = mv.numpy()
            x = np.array(advance(x, mvs[k].T, np.empty((0, 3)), p))
    rows = zip(TESTS, tests, range(3), strict=True)
    return {name: CASE.score(t, pvs[: t.samples, i], mvs[: t.samples, i]) for name, t, i in rows}


@pytest.mark.parametrize(("name", "blending", "iae", "overshoot"), FIGURES)
def test_figures_in_closed_loop(name, blending, iae, overshoot):
    found = scores(name, blending)
    assert [found[t]["iae"] for t in TESTS] == pytest.approx(iae, rel=0.05)
    assert [found[t]["overshoot_max"] for t in TESTS[:2]] == pytest.approx(overshoot, abs=0.03)
    assert all(found[t]["last_error"] < 1e-6 for t in TESTS)


def test_small_overshoot_near_the_stability_limit():
    assert scores("local_pid_network", "gains")["up"]["overshoot_last"] <= 0.10


@pytest.mark.parametrize(("name", "radius"), [("local_pid_network", 0.9776), ("auto_pid_network", 0.9694)])
def test_frozen_loops_are_stable_over_the_range(plant, name, radius):
    law = designed(name)
    loops = FrozenLoops.of(plant, law, law.n_state, np.linspace(0.0146, 0.1357, 121)).matrices()
    assert spectral_radius(loops).max() == pytest.approx(radius, abs=1e-4)


def test_blended_outputs_are_unstable_between_points(plant):
    law = designed("local_pid_network", blending="outputs")
    loops = FrozenLoops.of(plant, law, law.n_state, np.array([0.0146305, 0.044])).matrices()
    radius = spectral_radius(loops)
    assert radius[0] < 1 < radius[1]


def test_analysis_tells_of_loops_starts_and_the_reactor_gone_out(plant):
    test = StabilityTest(between=3, starts=24, low=(0.005, 400.0), high=(0.2, 500.0), samples=600, watched=4)
    told = designed("auto_pid_network", stability=test).analysis(plant)
    assert told.figures["lyapunov_pairs"] == told.figures["neighbour_pairs"] == 4
    assert told.figures["frozen_radius"] <= told.figures["lyapunov_contraction"] < 0.98
    assert told.figures["recovered"] == told.figures["starts"] == 24
    assert told.figures["states_of_no_return"] == 1
    assert "(C, T) = 0.9448, 359.2" in told.notes[-1]
    assert told.arrays["start"].shape == (24, 2)
    assert told.arrays["courses"].shape == (4, 120, 2)


def test_analysis_names_the_pair_without_a_function(plant):
    told = designed("local_pid_network", stability=StabilityTest(between=3, starts=0)).analysis(plant)
    assert told.figures["lyapunov_pairs"] == 3
    assert "None was found from 0.08506 to 0.1298" in told.notes[0]
    assert "recovered" not in told.figures


def run(law: LocalControllers, sp: float, cvs: list[float], mv: float, applied: float | None = None) -> list[float]:
    """MVs over some measured values, from no past; ``applied`` is what the actuator really holds."""
    state, moves = torch.zeros(law.n_state, dtype=torch.float64), []
    held = torch.tensor([mv], dtype=torch.float64)
    with torch.no_grad():
        for cv in cvs:
            at = torch.tensor([cv, 450.0], dtype=torch.float64)
            held, state, _ = law(torch.tensor([sp], dtype=torch.float64), at, at[:0], held, state)
            moves.append(float(held))
            if applied is not None:
                held = torch.tensor([applied], dtype=torch.float64)
    return moves


def test_moving_along_the_range_without_error_does_not_bump_blended_gains():
    """At e = 0 nothing but the derivative may act; with blended outputs the biases and the integral's weight do."""
    law = designed("local_pid_network", td_s=(0.0,) * 5)
    state, mv = torch.zeros(law.n_state, dtype=torch.float64), torch.tensor([80.0], dtype=torch.float64)
    for cv in np.linspace(0.02, 0.13, 30):
        at = torch.tensor([cv, 450.0], dtype=torch.float64)
        mv, state, _ = law(at[:1], at, at[:0], mv, state)
    assert float(mv) == pytest.approx(80.0, abs=1e-12)


def test_integral_does_not_wind_up():
    law = designed("local_pid_network")
    far, back = [0.03] * 200, [0.1] * 3
    assert run(law, 0.09, far, 100.0)[-1] == 150.0  # asks for all it can have, for 4 minutes
    after = run(law, 0.09, far + back, 100.0)[-3:]
    assert min(after) < 150.0


def test_an_actuator_that_someone_holds_is_taken_over_without_a_bump():
    law = designed("auto_pid_network")
    moves = run(law, 0.06, [0.055] * 50, 90.0, applied=90.0)
    one = run(law, 0.06, [0.055], 90.0)[0]
    assert moves[-1] == pytest.approx(one, abs=1e-9)  # one step of the integral, however long it was held


def second_order(a1: float, a0: float, b: float) -> Linearization:
    """b/(s^2 + a1 s + a0) per second."""
    a = np.array([[0.0, 1.0], [-a0, -a1]])
    return Linearization(np.zeros(2), np.zeros(1), a, np.array([[0.0], [b]]), np.array([[1.0, 0.0]]))


def test_one_knob_places_the_three_poles():
    a1, a0, b, wc = 0.5, 6.9, 0.04, 5.0
    pid = one_knob(second_order(a1, a0, b), wc)
    placed = np.polyadd([1, a1, a0, 0], b * np.array([pid.kd, pid.kp, pid.ki]))
    assert placed == pytest.approx([1, 2.6 * wc, 2.6 * wc**2, wc**3])


@pytest.mark.parametrize("wc", [5.0, 8.0])
def test_one_knob_cancels_the_slow_pole_of_a_damped_model(wc):
    a1, a0, b = 26.65, 48.3, 0.0516
    pid = one_knob(second_order(a1, a0, b), wc)
    p1 = (a1 - np.sqrt(a1**2 - 4 * a0)) / 2
    p2 = a1 - p1
    assert pid.kd == 0.0
    assert pid.ki / pid.kp == pytest.approx(p1)
    # What is left, s (s + p2) + b Kp, is damped by 0.8 or more, and as fast as asked for where it may be.
    assert p2 / (2 * np.sqrt(b * pid.kp)) >= 0.8 - 1e-12
    assert b * pid.kp == pytest.approx(min(wc * (p2 - wc), p2**2 / 2.56))


def test_one_knob_equals_the_reference_settings(plant):
    found = [one_knob(lin, 5.0 / 60.0) for lin in _scalar(plant)]
    assert [p.kp for p in found] == pytest.approx([1529, 1191, 909, 1908, 4907], rel=2e-3)
    assert [p.kd > 0 for p in found] == [True, True, True, False, False]


def _scalar(plant) -> list[Linearization]:
    rows = local_models(plant).linearizations()
    return [Linearization(r.x, r.mv, r.a, r.b, r.c[:1]) for r in rows]


@pytest.mark.parametrize(
    ("model", "wc", "words"),
    [
        (second_order(0.5, 6.9, 0.04), 1.0, "take more than 1.629"),
        (second_order(0.5, 6.9, -0.04), 5.0, "b > 0"),
        (second_order(2.0, 6.9, 0.04), 0.1, "too slow"),
    ],
)
def test_a_knob_that_cannot_be_is_an_error(model, wc, words):
    with pytest.raises(LawError, match=words):
        one_knob(model, wc)


@pytest.mark.parametrize(
    ("name", "params", "words"),
    [
        ("local_pid_network", {"kc": (1.0,), "ti_s": (1.0,), "td_s": (0.0,)}, "1 local controllers for 5"),
        ("local_pid_network", {"blending": "both"}, "allowed are gains"),
        ("auto_pid_network", {"stability": StabilityTest(low=(0.1,), high=(0.2,))}, "have 1 numbers.* has 2 states"),
    ],
)
def test_senseless_settings_are_errors(name, params, words):
    with pytest.raises(LawError, match=words):
        designed(name, **params)


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("local_pid_network", {"kc": [1.0]}, "1 kc, 5 ti_s and 5 td_s"),
        ("local_pid_network", {"kc": [1.0, 2.0, 0.0, 4.0, 5.0]}, "kc is .* none may be 0"),
        ("local_pid_network", {"ti_s": [1.0, 2.0, 0.0, 4.0, 5.0]}, "ti_s is .* above 0 s"),
        ("local_pid_network", {"td_s": [1.0, 2.0, -3.0, 4.0, 5.0]}, "td_s is .* 0 s or above"),
        ("local_pid_network", {"derivative_limit": 0.0}, "derivative_limit is 0.0"),
        ("auto_pid_network", {"derivative_limit": -1.0}, "derivative_limit is -1.0"),
        ("auto_pid_network", {"wc": -1.0}, "wc is -1"),
        ("auto_pid_network", {"stability": {"low": [0.005], "high": [0.2, 500.0]}}, "low is .*0.005.* for every state"),
        ("auto_pid_network", {"stability": {"low": [0.3, 400.0], "high": [0.2, 500.0]}}, "each low below its high"),
        ("auto_pid_network", {"stability": {"between": 1}}, "between is 1; it must be at least 2"),
        ("auto_pid_network", {"stability": {"starts": -1}}, "starts is -1"),
        ("auto_pid_network", {"stability": {"band": 0.0}}, "band is 0.0"),
    ],
)
def test_numbers_that_make_no_sense_are_refused_where_they_stand(name, values, words):
    with pytest.raises(ParamsError, match=f"here.*: .*{words}"):
        parse(LAWS[name].Params, required(name) | values, "here")


def test_blended_gains_lose_stability_where_plain_pids_with_those_gains_do(plant):
    """The gain margin anew, from a PID's own difference equations: nothing of the network's module or its slopes."""
    at = np.linspace(0.0146, 0.1298, 41)
    for name, found in (("local_pid_network", 3.595), ("auto_pid_network", 6.079)):
        law = designed(name)
        margin = FrozenLoops.of(plant, law, law.n_state, at).gain_margin()
        assert margin == pytest.approx(found, rel=5e-3)
        blended = (law.validity(torch.from_numpy(at)[:, None]) @ law.table).numpy()

        def radius(gain: float, rows: np.ndarray = blended) -> float:
            loops = []
            for cv, (kp, ki, kd, keep, _) in zip(at, rows, strict=True):
                lin = plant.linearize(*plant.steady_state_at(float(cv)))
                one = Linearization(lin.x, lin.mv, lin.a, gain * lin.b, lin.c[:1])
                h = plant.period_s
                filter_s = h * keep / (1 - keep)
                loops.append(sampled_loop(one, PidSettings(kp, kp / ki * h, kd / kp * h, filter_s=filter_s), h))
            return float(spectral_radius(np.array(loops)).max())

        assert radius(0.99 * margin) < 1 < radius(1.01 * margin)
