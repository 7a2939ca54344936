"""The PID against its equation, its linear loop, and the plant."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from law_loops import DV, stepper
from made_up_plant import Chain, Lag

from loopwright.pipeline.cases.batch_reactor.plant import BatchReactor
from loopwright.pipeline.cases.ph_neutralization.case import PhNeutralizationCase
from loopwright.pipeline.cases.ph_neutralization.plant import PhNeutralization
from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.models import Model
from loopwright.pipeline.models.local_models import LinearizedPlant as LinearizedModel
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.simulator import Signals
from loopwright.pipeline.simulation.simulate import simulate_closed
from loopwright.pipeline.tuning.rules import AllPole, PidSettings, imc_pid, sampled_loop


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@given(st.integers(0, 1000), st.floats(0.0, 2.0), st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_equals_the_textbooks_position_form(signals: Signals, seed: int, filter_s: float, weight: float) -> None:
    """Within its limits the velocity form is the position form with the sum of all errors."""
    rng = np.random.default_rng(seed)
    s = PidSettings(-5.0, 3.0, 0.8, filter_s, weight)
    law, h = PID(signals, s), signals.period_s
    r, y = rng.uniform(0.3, 0.7, 30), rng.uniform(0.3, 0.7, 30)
    state, mv = torch.zeros(law.n_state, dtype=torch.float64), tensor(250.0)
    total, d, offset = 0.0, 0.0, 250.0 - s.kc * (weight * r[0] - y[0])
    for k in range(30):
        total += h / s.ti_s * (r[k] - y[k])
        if k:
            d = (filter_s * d + s.td_s * (y[k] - y[k - 1])) / (filter_s + h)
        mv, state, _ = law(tensor(r[k]), tensor(y[k], 300.0), DV, mv, state)
        assert mv.item() == pytest.approx(offset + s.kc * (weight * r[k] - y[k] + total - d), rel=1e-11)


def test_small_signals_follow_the_sampled_loop(plant: EquationPlant, signals: Signals) -> None:
    """Near the unstable point the true loop is the linear one whose eigenvalues the tuning relies on."""
    x, mv = plant.steady_state_at(0.66613)
    lin = plant.linearize(x, mv)
    s = imc_pid(AllPole.of(lin), 1.6)
    law, advance = PID(signals, s), plant.stepper()
    matrix = sampled_loop(lin, s, plant.period_s)
    size = np.array([1e-6, 1e-5])
    state, now, applied = torch.zeros(law.n_state, dtype=torch.float64), x + size, torch.from_numpy(mv)
    # The law's first step takes no derivative and no past error: what the matrix has as y and d of before.
    z = np.concatenate([size, [0.0, size[0], 0.0]])
    for _ in range(12):
        applied, state, _ = law(torch.from_numpy(x[:1]), torch.from_numpy(now), DV, applied, state)
        now = advance(now, applied.numpy(), np.zeros(0), plant.parameters())
        z = matrix @ z
        np.testing.assert_allclose(now - x, z[:2], rtol=1e-3, atol=1e-9)


def test_an_actuator_that_stays_behind_leaves_no_wind_up(signals: Signals) -> None:
    """Long at its limit with the error unchanged, the MV leaves the limit soon after the error turns."""
    law = PID(signals, PidSettings(-200.0, 2.0, 0.0, tracking_s=1.0))
    state, mv = torch.zeros(law.n_state, dtype=torch.float64), tensor(250.0)
    for _ in range(2000):
        mv, state, _ = law(tensor(0.2), tensor(0.5, 300.0), DV, mv, state)
    assert mv.item() == 500
    for _ in range(8):
        mv, state, _ = law(tensor(0.5), tensor(0.3, 300.0), DV, mv, state)
    assert mv.item() < 490


def test_a_moved_actuator_is_believed(signals: Signals) -> None:
    """Saturated, then put elsewhere by an operator: the next request starts from there."""
    law = PID(signals, PidSettings(-200.0, 2.0, 0.0))
    state, mv = torch.zeros(law.n_state, dtype=torch.float64), tensor(250.0)
    for _ in range(50):
        mv, state, _ = law(tensor(0.2), tensor(0.5, 300.0), DV, mv, state)
    moved, _, _ = law(tensor(0.2), tensor(0.2, 300.0), DV, tensor(100.0), state)
    first_move = -200.0 * (0.5 - 0.2)  # the proportional part of the output's own step
    assert moved.item() == pytest.approx(100.0 + first_move, abs=1e-9)


def test_set_point_weight_zero_gives_no_kick(signals: Signals) -> None:
    law = PID(signals, PidSettings(-1000.0, 5.0, 1.0, set_point_weight=0.0))
    rest = (tensor(0.5, 300.0), DV)
    mv, state, _ = law(tensor(0.5), *rest, tensor(250.0), torch.zeros(law.n_state, dtype=torch.float64))
    kicked, _, _ = law(tensor(0.4), *rest, mv, state)
    assert kicked.item() - mv.item() == pytest.approx(-1000.0 * 0.5 / 5.0 * (0.4 - 0.5))


class Linearized(Model):
    kind = "linearized"

    def __init__(self, lin) -> None:
        super().__init__()
        self._lin = lin

    def config(self):
        return {}

    def forward(self, x):
        return x

    def linearization(self):
        return self._lin


def test_part_linearized_comes_before_the_plant(plant: EquationPlant, signals: Signals, parts) -> None:
    middle = plant.linearize(*plant.steady_state_at(0.66613))
    params = PID.Params(tuning="imc", lambda_s=1.5, operating_cv=0.2)
    law = PID.design(params, {"linearized": Linearized(middle)}, signals, plant)
    assert law.settings == imc_pid(AllPole.of(middle), 1.5)
    assert PID.design(params, {}, signals, plant).settings != law.settings
    with pytest.raises(LawError, match="part 'linearized'"):
        PID.design(params, {"linearized": parts["inverse"]}, signals, plant)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (PID.Params(tuning="manual", kc=1.0), "needs kc and ti_s"),
        (PID.Params(tuning="magic"), "allowed are optimized, imc, simc, itae, manual"),  # type: ignore[arg-type]
    ],
)
def test_wrong_params_are_named(plant: EquationPlant, signals: Signals, params: PID.Params, message: str) -> None:
    with pytest.raises(LawError, match=message):
        PID.design(params, {}, signals, plant)


@pytest.mark.parametrize("tuning", ["manual", "optimized"])
@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name in ("kc", "ti_s", "tracking_s") for value in (0.0, float("nan"))]
    + [(name, value) for name in ("td_s", "filter_s", "set_point_weight") for value in (-1.0, float("inf"))],
)
def test_numbers_that_make_no_pid_are_refused_in_words(tuning: str, name: str, value: float) -> None:
    with pytest.raises(LawError, match=rf"^{name} of the PID is {value}; it must be .*(finite|above 0 s)"):
        PID.Params(**{"tuning": tuning, "kc": -2.0, "ti_s": 5.0, name: value})


def test_a_plant_written_in_minutes_is_tuned_in_seconds() -> None:
    """gain u = tau dx/dt + x with tau = 3 min, measured in tenths: IMC of it is known, and so is a period of it."""
    lag = Lag()
    law = PID.design(PID.Params(tuning="imc", lambda_s=60.0, operating_cv=0.0), {}, lag.signals, lag)
    assert law.settings.ti_s == pytest.approx(180.0)
    assert law.settings.kc == pytest.approx(180.0 / (20.0 * 60.0))
    decay = np.exp(-30.0 / 180.0)
    part = LinearizedModel.at_set_point(lag, 0.0)
    np.testing.assert_allclose(part.one_period.numpy()[:, 0], [10 * decay, 20 * (1 - decay)], rtol=1e-12)


def sse(law: PID, plant: EquationPlant, test) -> float:
    track = simulate_closed(plant, stepper(law), test)
    return float(np.sum((track.pv[:, 0] - track.sp[:, 0]) ** 2))


def test_itae_on_the_ph_tank() -> None:
    """Tuned at pH 8: the reference figures, 8.29 and 0.368, with a whole period of dead time for the
    sampling, or better; with half of one the loop oscillates where the titration curve is steepest, as the paper's."""
    case = PhNeutralizationCase()
    tests = {name: case.scenarios()[name][0] for name in ("set_point", "disturbance")}

    def figures(sampling: float) -> dict[str, float]:
        params = PID.Params(tuning="itae", operating_cv=8.0, sampling=sampling)
        law = PID.design(params, {}, case.plant.signals, case.plant)
        return {name: sse(law, case.plant, test) for name, test in tests.items()}

    whole, half = figures(1.0), figures(0.5)
    assert whole["set_point"] == pytest.approx(8.29, rel=0.05)
    assert whole["disturbance"] < 0.368
    assert half["set_point"] > 3 * whole["set_point"]


@pytest.mark.parametrize("tuning", ["imc", "simc", "itae"])
@pytest.mark.parametrize(("plant_class", "at"), [(PhNeutralization, 7.5), (BatchReactor, 60.0)])
def test_rules_hold_plants_with_hidden_states(plant_class, at: float, tuning: str, loop_test) -> None:
    """Three states, of which the MV and the controlled variable see one: a small step settles."""
    plant = plant_class()
    law = PID.design(PID.Params(tuning=tuning, operating_cv=at, sampling=1.0), {}, plant.signals, plant)
    span = plant.sp_signals[0].high - plant.sp_signals[0].low
    levels = np.full(60, at + 0.02 * span)
    track = simulate_closed(plant, stepper(law), loop_test(plant, levels, at))
    assert abs(track.pv[-1, 0] - levels[-1]) < 1e-4 * span


def test_optimized_pid_holds_the_unstable_point(plant: EquationPlant, signals: Signals, loop_test) -> None:
    """Tuned on its own short sequences, it moves between all three branches and rejects what it does not measure."""
    params = PID.Params(operating_cv=0.66613, development_seeds=(5,), development_set_points=6, development_hold=50)
    law = PID.design(params, {}, signals, plant)
    assert 0.1 <= law.settings.set_point_weight <= 1.1
    levels = np.repeat([0.98717, 0.6661, 0.0755, 0.6661], 100)
    track = simulate_closed(plant, stepper(law), loop_test(plant, levels, 0.98717))
    for end in (200, 300, 400):
        assert abs(track.pv[end - 1, 0] - levels[end - 1]) < 2e-3
    disturbed = simulate_closed(plant, stepper(law), loop_test(plant, np.full(250, 0.66613), 0.66613, UA=10_000.0))
    assert np.abs(disturbed.pv[:, 0] - 0.66613).mean() < 0.004
    assert abs(disturbed.pv[-1, 0] - 0.66613) < 1e-4


@pytest.mark.parametrize("back", [0.0, 0.1])
@pytest.mark.parametrize("tuning", ["optimized", "itae"])
def test_plants_with_dead_time_and_zeros_are_tuned(tuning: str, back: float, loop_test) -> None:
    """Five lags in series, also with an inverse response: the default tuning settles a step, and so does `itae`."""
    plant = Chain(back=back)
    params = PID.Params(tuning=tuning, development_seeds=(3,), development_set_points=4, development_hold=50)
    law = PID.design(params, {}, plant.signals, plant)
    levels = np.full(120, 0.5)
    track = simulate_closed(plant, stepper(law), loop_test(plant, levels, 0.0))
    assert np.abs(track.pv[-20:, 0] - 0.5).max() < 0.005
    assert track.pv[:, 0].max() < 0.5 * 1.35
    assert np.abs(track.pv[50:, 0] - 0.5).max() < 0.1


@pytest.mark.parametrize("tuning", ["imc", "simc"])
def test_rules_that_do_not_hold_name_those_that_do(tuning: str) -> None:
    plant = Chain(back=0.1)
    with pytest.raises(LawError, match=r"no zero; .* choose tuning `optimized` or `itae`"):
        PID.design(PID.Params(tuning=tuning), {}, plant.signals, plant)


def test_the_settings_stand_in_words_as_another_pid_takes_them(signals: Signals) -> None:
    law = PID(signals, PidSettings(0.5, 40.0, 5.0, 0.5, 0.7))
    (note,) = law.analysis(None).notes
    cv, mv = signals.sp[0], signals.mv[0]
    assert note.startswith(
        f"{mv.name} by {cv.name}: Kc 0.5 {mv.unit}/({cv.unit}), Ti 40 s, Td 5 s with a filter of 0.5 s"
    )
    assert law.analysis(None).figures == {"kc": 0.5, "ti_s": 40.0, "td_s": 5.0}
    plain = PID(signals, PidSettings(0.5, math.inf)).analysis(None)
    assert "no integral part, no derivative" in plain.notes[0]
    assert plain.figures == {"kc": 0.5, "td_s": 0.0}
