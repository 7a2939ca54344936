"""The benchmark of analysers: what each way sees of one record, and figures of answers that are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benchmark_modules import FOLDER, benchmark_modules

MODULES = ("operated_plant", "analysed", "figures", "from_record", "analysers")


@pytest.fixture(scope="module")
def own() -> Any:
    return benchmark_modules(MODULES, FOLDER / "operated_plants")


def test_ways_differ_in_what_the_analyser_shows_alone(own: Any) -> None:
    plant, rows = own.analysed.SERIES, 2_000
    record = own.from_record.record_of(own.analysers.quiet(plant), rows, 1)
    fresh, held = (own.analysers.read_as(record, plant, 1, way) for way in ("fresh", "held"))
    assert own.analysers.read_as(record, plant, 1, "true") is record
    assert held.fresh is None
    np.testing.assert_array_equal(fresh.pv, held.pv)
    np.testing.assert_array_equal(held.pv[:, 0], record.pv[:, 0])
    for i, every in plant.every.items():
        at = np.flatnonzero(fresh.fresh[:, i])
        assert not (at % every).any()
        assert len(at) / (rows / every) == pytest.approx(1 - plant.missing[i], abs=0.1)
        np.testing.assert_array_equal(fresh.pv[at, i], record.pv[at, i])
        assert (np.diff(held.pv[:, i]) != 0).sum() == len(at) - 1
    assert list(fresh.seldom) == [1, 2]


def test_gain_and_time_of_an_answer_that_is_known(own: Any) -> None:
    rows = np.arange(400)
    answer = 3.0 + 2.0 * np.where(rows > 7, 1 - np.exp(-(rows - 7) / 15.0), 0.0)
    gain, time = own.analysers.gain_and_time(answer)
    assert gain == pytest.approx(2.0, rel=1e-6)
    assert time == pytest.approx(22.0, abs=0.05)


def test_the_true_course_is_late_by_what_the_analyser_is(own: Any) -> None:
    plant = own.analysed.DISTILLATION
    for j, mv in enumerate(own.analysers.steps_of(plant)):
        course = own.analysers.true_course(plant, mv)
        first = [int(np.flatnonzero(np.abs(y - y[0]) > 1e-12)[0]) for y in course.T]
        # The step of row 1 shows one row later, and in the analyser late.
        assert first == [2, 2 + own.analysed.LATE, 2]
        step = mv[1, j] - mv[0, j]
        assert course[-1] - course[0] == pytest.approx(step * own.analysed.GAIN[:, j], rel=1e-6)


def test_a_day_misses_results_and_a_plant_without_missing_ones_has_its_old_day(own: Any) -> None:
    plant = own.analysed.DISTILLATION
    day, whole = plant.day(3, 2_000), replace(plant, missing={}).day(3, 2_000)
    np.testing.assert_array_equal(day.noise, whole.noise)
    assert day.fresh[0].all()
    assert whole.fresh[:, 1].sum() == 100
    assert 80 <= day.fresh[:, 1].sum() < 100
    assert ((day.fresh[:, 1] == 0) | (whole.fresh[:, 1] == 1)).all()
