"""Excitations: properties of their sequences, and what their records hold of the plant."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_plant import Lag, Mixer

from loopwright.pipeline.cases import CASES, beside
from loopwright.pipeline.cases.batch_reactor.plant import BatchReactor
from loopwright.pipeline.cases.jacketed_batch_reactor.plant import JacketedBatchReactor
from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.config.params import parse
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.excitation import EXCITATIONS as GENERAL
from loopwright.pipeline.excitation import Excitation, OpenLoop
from loopwright.pipeline.excitation.operating_point import OperatingPoint
from loopwright.pipeline.excitation.sequences import TAPS, Aprbs, Batches, Multisine, Prbs, RandomSteps, maximal_length
from loopwright.pipeline.models.training.regressors import forward_pairs, inverse_pairs
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import simulate_open
from loopwright.serving.manifest import Signal

# Every kind of excitation, those that only one case has among them.
EXCITATIONS: dict[str, type[Excitation]] = dict(GENERAL)
for case in CASES.values():
    EXCITATIONS |= beside(case, "excitations", "EXCITATIONS", {})
SMALL = {
    "random_steps": {"samples": 300},
    "prbs": {"samples": 300, "order": 5},
    "aprbs": {"samples": 300, "order": 5},
    "multisine": {"samples": 300, "cycle": 100, "lines": 10},
    "operating_point": {"samples": 300, "run_length": 120, "restarts": 50, "filter_s": 1.7},
    "batches": {"samples": 30, "batches": 10},
    "jacket_pulses": {"samples": 300},
}
# The plant that an excitation is for; the others excite the first case's.
PLANT_OF = {"jacket_pulses": JacketedBatchReactor}
FEW = {"samples": 200, "restarts": 20}
FEEDBACK = {"operating_point", "jacket_pulses"}  # whose MVs answer to what is measured


@pytest.fixture(scope="module")
def cstr() -> ThiosulfateCstr:
    return ThiosulfateCstr()


@pytest.fixture
def plant(kind):
    return PLANT_OF.get(kind, ThiosulfateCstr)()


# ---------------------------------------------------------------- contract of all


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_record_is_that_of_its_seed(kind, plant):
    excitation = EXCITATIONS[kind](**SMALL[kind])
    a, b, other = (excitation.run(plant, seed) for seed in (5, 5, 6))
    assert isinstance(a, Record)
    assert a.digest() == b.digest()
    assert a.digest() != other.digest()
    assert a.mv_signals == plant.mv_signals


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_record_is_what_the_plant_does(kind, plant):
    record = EXCITATIONS[kind](**SMALL[kind]).run(plant, 0)
    for run in np.unique(record.run):
        rows = record.run == run
        pv, mv = record.pv[rows], record.mv[rows]
        assert np.allclose(simulate_open(plant, pv[0], mv)[:-1], pv, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_mv_stays_in_its_range_and_moves(kind, plant, tmp_path):
    record = EXCITATIONS[kind](**SMALL[kind]).run(plant, 1)
    record.write(tmp_path / "r.parquet")
    # Reading checks range, movement, time and runs.
    again = Record.read(tmp_path / "r.parquet", plant.signals)
    assert again.digest() == record.digest()


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_noise_is_of_the_given_size(kind, plant):
    quiet = EXCITATIONS[kind](**SMALL[kind])
    noisy = dataclasses.replace(quiet, noise=(0.0, 0.5)).run(plant, 2)
    if kind not in FEEDBACK:  # there the feedback sees the noise, and the plant goes another way
        plain = quiet.run(plant, 2)
        assert np.array_equal(plain.mv, noisy.mv)
        assert np.array_equal(plain.pv[:, 0], noisy.pv[:, 0])
        assert (noisy.pv - plain.pv)[:, 1].std() == pytest.approx(0.5, rel=0.15)
    rows = noisy.starts(1)
    after = np.array([simulate_open(plant, noisy.pv[k], noisy.mv[[k]])[1] for k in rows[:40]])
    assert np.abs(after - noisy.pv[rows[:40] + 1])[:, 1].max() > 0.3


@pytest.mark.parametrize("kind", EXCITATIONS)
def test_params_are_parsed_and_wrong_ones_refused(kind):
    excitation = parse(EXCITATIONS[kind], {**SMALL[kind], "noise": [5e-4, 0.1]}, "records.x")
    assert excitation.noise == (5e-4, 0.1)
    with pytest.raises(ParamsError, match="unknown key 'sample'; did you mean 'samples'"):
        parse(EXCITATIONS[kind], {"sample": 3}, "records.x")
    with pytest.raises(ParamsError, match=f"{kind}'?: samples is 0; it must be at least 1"):
        EXCITATIONS[kind](**SMALL[kind] | {"samples": 0})


def test_every_field_is_documented():
    for excitation in EXCITATIONS.values():
        text = " ".join(c.__doc__ or "" for c in excitation.__mro__)
        missing = [f.name for f in dataclasses.fields(excitation) if f.name not in text]
        assert not missing, f"{excitation.__name__}: {missing}"


# ---------------------------------------------------------------- sequences


@pytest.mark.parametrize("order", [n for n in TAPS if n <= 14])
def test_maximal_length_sequence(order):
    bits = maximal_length(order)
    n = 2**order - 1
    assert len(bits) == n
    assert bits.sum() == 2 ** (order - 1)  # one more 1 than 0
    # Two-valued autocorrelation of the +-1 sequence: n at shift 0 and -1 elsewhere, so all states occur.
    power = np.abs(np.fft.fft(2.0 * bits - 1)) ** 2
    assert np.allclose(np.fft.ifft(power).real[1:], -1.0, atol=1e-6)


def test_prbs_of_two_mvs_are_nearly_uncorrelated():
    bits = Prbs(samples=2**9 - 1, order=9).unit_sequence(2, np.random.default_rng(0))
    assert abs(np.corrcoef(bits.T)[0, 1]) < 0.01


@given(hold=st.integers(1, 9), samples=st.integers(1, 200), n_mv=st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_levels_are_held(hold, samples, n_mv):
    for excitation in (
        RandomSteps(samples=samples, hold=hold),
        Prbs(samples=samples, hold=hold, order=6),
        Aprbs(samples=samples, hold=hold, order=6),
    ):
        mv = excitation.unit_sequence(n_mv, np.random.default_rng(0))
        assert mv.shape == (samples, n_mv)
        assert mv.min() >= 0
        assert mv.max() <= 1
        assert set(np.flatnonzero(np.diff(mv, axis=0).any(axis=1)) % hold) <= {hold - 1}


def test_random_steps_are_uniform():
    mv = RandomSteps(samples=20_000).unit_sequence(1, np.random.default_rng(0))[:, 0]
    counts = np.histogram(mv, bins=10, range=(0, 1))[0]
    assert np.abs(counts - 2000).max() < 5 * np.sqrt(2000 * 0.9)


def test_aprbs_draws_a_level_at_every_flip_only():
    excitation = Aprbs(samples=4000, hold=3, order=8)
    bits = excitation.bits(1, np.random.default_rng(0))[:, 0]
    mv = excitation.unit_sequence(1, np.random.default_rng(0))[:, 0]
    assert np.array_equal(np.diff(bits) != 0, np.diff(mv) != 0)
    held = np.diff(np.flatnonzero(np.r_[True, np.diff(mv) != 0]))
    assert held.max() <= 3 * 8


def test_multisine_fills_its_range_with_a_low_peak():
    excitation = Multisine(samples=1000, cycle=500, lines=60)
    mv = excitation.unit_sequence(1, np.random.default_rng(0))[:, 0]
    assert (mv.min(), mv.max()) == (0.0, 1.0)
    assert np.array_equal(mv[:500], mv[500:])
    wave = mv[:500] - mv[:500].mean()
    assert np.abs(wave).max() / wave.std() < 2.0  # cosines in phase: sqrt(2 lines) = 11


def test_multisines_of_several_mvs_share_no_frequency():
    mv = Multisine(samples=600, cycle=600, lines=40).unit_sequence(3, np.random.default_rng(0))
    lines = np.abs(np.fft.rfft(mv - mv.mean(axis=0), axis=0)) > 1e-6
    assert lines.sum(axis=0).tolist() == [40, 40, 40]
    assert lines.sum(axis=1).max() == 1
    with pytest.raises(ParamsError, match="lengthen it or take fewer lines"):
        Multisine(samples=600, cycle=600, lines=100).unit_sequence(3, np.random.default_rng(0))


@pytest.mark.parametrize("kind", [k for k, e in EXCITATIONS.items() if issubclass(e, OpenLoop)])
def test_several_mvs_each_in_its_own_range(kind):
    record = EXCITATIONS[kind](**SMALL[kind], start=(0.0, 0.0)).run(Mixer(), 0)
    assert record.mv.shape == (300, 2)
    for column, signal in zip(record.mv.T, Mixer.mv_signals, strict=True):
        assert signal.low <= column.min() < column.max() <= signal.high
        assert np.ptp(column) > 0.8 * (signal.high - signal.low)


@pytest.mark.parametrize("kind", [k for k, e in EXCITATIONS.items() if issubclass(e, OpenLoop)])
def test_a_discrete_mv_takes_its_values_and_no_others(kind):
    small = {"order": 7} if kind in {"prbs", "aprbs"} else {}
    record = EXCITATIONS[kind](**{**SMALL[kind], **small}).run(JacketedBatchReactor(), 0)
    mode = record.mv[:, 1]
    assert set(np.unique(mode)) == {1.0, 2.0}
    assert (mode == 1.0).mean() == pytest.approx(0.5, abs=0.2)
    assert np.ptp(record.mv[:, 0]) > 0.8


class Valve(Lag):
    mv_signals = (Signal("valve", "-", 0.0, 10.0, values=(0.0, 10.0)),)


def test_a_range_without_a_value_of_a_discrete_mv_is_refused():
    with pytest.raises(ParamsError, match=r"valve may be \[0\.0, 10\.0\], and none of these lies between 2 and 8"):
        RandomSteps(samples=10, low=2.0, high=8.0).run(Valve(), 0)
    assert set(np.unique(RandomSteps(samples=99, low=2.0).run(Valve(), 0).mv)) == {10.0}


def test_range_may_be_narrowed_but_not_left(cstr):
    record = RandomSteps(samples=400, low=200.0, high=300.0).run(cstr, 0)
    assert 200 <= record.mv.min() < 205
    assert 295 < record.mv.max() <= 300
    for low, high in ((-1.0, None), (None, 501.0), (300.0, 200.0)):
        with pytest.raises(ParamsError, match="low < high within 0 to 500 are allowed"):
            RandomSteps(samples=10, low=low, high=high).run(cstr, 0)
    with pytest.raises(ParamsError, match="order is 40; it must be between 2 and 18"):
        Prbs(samples=10, order=40)


# ---------------------------------------------------------------- what the records hold


def test_random_steps_hold_one_percent_of_the_unstable_region(cstr):
    record = RandomSteps(samples=60_000).run(cstr, 0)
    share = np.bincount(cstr.region(record.pv[:, 0]), minlength=3) / len(record)
    assert len(record) == 60_000
    # The plant changes branches only some 50 times in a record, so that the shares of hot and
    # cold stray by 0.07 between seeds; that of the region between them by 0.0005.
    assert share[[0, 2]] == pytest.approx([0.86, 0.13], abs=0.1)
    assert share[1] == pytest.approx(0.009, abs=0.002)


@pytest.fixture(scope="module")
def around(cstr) -> tuple[OperatingPoint, Record]:
    excitation = OperatingPoint(
        samples=4_000, run_length=800, restarts=3_000, sp_low=0.03, sp_high=0.985, filter_s=1.7, dither=30.0, near=40.0
    )
    return excitation, excitation.run(cstr, 3)


def test_operating_point_holds_mostly_the_unstable_region(cstr, around):
    _, record = around
    share = np.bincount(cstr.region(record.pv[:, 0]), minlength=3) / len(record)
    assert share[1] > 0.4
    assert share.min() > 0.02


def test_operating_point_layout(around):
    excitation, record = around
    length = np.bincount(record.run)
    loops = np.flatnonzero(length == excitation.run_length)
    assert len(loops) == 5
    assert loops[0] == 0
    assert (length[np.setdiff1d(np.arange(len(length)), loops)] == excitation.move_hold + 1).all()
    assert len(length) == 5 + excitation.restarts
    # The short runs start from states of the loop right before them.
    ends = np.r_[loops[1:], len(length)]
    for loop, end in zip(loops, ends, strict=True):
        visited = {tuple(x) for x in record.pv[record.run == loop]}
        first = np.flatnonzero(np.r_[True, np.diff(record.run) != 0])[loop + 1 : end]
        assert {tuple(x) for x in record.pv[first]} <= visited


def test_operating_point_feeds_pairs_over_its_hold(around):
    excitation, record = around
    moves = excitation.restarts
    assert len(forward_pairs(record, 3)) >= moves
    pairs = inverse_pairs(record, 3)
    assert pairs.x.shape == (len(pairs), 3)
    train, validation = pairs.split(0.7, "time")
    assert len(train) + len(validation) > 0.99 * len(pairs)


def test_share_of_moves_near_the_feedback(cstr):
    plant_range = 500.0
    used = np.full(4000, 250.0)
    near = OperatingPoint(**FEW, near=10.0, near_fraction=1.0).sequence(cstr, used, np.random.default_rng(0))[:, 0]
    assert near.std() == pytest.approx(10.0, rel=0.1)
    anywhere = OperatingPoint(**FEW, near_fraction=0.0).sequence(cstr, used, np.random.default_rng(0))[:, 0]
    assert anywhere.std() == pytest.approx(plant_range / np.sqrt(12), rel=0.05)
    wide = OperatingPoint(**FEW, near=1e3, near_fraction=1.0).sequence(cstr, used, np.random.default_rng(0))[:, 0]
    assert wide.min() == 0.0


def test_feedback_holds_its_set_point_without_dither(cstr):
    excitation = OperatingPoint(
        **FEW, dither=0.0, sp_low=0.6, sp_high=0.7, sp_hold_low=200, sp_hold_high=200, filter_s=1.7
    )
    loop = excitation.closed_loop(cstr, excitation.settings(cstr), 200, np.random.default_rng(0))
    assert np.ptp(loop.pv[-30:, 0]) < 1e-3
    assert 0.6 < loop.pv[-1, 0] < 0.7


def test_a_pid_may_be_given_and_other_plants_are_served(cstr):
    excitation = OperatingPoint(**FEW, kc=-1200.0, ti_s=9.0, td_s=2.0)
    settings = excitation.settings(cstr)
    assert (settings.kc, settings.ti_s, settings.td_s) == (-1200.0, 9.0, 2.0)
    lag = OperatingPoint(samples=200, restarts=20, filter_s=60.0, dither=1.0, near=1.0).run(Lag(), 0)
    assert lag.pv.shape == (200 + 80, 1)
    with pytest.raises(PlantError, match="has 2 MVs; 'operating_point' excites exactly one"):
        OperatingPoint(**FEW).run(Mixer(), 0)
    with pytest.raises(PlantError, match="sp_low < sp_high within 0 to 1 are allowed"):
        OperatingPoint(**FEW, sp_low=0.5, sp_high=0.4).set_points(cstr)
    with pytest.raises(ParamsError, match="sp_hold_high is 5; it must be at least 20"):
        OperatingPoint(**FEW, sp_hold_high=5)
    with pytest.raises(ParamsError, match="restarts is 0; it must be at least 1"):
        OperatingPoint(samples=200, restarts=0)


def test_short_runs_of_several_moves_hold_each_and_go_to_the_ends(cstr: ThiosulfateCstr) -> None:
    excitation = OperatingPoint(samples=500, restarts=200, moves=3, move_hold=4, near_fraction=0.0, end_fraction=0.5)
    record = excitation.run(cstr, 0)
    short = record.run >= 1
    mv = record.mv[short, 0].reshape(200, 13)
    assert (mv[:, :12].reshape(200, 3, 4) == mv[:, :12:4, None]).all()
    assert (mv[:, -1] == mv[:, -2]).all()
    assert np.isin(mv[:, :12], (0.0, 500.0)).mean() == pytest.approx(0.5, abs=0.1)


# ---------------------------------------------------------------- batches


def levels_of(excitation: Batches, seed: int = 0) -> np.ndarray:
    """MVs of each batch on [0, 1], shape (batches, samples)."""
    return excitation.unit_sequence(1, np.random.default_rng(seed)).reshape(excitation.batches, excitation.samples)


def test_every_batch_is_a_run_from_the_start_of_the_plant() -> None:
    plant = BatchReactor()
    record = Batches(samples=50, batches=40, binary=0.2, end_fraction=0.3).run(plant, 0)
    assert np.array_equal(np.bincount(record.run), np.full(40, 50))
    first = np.flatnonzero(record.time_s == 0)
    assert np.array_equal(record.pv[first, 0], np.full(40, 25.0))
    # Full heating brings the reactor to where the profile can be followed, full cooling keeps it below.
    ends = record.pv[first + 20, 0]
    assert ends.min() < 45
    assert ends.max() > 85


def test_batches_hold_their_first_level_for_any_time_and_the_others_alike() -> None:
    excitation = Batches(samples=40, batches=400, hold=4, constant=0.0, binary=0.0, end_fraction=0.0)
    changes = [np.flatnonzero(np.diff(row)) + 1 for row in levels_of(excitation)]
    first = np.array([c[0] if len(c) else 40 for c in changes])
    assert all((np.diff(c) == 4).all() for c in changes)
    assert set(first) == set(range(1, 41))
    assert np.abs(np.bincount(first, minlength=41)[1:] - 10).max() < 5 * np.sqrt(10)


def test_shares_of_constant_and_of_binary_batches() -> None:
    mv = levels_of(Batches(samples=60, batches=4000, hold=2, constant=0.2, binary=0.3, end_fraction=0.25))
    alike = np.ptp(mv, axis=1) == 0
    binary = np.isin(mv, (0.0, 1.0)).all(axis=1) & ~alike
    # A batch also keeps one level by chance: where the first one is held to the end, one in sixty.
    assert alike.mean() == pytest.approx(0.2 + 0.8 / 60, abs=0.03)
    assert binary.mean() == pytest.approx(0.3 * 59 / 60, abs=0.03)
    others = mv[~alike & ~binary]
    assert np.isin(others[:, 0], (0.0, 1.0)).mean() == pytest.approx(0.25, abs=0.04)
    # From full heating to full cooling, once, at any time.
    heated = np.flatnonzero((mv[:, 0] == 1) & (mv[:, -1] == 0) & ((np.diff(mv, axis=1) != 0).sum(axis=1) == 1))
    assert len(heated) > 5


def test_the_start_of_a_batch_may_vary_within_the_range_of_the_states() -> None:
    plant = BatchReactor()
    excitation = Batches(samples=5, batches=2000, start_spread=(0.05, 0.0, 2.0))
    x0 = excitation.initial_states(plant, np.random.default_rng(0))
    assert x0[:, 0].max() == 1.0  # of C_A, whose range ends at the start
    assert x0[:, 0].min() > 0.7
    assert np.array_equal(x0[:, 1], np.zeros(2000))
    assert x0[:, 2].mean() == pytest.approx(25.0, abs=0.2)
    assert x0[:, 2].std() == pytest.approx(2.0, rel=0.1)
    with pytest.raises(ParamsError, match=r"start_spread is \[1\.0\]; give one .* each state .*: C_A, C_B, T"):
        Batches(samples=5, batches=2, start_spread=(1.0,)).run(plant, 0)
    with pytest.raises(ParamsError, match=r"binary is 0\.6; it must be between 0 and 0\.5"):
        Batches(samples=5, batches=2, constant=0.5, binary=0.6)


def test_an_experiment_starts_where_its_plant_does() -> None:
    record = RandomSteps(samples=10).run(BatchReactor(), 0)
    assert record.pv[0, 0] == 25.0
