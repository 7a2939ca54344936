"""Linear loops, Lyapunov functions and recoveries against cases whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.cases.henson_seborg_cstr.plant import HensonSeborgCstr
from loopwright.pipeline.errors import LawError, PlantError
from loopwright.pipeline.laws.pid.pid import PID
from loopwright.pipeline.tuning.rules import PidSettings, sampled_loop
from loopwright.pipeline.tuning.stability import (
    LARGEST_MARGIN,
    FrozenLoops,
    Recovery,
    Starts,
    feedback,
    other_rests,
    pairwise_contraction,
    quadratic_contraction,
    recover,
    spectral_radius,
)


@pytest.fixture(scope="module")
def plant() -> HensonSeborgCstr:
    return HensonSeborgCstr()


@pytest.fixture(scope="module")
def settings() -> PidSettings:
    return PidSettings(2550.0, 57.54, 13.2, filter_s=1.32)


@pytest.fixture(scope="module")
def pid(plant, settings) -> PID:
    return PID(plant.signals, settings)


def eigenvalues(matrix: np.ndarray) -> np.ndarray:
    values = np.linalg.eigvals(matrix)
    large = values[np.abs(values) > 1e-6]
    return large[np.lexsort((large.imag, large.real))]


def test_frozen_loops_of_a_pid_have_the_eigenvalues_of_its_equations(plant, pid, settings):
    cvs = np.array([0.02, 0.07, 0.13])
    loops = FrozenLoops.of(plant, pid, pid.n_state, cvs).matrices()
    for cv, matrix in zip(cvs, loops, strict=True):
        lin = plant.linearize(*plant.steady_state_at(float(cv)))
        wanted = sampled_loop(type(lin)(lin.x, lin.mv, lin.a, lin.b, lin.c[:1]), settings, plant.period_s)
        assert eigenvalues(matrix) == pytest.approx(eigenvalues(wanted), abs=1e-7)


def test_feedback_keeps_the_eigenvalues_that_count(plant, pid):
    loops = FrozenLoops.of(plant, pid, pid.n_state, np.array([0.03, 0.1])).matrices()
    small = feedback(loops)
    assert small.shape[1] < loops.shape[1]
    assert spectral_radius(small) == pytest.approx(spectral_radius(loops), abs=1e-12)


def test_gain_margin_is_where_the_loop_becomes_unstable(plant, pid):
    loops = FrozenLoops.of(plant, pid, pid.n_state, np.array([0.02, 0.05, 0.1]))
    margin = loops.gain_margin()
    assert 1 < margin < LARGEST_MARGIN
    assert spectral_radius(loops.matrices(margin)).max() < 1 < spectral_radius(loops.matrices(1.01 * margin)).max()


def test_gain_margin_of_an_unstable_loop_is_none(plant, settings):
    hard = PID(plant.signals, PidSettings(1e6, settings.ti_s))
    assert FrozenLoops.of(plant, hard, hard.n_state, np.array([0.1])).gain_margin() == 0.0


def test_a_law_that_does_not_rest_has_no_frozen_loop(plant):
    def drifting(sp, pv, dv, mv, state):
        return mv + 1.0, state, sp[..., :0]

    with pytest.raises(LawError, match="come to rest"):
        FrozenLoops.of(plant, drifting, 1, np.array([0.1]))


def test_a_pid_tells_of_its_loops_where_it_is_asked_to(plant, settings):
    asked = {"tuning": "manual", "kc": settings.kc, "ti_s": settings.ti_s, "td_s": settings.td_s, "filter_s": 1.32}
    signals = plant.signals
    told = PID.design(PID.Params(**asked, examined_cv=(0.015, 0.13)), {}, signals, plant).analysis(plant)
    assert told.figures["frozen_radius"] == pytest.approx(told.arrays["frozen_radius"].max())
    assert 3 < told.figures["gain_margin"] < 4
    assert set(PID.design(PID.Params(**asked), {}, signals, plant).analysis(plant).figures) == {"kc", "ti_s", "td_s"}


def rotation(angle: float, size: float = 1.0) -> np.ndarray:
    return size * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_contraction_of_one_loop_is_its_spectral_radius():
    loop = np.array([[0.9, 5.0], [0.0, 0.8]])
    assert quadratic_contraction(loop[None]) == pytest.approx(0.9, abs=3e-3)


def test_rotations_share_the_plain_norm():
    loops = np.array([rotation(a, 0.7) for a in (0.1, 1.0, 2.0)])
    assert quadratic_contraction(loops) == pytest.approx(0.7, abs=3e-3)


def test_stable_loops_whose_product_grows_have_no_common_function():
    first, second = np.array([[0.5, 2.0], [0.0, 0.5]]), np.array([[0.5, 0.0], [2.0, 0.5]])
    assert spectral_radius(np.array([first, second])).max() < 1 < spectral_radius((first @ second)[None])[0]
    assert np.isnan(quadratic_contraction(np.array([first, second])))


def test_an_unstable_loop_has_no_function():
    assert np.isnan(quadratic_contraction(np.array([rotation(0.3, 1.01)])))


def test_contraction_bounds_every_switching_course():
    rng = np.random.default_rng(0)
    loops = np.array([rotation(0.2, 0.8) + 0.1 * rng.standard_normal((2, 2)) for _ in range(4)])
    rate = quadratic_contraction(loops)
    assert spectral_radius(loops).max() <= rate < 1
    product = np.eye(2)
    for k in rng.integers(0, 4, 400):
        product = loops[k] @ product
    assert np.linalg.norm(product) <= 1e3 * rate**400


def test_pairs_take_the_loops_between_their_points():
    at = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    loops = np.array([rotation(0.3, size) for size in (0.5, 0.6, 0.5, 0.8, 0.5)])
    assert pairwise_contraction(loops, at, [0.0, 1.0, 2.0]) == pytest.approx([0.6, 0.8], abs=3e-3)
    with pytest.raises(LawError, match="a pair needs its two ends"):
        pairwise_contraction(loops, at, [0.1, 0.4])


def test_recoveries_in_a_batch_equal_single_ones(plant, pid):
    x = np.array([[0.05, 455.0], [0.12, 440.0], [0.02, 480.0]])
    starts = Starts(x, np.array([[0.08], [0.03], [0.1]]), np.array([[90.0], [60.0], [100.0]]))
    options = {"samples": 400, "band": 1e-3, "holding": 50}
    together = recover(plant, pid, pid.n_state, starts, **options)
    assert together.arrived.all()
    for i in range(3):
        one = Starts(*(part[i : i + 1] for part in (starts.x, starts.sp, starts.mv)))
        alone = recover(plant, pid, pid.n_state, one, **options)
        assert alone.samples[0] == together.samples[i]
        assert alone.end[0] == pytest.approx(together.end[i], rel=1e-9)


def test_recoveries_of_batches_are_those_of_all(plant, pid):
    rng = np.random.default_rng(3)
    starts = Starts(rng.uniform([0.02, 440.0], [0.12, 480.0], (7, 2)), np.full((7, 1), 0.06), np.full((7, 1), 90.0))
    options = {"samples": 200, "band": 1e-3, "holding": 50}
    batches = starts.batches(3)
    assert [len(batch.x) for batch in batches] == [3, 3, 1]
    found = [recover(plant, pid, pid.n_state, b, watched=2 * (i == 0), **options) for i, b in enumerate(batches)]
    joined, whole = Recovery.together(found), recover(plant, pid, pid.n_state, starts, watched=2, **options)
    assert np.array_equal(joined.arrived, whole.arrived)
    assert np.array_equal(joined.samples, whole.samples)
    assert joined.end == pytest.approx(whole.end, rel=1e-9)
    assert joined.courses == pytest.approx(whole.courses, rel=1e-9, nan_ok=True)


def test_what_holds_its_set_point_arrives_at_once_and_what_is_off_never(plant):
    def still(sp, pv, dv, mv, state):
        return mv, state, sp[..., :0]

    x, mv = plant.steady_state_at(0.05)
    starts = Starts(np.array([x, x]), np.array([[0.05], [0.06]]), np.array([mv, mv]))
    found = recover(plant, still, 1, starts, samples=100, band=1e-3, holding=20, watched=2)
    assert found.arrived.tolist() == [True, False]
    assert found.samples.tolist() == [0.0, 100.0]
    assert found.courses.shape == (2, 20, 2)
    assert found.courses[1] == pytest.approx(np.tile(x, (20, 1)), rel=1e-9)
    assert np.isnan(found.courses[0, -1]).all()


def test_the_plant_rests_gone_out_beyond_its_set_points(plant):
    rests = other_rests(plant)
    for x in rests:
        assert np.abs(np.array(plant.rate(x, [20.0 if x[0] < 0.95 else 150.0], [], plant.parameters()))).max() < 1e-4
    assert (rests[:, 0] > 0.9).sum() == 2  # at either end of the MV
    assert (rests[:, 0] < 0.005).sum() == 1  # too hot for the lowest set point


def test_starts_of_different_numbers_are_an_error():
    with pytest.raises(PlantError, match="one of each"):
        Starts(np.zeros((2, 2)), np.zeros((1, 1)), np.zeros((2, 1)))
