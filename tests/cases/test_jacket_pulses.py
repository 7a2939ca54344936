"""Pulses toward random targets: what they may be, and where they bring the jacket."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.pipeline.cases.jacketed_batch_reactor.excitations import EXCITATIONS, JacketPulses
from loopwright.pipeline.cases.jacketed_batch_reactor.plant import JacketedBatchReactor
from loopwright.pipeline.cases.thiosulfate_cstr.plant import ThiosulfateCstr
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.records.record import Record
from loopwright.pipeline.simulation.simulate import simulate_open


@pytest.fixture(scope="module")
def record() -> Record:
    return JacketPulses(samples=12_000).run(JacketedBatchReactor(), 0)


def test_the_record_is_a_run_of_the_plant_and_repeats_by_its_seed(record: Record) -> None:
    plant = JacketedBatchReactor()
    x = simulate_open(plant, plant.start[0], record.mv)[:-1]
    np.testing.assert_array_equal(record.pv, x)
    assert EXCITATIONS["jacket_pulses"](samples=12_000).run(plant, 0).digest() == record.digest()
    assert JacketPulses(samples=12_000).run(plant, 1).digest() != record.digest()


def test_openings_are_shut_or_exponential_within_the_range(record: Record) -> None:
    k_m, mode = record.mv.T
    assert set(np.unique(mode)) == {1.0, 2.0}
    assert k_m.min() == 0.0
    assert k_m.max() == 1.0
    assert (k_m == 0).mean() == pytest.approx(0.35, abs=0.04)
    opened = np.unique(k_m[(k_m > 0) & (k_m < 1)])
    # An exponential of mean 1/4 cut at 1: mean 1/4 - 1 / (e^4 - 1), and its share beyond 1 is e^-4.
    assert opened.mean() == pytest.approx(0.25 - 1 / (np.exp(4) - 1), abs=0.02)


def test_pulses_last_two_to_seven_samples_and_modes_twenty_or_more(record: Record) -> None:
    k_m, mode = record.mv.T
    opened = np.flatnonzero(np.diff(k_m) != 0) + 1
    lengths = np.diff(opened)[(k_m[opened] > 0)[:-1] & (k_m[opened] < 1)[:-1]]
    assert lengths.min() == 2
    assert lengths.max() == 7  # two on end are never alike, but for both shut or both wide open
    assert np.diff(np.flatnonzero(np.diff(mode))).min() >= 20


def test_a_new_mode_drives_the_jacket_toward_the_other_side(record: Record) -> None:
    t_w, mode = record.pv[:, 1], record.mv[:, 1]
    switched = np.flatnonzero(np.diff(mode)) + 1
    hotter = mode[switched] == 1
    assert t_w[switched][hotter].mean() < t_w[switched][~hotter].mean() - 10


@pytest.mark.parametrize("mode", [1.0, 2.0])
def test_the_jacket_is_all_over_its_range_in_both_modes(record: Record, mode: float) -> None:
    t_w = record.pv[record.mv[:, 1] == mode, 1]
    share, _ = np.histogram(t_w, bins=[12, 20, 30, 40, 50, 60, 70])
    assert share.min() > 0
    assert share[1:-1].min() > 100


def test_noise_is_on_the_measurements_only() -> None:
    plant = JacketedBatchReactor()
    noisy = JacketPulses(samples=3_000, noise=(0.05, 0.1)).run(plant, 0)
    x = simulate_open(plant, plant.start[0], noisy.mv)[:-1]
    assert (noisy.pv - x).std(axis=0) == pytest.approx([0.05, 0.1], rel=0.1)


def test_plants_and_numbers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(PlantError, match=r"'thiosulfate_cstr' has the signals C_A, T, T_j; 'jacket_pulses' needs"):
        JacketPulses(samples=10).run(ThiosulfateCstr(), 0)
    with pytest.raises(ParamsError, match=r"pulse_high is 1; it must be at least 2"):
        JacketPulses(samples=10, pulse_high=1)
    with pytest.raises(ParamsError, match=r"shut is 1\.5; it must be between 0 and 1"):
        JacketPulses(samples=10, shut=1.5)
