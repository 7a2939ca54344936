"""Simulation: open loop, batches and closed loops tell the same story, by the same convention."""

import numpy as np
import pytest
from made_up_plant import Lag

from loopwright.pipeline.cases import PLANTS
from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.errors import PlantError
from loopwright.pipeline.simulation.scenario import Scenario
from loopwright.pipeline.simulation.simulate import simulate_batch, simulate_closed, simulate_open


@pytest.fixture(scope="module")
def cstr() -> ThiosulfateCstr:
    return ThiosulfateCstr()


@pytest.fixture(scope="module")
def middle(cstr) -> np.ndarray:
    return cstr.steady_states(250.0)[1]


def demand(cstr, n: int, **changes: np.ndarray) -> Scenario:
    return Scenario("made", "made", np.full((n, 1), 0.4), cstr.steady_states(250.0)[2], np.array([250.0]), changes)


def nothing(_sp, _pv, mv_applied):
    return mv_applied, ()


@pytest.mark.parametrize("name", PLANTS)
def test_open_loop_repeats_the_transition(name):
    plant = PLANTS[name]()
    _, xs, _ = plant.steady_curve
    rng = np.random.default_rng(0)
    mv = np.column_stack([rng.uniform(s.low, s.high, 20) for s in plant.mv_signals])
    x = simulate_open(plant, xs[100], mv)
    assert x.shape == (21, len(plant.state_signals))
    for k in range(20):
        after = np.array(plant.transition(x[k], mv[k], plant.dv_nominal, plant.parameters()))[:, 0]
        assert x[k + 1] == pytest.approx(after, rel=1e-13)


@pytest.mark.parametrize("name", PLANTS)
def test_batch_rows_are_open_loops(name):
    plant = PLANTS[name]()
    _, xs, _ = plant.steady_curve
    rng = np.random.default_rng(1)
    mv = np.stack([rng.uniform(s.low, s.high, (7, 4)) for s in plant.mv_signals], axis=-1)
    x0 = xs[rng.integers(len(xs), size=7)]
    batch = simulate_batch(plant, x0, mv)
    for row, start, moves in zip(batch, x0, mv, strict=True):
        assert row == pytest.approx(simulate_open(plant, start, moves), rel=1e-12)


def test_steady_state_stays(cstr):
    x0 = cstr.steady_states(250.0)[2]
    x = simulate_open(cstr, x0, np.full((50, 1), 250.0))
    assert np.abs(x - x0).max() < 1e-6


def test_changed_parameters_act_from_their_period_on(cstr, middle):
    mv = np.full((10, 1), 250.0)
    ua = np.where(np.arange(10) < 4, cstr.UA, 10_000.0)
    plain = simulate_open(cstr, middle, mv)
    changed = simulate_closed(cstr, nothing, Scenario("made", "made", mv, middle, mv[0], {"UA": ua})).x
    assert np.array_equal(plain[:5], changed[:5])
    assert not np.allclose(plain[5], changed[5], rtol=1e-6)
    weak = cstr.with_parameters({"UA": 10_000.0})
    assert np.allclose(changed[4:], simulate_open(weak, changed[4], mv[4:])[:-1], rtol=1e-13)


def test_closed_loop_convention(cstr):
    seen = []

    def step(sp, pv, mv_applied):
        k = len(seen)
        seen.append((sp.copy(), pv.copy(), mv_applied.copy()))
        return np.array([260.0 + k]), np.array([k, 2.0 * k])

    test = demand(cstr, 6)
    loop = simulate_closed(cstr, step, test)
    assert loop.time_s.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
    assert loop.mv[:, 0].tolist() == [260.0, 261.0, 262.0, 263.0, 264.0, 265.0]
    assert loop.info[:, 1].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    # The PV of a sample is measured before that sample's move acts.
    assert np.array_equal(loop.pv[0], test.x0)
    assert loop.x == pytest.approx(simulate_open(cstr, test.x0, loop.mv)[:-1], rel=1e-13)
    assert [m[0] for _, _, m in seen] == [250.0, *loop.mv[:-1, 0]]
    assert np.array_equal([pv for _, pv, _ in seen], loop.measured)
    assert np.array_equal([sp for sp, _, _ in seen], loop.sp)


def test_closed_loop_disturbance_is_a_plant_with_other_parameters(cstr):
    ua = np.linspace(20_000.0, 10_000.0, 30)
    loop = simulate_closed(cstr, nothing, demand(cstr, 30, UA=ua))
    for k in range(29):
        x = simulate_open(cstr.with_parameters({"UA": ua[k]}), loop.x[k], loop.mv[[k]])
        assert loop.x[k + 1] == pytest.approx(x[1], rel=1e-13)
    assert loop.info.shape == (30, 0)


def test_noise_is_seeded_and_not_in_the_true_pv(cstr):
    test = demand(cstr, 3000)
    a, b, other = (simulate_closed(cstr, nothing, test, noise=[5e-4, 0.1], seed=s) for s in (1, 1, 2))
    assert np.array_equal(a.measured, b.measured)
    assert not np.array_equal(a.measured, other.measured)
    assert np.array_equal(a.pv, simulate_closed(cstr, nothing, test).pv)
    # Standard deviation of 3,000 draws: 1.3 % of its own.
    assert (a.measured - a.pv).std(axis=0) == pytest.approx([5e-4, 0.1], rel=0.06)


def test_measured_follows_the_plants_output(cstr):
    assert np.array_equal(cstr.measured(np.ones((2, 3, 2))), np.ones((2, 3, 2)))
    x = np.arange(6.0).reshape(2, 3, 1)
    assert np.array_equal(Lag().measured(x), 10 * x)
    assert Lag().measured(np.array([2.0])).tolist() == [20.0]


def test_a_state_that_is_lost_names_its_sample(cstr, middle):
    flow = np.where(np.arange(5) < 3, cstr.F, np.nan)
    mv = np.full((5, 1), 250.0)
    with pytest.raises(PlantError, match="the state at sample 4 is"):
        simulate_open(cstr, middle, np.where(np.isnan(flow)[:, None], np.nan, mv))
    with pytest.raises(PlantError, match="the state at sample 4 is"):
        simulate_closed(cstr, nothing, demand(cstr, 5, F=flow))
    with pytest.raises(PlantError, match="the state at sample 0 is"):
        simulate_batch(cstr, np.array([middle, [np.inf, 300.0]]), np.full((2, 2, 1), 250.0))
    with pytest.raises(PlantError, match=r"MV is \[nan\] at sample 0; it must be finite"):
        simulate_closed(cstr, lambda *_: (np.array([np.nan]), ()), demand(cstr, 5))


def test_wrong_shapes_and_names_are_plant_errors(cstr, middle):
    mv = np.full((5, 1), 250.0)
    with pytest.raises(PlantError, match=r"x0 has shape \(3,\); \(2,\) is wanted"):
        simulate_open(cstr, np.zeros(3), mv)
    with pytest.raises(PlantError, match="mv has shape"):
        simulate_open(cstr, middle, np.zeros((5, 2)))
    with pytest.raises(PlantError, match="no parameter 'U'"):
        simulate_closed(cstr, nothing, demand(cstr, 5, U=np.ones(5)))
    with pytest.raises(PlantError, match=r"UA has shape \(4,\); give one value a period, \(5,\)"):
        demand(cstr, 5, UA=np.ones(4))
    with pytest.raises(PlantError, match="one standard deviation >= 0 for each"):
        simulate_closed(cstr, nothing, demand(cstr, 5), noise=[0.1])
