"""Step responses by simulation, pairings, and the PID numbers that are searched in closed loop."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from identified_models import made_signals

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.tuning.calm_choice import CALM_COST
from loopwright.pipeline.tuning.loop_search import CALM_GAIN, MOVE_COST, DevelopmentLoops, calm, searched, simc
from loopwright.pipeline.tuning.pairing import pairings, relative_gains
from loopwright.pipeline.tuning.responses import FirstOrder, StepResponses
from loopwright.pipeline.tuning.rules import PidSettings


class Sampled(Simulator):
    """x+ = A x + B u, y = C x: any linear plant, with noise-free measurements."""

    name, title, period_s = "sampled", "Sampled", 2.0

    def __init__(self, a: Array, b: Array, c: Array) -> None:
        self.a, self.b, self.c = (np.asarray(m, dtype=np.float64) for m in (a, b, c))
        signals = made_signals(len(self.c), self.b.shape[1])
        vars(self).update(pv_signals=signals.pv, sp_signals=signals.sp, mv_signals=signals.mv)

    @property
    def start(self) -> tuple[Array, Array]:
        return np.zeros(len(self.a)), np.zeros(self.b.shape[1])

    def step(self, x: Array, mv: Array, dv: Array, p: Array) -> Array:
        return self.a @ x + self.b @ mv

    def measure(self, x: Array) -> Array:
        return self.c @ x

    def many(self, n: int, p: Array | None = None):
        return lambda x, mv: x @ self.a.T + mv @ self.b.T

    def measured(self, x: Array) -> Array:
        return x @ self.c.T


def lag(pole: float, gain: float, dead: int = 0) -> Sampled:
    n = 1 + dead
    a, b = np.zeros((n, n)), np.zeros((n, 1))
    a[0, 0] = pole
    if dead:
        a[0, 1], b[-1, 0] = (1 - pole) * gain, 1.0
        a[1:-1, 2:] = np.eye(dead - 1)
    else:
        b[0, 0] = (1 - pole) * gain
    return Sampled(a, b, np.eye(1, n))


def tank() -> Sampled:
    """A level that the valve fills through a lag of 4 samples."""
    return Sampled([[1.0, 0.05], [0.0, 0.75]], [[0.0], [0.25]], [[1.0, 0.0]])


def coupled(interaction: float) -> Sampled:
    """Two lags, each MV also at the other one's input."""
    return Sampled(np.diag([0.9, 0.8]), [[0.1, 0.1 * interaction], [0.2 * interaction, 0.2]], np.eye(2))


def two_ways() -> Sampled:
    """Gains 1.22 of each MV on its own CV, slowly, and 1 and -1 on the other one, quickly."""
    slow, fast = 0.97, 0.5
    b = np.vstack([(1 - slow) * np.eye(2), (1 - fast) * np.eye(2)])
    own = np.sqrt(1.5)
    return Sampled(np.diag([slow, slow, fast, fast]), b, [[own, 0.0, 0.0, 1.0], [0.0, own, -1.0, 0.0]])


@given(st.floats(0.6, 0.97), st.sampled_from([-3.0, 0.5]), st.integers(0, 8))
def test_a_lag_with_dead_time_is_found(pole: float, gain: float, dead: int) -> None:
    found = StepResponses.near_start(lag(pole, gain, dead))
    assert found.gain[0, 0] == pytest.approx(gain, rel=0.02)
    assert found.answers_after(0, 0) == dead + 1
    assert not found.starts_inverse(0, 0)
    process, tau = found.process(0, 0), -2.0 / np.log(pole)
    assert process.tau_s == pytest.approx(tau, rel=0.15)
    assert process.dead_time_s == pytest.approx(2.0 * dead, abs=0.15 * tau)
    assert found.settling == pytest.approx(dead + np.log(0.05) / np.log(pole) + 1, rel=0.05, abs=2)


@pytest.mark.parametrize("beyond", [-3.0, 3.0])
def test_a_plant_that_rests_where_no_mv_gets_is_moved_at_the_nearest(
    beyond: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model of a 2x2 whose record left a pole at 1 rested at 106 %, and both ends of its difference were 100 %."""
    plant = lag(0.9, 0.5, 2)
    monkeypatch.setattr(Sampled, "start", property(lambda self: (np.zeros(3), np.array([beyond]))))
    found = StepResponses.near_start(plant)
    assert found.gain[0, 0] == pytest.approx(0.5, rel=0.02)
    assert found.answers_after(0, 0) == 3


def test_an_integrator_is_a_ramp_with_dead_time() -> None:
    found = StepResponses.near_start(tank())
    assert found.integrates.all()
    process = found.process(0, 0)
    assert (process.rate, process.tau_s) == (pytest.approx(0.05 / 2.0, rel=1e-3), inf)
    assert process.dead_time_s == pytest.approx(2.0 * 4, rel=0.05)  # the lag, as the ramp sees it


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_response_that_creeps_on_is_the_lag_that_it_mostly_is(share: float) -> None:
    """A pole near 1 with a small part was once taken for a ramp: 1/rate, and with it the first gain, was any size."""
    slow, fast = 0.9995, 0.95
    plant = Sampled(np.diag([fast, slow]), [[1 - fast], [1 - slow]], [[1.0, share]])
    found = StepResponses.near_start(plant)
    assert not found.integrates.any()
    process = found.process(0, 0)
    assert process.tau_s == pytest.approx(-2.0 / np.log(fast), rel=0.6)
    assert process.rate * process.tau_s == pytest.approx(1.0, rel=0.4)
    assert found.settling < 1000


def test_an_answer_counts_as_far_as_it_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a record with loads the first rows of an answer are sure; a slow pole turned the sign of its end."""
    plant = Sampled(np.diag([0.95, 0.998]), [[0.05], [0.002]], [[1.0, -1.5]])
    assert StepResponses.near_start(plant).gain[0, 0] == pytest.approx(-0.5, rel=0.05)
    monkeypatch.setattr(Sampled, "foreseen", property(lambda self: 60))
    found = StepResponses.near_start(plant)
    assert found.y.shape[-1] == 60
    assert found.gain[0, 0] == pytest.approx(1 - 0.95**60 - 1.5 * (1 - 0.998**60), rel=0.01)


def test_a_weak_answer_that_goes_on_makes_no_integrator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a 3x3 each controlled variable crept on under one weak MV: by these rates alone no loops were independent."""
    monkeypatch.setattr(Sampled, "foreseen", property(lambda self: 60))
    fast, slow = np.array([0.9, 0.9]), np.array([0.9995, 0.9995])
    drive = [[0.1, 0.0], [0.0, 0.1], [0.0, 0.0005], [0.0005, 0.0]]
    found = StepResponses.near_start(Sampled(np.diag([*fast, *slow]), drive, np.hstack([np.eye(2), 3 * np.eye(2)])))
    assert not found.integrates.any()
    assert found.gain == pytest.approx(np.array([[1.0, 0.09], [0.09, 1.0]]), abs=0.01)
    assert [pairs for pairs, _ in pairings(found.gain)] == [((0, 0), (1, 1))]


def test_an_integrator_is_crossed_by_its_strongest_mv() -> None:
    found = StepResponses.near_start(tank())
    width = found.spans[1] * 0.05 * 10
    assert found.crossing(width) == pytest.approx(10, abs=1)
    assert StepResponses.near_start(lag(0.9, 0.5, 2)).crossing(np.ones(1)) == 0


def test_an_inverse_response_is_seen() -> None:
    plant = Sampled(np.diag([0.9, 0.5]), [[0.3], [0.5]], [[1.0, -1.0]])
    assert StepResponses.near_start(plant).starts_inverse(0, 0)


@given(st.integers(0, 10_000))
def test_relative_gains_sum_to_one_and_know_no_units(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gain = rng.normal(size=(3, 3)) + 2 * np.eye(3)
    if np.linalg.cond(gain) > 1e3:
        return
    table = relative_gains(gain)
    np.testing.assert_allclose(table.sum(axis=0), 1, atol=1e-8)
    np.testing.assert_allclose(table.sum(axis=1), 1, atol=1e-8)
    scaled = np.diag(rng.uniform(0.1, 10, 3)) @ gain @ np.diag(rng.uniform(0.1, 10, 3))
    np.testing.assert_allclose(relative_gains(scaled), table, atol=1e-6)


def test_the_distillation_column_of_the_textbook() -> None:
    """Wood and Berry's column: relative gain 2.01 of the diagonal pairs, so they are the ones."""
    (pairs, table), *others = pairings(np.array([[12.8, -18.9], [6.6, -19.4]]))
    assert pairs == ((0, 0), (1, 1))
    assert table[0, 0] == pytest.approx(2.01, abs=0.005)
    assert others == []  # the other pairs' relative gains are negative


def test_spare_mvs_and_plants_that_single_loops_do_not_hold() -> None:
    (pairs, _), *_ = pairings(np.array([[0.1, 2.0, 0.0], [0.0, 0.1, -1.5]]))
    assert pairs == ((0, 1), (1, 2))
    with pytest.raises(LawError, match="singular"):
        pairings(np.array([[1.0, 2.0], [2.0, 4.0]]))
    with pytest.raises(LawError, match="need as many MVs; there are 1"):
        pairings(np.ones((2, 1)))


def test_simc_takes_an_integrators_limit() -> None:
    """A very slow lag and the integrator with its initial slope have the same PI."""
    slow, ramp = simc(FirstOrder(0.3, 1e9, 4.0), 1.0, 4.0), simc(FirstOrder(0.3, inf, 4.0), 1.0, 4.0)
    assert (slow.kc, slow.ti_s) == pytest.approx((ramp.kc, ramp.ti_s))


def test_the_search_finds_the_cheapest_numbers_of_each_loop() -> None:
    wanted = (PidSettings(0.8, 12.0, 1.5), PidSettings(-3.0, 30.0))

    def cost(rows) -> Array:
        return np.array(
            [
                sum(abs(np.log(s.kc / w.kc)) + abs(np.log(s.ti_s / w.ti_s)) for s, w in zip(row, wanted, strict=True))
                for row in rows
            ]
        )

    found = searched((FirstOrder(0.1, 20.0, 3.0), FirstOrder(-0.02, 60.0, 5.0)), 1.0, cost, PidSettings(1.0, 1.0), 1.0)[
        1
    ]
    for s, w in zip(found, wanted, strict=True):
        assert (s.kc, s.ti_s) == (pytest.approx(w.kc, rel=0.2), pytest.approx(w.ti_s, rel=0.4))
    with pytest.raises(LawError, match="no PID gave a finite closed loop"):
        searched((FirstOrder(0.1, 20.0, 3.0),), 1.0, lambda rows: np.full(len(rows), inf), PidSettings(1.0, 1.0), None)


@pytest.mark.parametrize("plant", [lag(0.9, 2.0, 4), tank(), coupled(0.6)], ids=["dead time", "integrator", "2x2"])
def test_the_pid_of_any_plant_holds_set_points_and_loads(plant: Simulator) -> None:
    quick = {"development_seeds": (1,), "development_set_points": 3, "development_hold": 60}
    law = PID.design(PID.Params(**quick), {}, plant.signals, plant).eval()
    loops = DevelopmentLoops.by_simulation(plant, (11,), 3, 150)
    x, mv, state = loops.x0.copy(), torch.from_numpy(loops.mv0), torch.zeros(2, law.n_state, dtype=torch.float64)
    errors = []
    for k in range(len(loops.sp)):
        y = plant.measured(x)
        errors.append(np.abs(loops.sp[k] - y))
        with torch.no_grad():
            mv, state, _ = law(torch.from_numpy(loops.sp[k]), torch.from_numpy(y), torch.zeros(2, 0), mv, state)
        x = plant.many(2)(x, mv.numpy() + loops.load[k])
    at_ends = np.array(errors).reshape(3, 150, *np.shape(errors)[1:])[:, -1]
    assert at_ends.max() < 0.06  # 1 % of the range
    assert bool(law.pairings) == (len(plant.sp_signals) == 2)


def test_several_loops_are_single_loops_side_by_side() -> None:
    """Of two pairs and a spare MV: each loop as the single PID of its numbers, the spare MV where it is."""
    signals, single = made_signals(2, 3), made_signals(1, 1)
    settings = (PidSettings(0.5, 6.0, 1.0, 0.5, 0.7), PidSettings(-0.3, 9.0, tracking_s=4.0))
    law, alone = PID(signals, settings, pairs=((1, 0), (0, 2))), [PID(single, s) for s in settings]
    rng = np.random.default_rng(5)
    state, states = torch.zeros(1, law.n_state).double(), [torch.zeros(1, a.n_state).double() for a in alone]
    for _ in range(30):
        sp, pv, mv = (torch.from_numpy(rng.uniform(-1, 1, (1, n))) for n in (2, 2, 3))
        asked, state, info = law(sp, pv, torch.zeros(1, 0), mv, state)
        for i, (cv, at) in enumerate(((1, 0), (0, 2))):
            own, states[i], _ = alone[i](sp[:, [cv]], pv[:, [cv]], torch.zeros(1, 0), mv[:, [at]], states[i])
            assert asked[0, at] == own[0, 0]
        assert asked[0, 1] == mv[0, 1]
    assert law.info == ("u0_requested", "u2_requested")
    assert info.shape == (1, 2)


def test_the_analysis_names_the_pairs_and_their_relative_gains() -> None:
    plant = coupled(0.5)
    quick = {"development_seeds": (1,), "development_set_points": 2, "development_hold": 30}
    analysis = PID.design(PID.Params(**quick), {}, plant.signals, plant).analysis(plant)
    assert analysis.figures["relative_gain_y0"] == pytest.approx(1 / (1 - 0.25), rel=0.02)
    settings, (_, pairs, why) = analysis.notes[:2], analysis.notes[2:]
    assert [note.split(":")[0] for note in settings] == ["u0 by y0", "u1 by y1"]
    assert "y0 by u0 (1.33)" in pairs
    assert "This is the only one" in why  # the others' relative gains are -0.33


@pytest.mark.parametrize("plant", [lag(0.9, 2.0, 4), coupled(0.5)], ids=["one loop", "two loops"])
def test_the_calmest_of_all_settings_that_the_search_tried_are_taken(plant: Simulator) -> None:
    quick = {"development_seeds": (5,), "development_set_points": 2, "development_hold": 30}
    law = PID.design(PID.Params(**quick), {}, plant.signals, plant)
    analysis = law.analysis(plant)
    assert len(analysis.table) > 50
    assert np.isfinite([list(row.values()) for row in analysis.table]).all()
    (taken,) = [row for row in analysis.table if row["taken"]]
    assert analysis.figures.items() & taken.items() >= {(n, v) for n, v in analysis.figures.items() if "gain" not in n}
    costs = [row["cost"] for row in analysis.table]
    assert costs == sorted(costs)
    cheapest = analysis.table[0]
    assert (cheapest["set_points"], cheapest["loads"], cheapest["error"]) == (1.0, 1.0, 1.0)
    within = (1 + CALM_COST) * min(row["error"] for row in analysis.table)
    assert max(taken["set_points"], taken["loads"]) == taken["error"] <= within
    assert taken["travel"] == min(row["travel"] for row in analysis.table if row["error"] <= within)
    assert 0 < taken["travel"] < cheapest["travel"]


def test_travel_is_the_moves_in_shares_of_the_range_and_noise_alone_has_a_price(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A law that steps its MV by a tenth of the range in each sample, up and down."""
    plant = lag(0.9, 2.0)
    loops = DevelopmentLoops.by_simulation(plant, (3,), 2, 10)

    def swing(sp, pv, dv, mv_applied, state):
        return torch.where(mv_applied > 0, mv_applied - 0.2, mv_applied + 0.2), state, mv_applied

    quiet = loops.run(swing, 0)
    np.testing.assert_allclose(quiet.travel, 10.0)  # % of -1..1
    np.testing.assert_allclose(quiet.cost, quiet.error.mean(axis=1))
    assert quiet.error.shape == quiet.travel.shape == (1, 2)
    monkeypatch.setattr(Sampled, "noise_std", np.array([0.1]))
    noisy = loops.run(swing, 0)
    span = plant.sp_signals[0].high - plant.sp_signals[0].low
    np.testing.assert_allclose(noisy.cost, noisy.error.mean(axis=1) + MOVE_COST * span * 0.1)


def test_pairs_that_are_given_are_tuned_and_no_others() -> None:
    """Without them the other pairing is taken, see below."""
    plant = two_ways()
    quick = {"development_seeds": (1,), "development_set_points": 2, "development_hold": 60}
    law = PID.design(PID.Params(pairs={"u1": "y1", "u0": "y0"}, **quick), {}, plant.signals, plant)
    assert law.pairs == ((0, 0), (1, 1))
    assert [one.pairs for one in law.pairings] == [law.pairs]
    assert "they were given" in law.analysis(plant).notes[-1]


def test_numbers_of_several_loops_are_those_of_their_pairs() -> None:
    plant = two_ways()
    own = {"pairs": {"u1": "y0", "u0": "y1"}, "kc": (2.0, -3.0), "ti_s": (20.0, 30.0), "td_s": 1.0}
    params = PID.Params(tuning="manual", **own)  # type: ignore[arg-type]
    PID.check_settings(params, plant.signals)
    law = PID.design(params, {}, plant.signals, plant)
    assert law.pairs == ((1, 0), (0, 1))
    assert [(s.kc, s.ti_s, s.td_s) for s in law.loops] == [(-3.0, 30.0, 1.0), (2.0, 20.0, 1.0)]
    with pytest.raises(LawError, match="kc of the PID has 2 entries"):
        PID.Params(tuning="manual", kc=(1.0, 2.0), ti_s=3.0)
    with pytest.raises(LawError, match="kc of the PID has 2 entries"):
        PID.Params(pairs={"u0": "y0", "u1": "y1"}, kc=(1.0, 2.0))


@pytest.mark.parametrize("pairs", [{"u0": "y0"}, {"u0": "y0", "u9": "y1"}, {"u0": "y0", "u1": "y0"}])
def test_pairs_that_leave_a_variable_without_an_mv_are_refused(pairs: dict[str, str]) -> None:
    with pytest.raises(LawError, match="pairs of the PID are"):
        PID.check_settings(PID.Params(pairs=pairs), two_ways().signals)


def test_the_analysis_says_why_the_pairs_were_taken() -> None:
    """Both pairings have positive relative gains, .6 and .4; that of the smaller error in closed loop is taken."""
    plant = two_ways()
    quick = {"development_seeds": (1,), "development_set_points": 2, "development_hold": 60}
    law = PID.design(PID.Params(**quick), {}, plant.signals, plant)
    chosen, other = law.pairings
    assert law.pairs == chosen.pairs == ((1, 0), (0, 1))
    assert chosen.relative_gains == pytest.approx((0.4, 0.4), abs=0.01)
    assert other.relative_gains == pytest.approx((0.6, 0.6), abs=0.01)
    assert chosen.error < other.error
    note = law.analysis(plant).notes[-1]
    assert f"{chosen.error:.3g} % for this pairing, {other.error:.3g} % for y0 by u0 (0.60), y1 by u1 (0.60)" in note


def test_one_loop_of_several_is_refused() -> None:
    with pytest.raises(LawError, match="controls one variable by one"):
        PID(made_signals(2, 2), PidSettings(1.0, 1.0))


def test_loads_act_with_the_mvs_alone() -> None:
    """A law that never moves: the set-point sequence stays where it is, the load's sequence does not."""
    loops = DevelopmentLoops.by_simulation(lag(0.9, 2.0), (3,), 4, 50)
    assert np.ptp(loops.sp[:, 1]) == 0
    assert not loops.load[:, 0].any()
    assert set(np.unique(loops.load[:, 1])) <= {-0.16, 0.0, 0.16}
    assert np.all(np.abs(loops.sp[:, 0]) <= 3.0)


@given(st.sampled_from([1.0, -1.0]), st.floats(0.0, 40.0), st.floats(4.0, 400.0) | st.just(inf), st.floats(0.1, 8.0))
def test_a_calm_pi_holds_a_plant_of_twice_the_gain_and_twice_the_dead_time(
    sign: float, dead_s: float, tau_s: float, boldness: float
) -> None:
    h, rate = 2.0, 0.03 * sign
    process = FirstOrder(rate, tau_s, dead_s)
    bold = simc(process, h, (dead_s + h) / boldness)
    (found,) = calm([process], h, (bold,))
    assert abs(found.kc) <= CALM_GAIN * abs(bold.kc) * (1 + 1e-12)
    assert found.kc * bold.kc > 0
    assert found.ti_s >= bold.ti_s
    assert (found.td_s, found.filter_s, found.set_point_weight) == (0.0, 0.0, bold.set_point_weight)
    pole = 1.0 if tau_s == inf else float(np.exp(-h / tau_s))
    gain, late = 2 * rate * (h if tau_s == inf else tau_s * (1 - pole)), round(2 * dead_s / h)
    y, u, past, before = 1.0, 0.0, [0.0] * (late + 1), 1.0
    sizes = []
    for _ in range(int(40 * (dead_s + h + found.ti_s) / h)):
        u += found.kc * (before - y - h / found.ti_s * y)
        before, past = y, [u, *past[:late]]
        y = pole * y + gain * past[late]
        sizes.append(abs(y))
    assert max(sizes[-len(sizes) // 4 :]) < 0.05 * max(sizes)
