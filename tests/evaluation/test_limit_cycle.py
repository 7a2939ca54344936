"""Limit cycles: by the span of the set points and the noise, by the MVs' ranges, with amplitude and period."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from own_cases import controllers_of_a_lag

from loopwright.pipeline.cases.own_plant import OwnCase
from loopwright.pipeline.evaluation.closed_loop import RANGE_BAND, STEP_BAND
from loopwright.pipeline.evaluation.law_evidence import Cycle
from loopwright.pipeline.evaluation.stuck_loops import swings_on
from loopwright.pipeline.evaluation.trials import MV_SWING, NOISES, cycle_of
from loopwright.pipeline.simulation.simulate import Trajectory, simulate_closed

PERIOD = 8  # samples of a swing


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OwnCase]:
    """A lag whose set points go over about 1.5 m of a range of 6 m, with little noise."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("lag"))
        yield controllers_of_a_lag({}, noise=1e-4)


def resting(case: OwnCase) -> Trajectory:
    """A load test with the controlled variable at its set point."""
    test = case.scenarios()["load"][0]
    loop = simulate_closed(test.plant or case.plant, lambda sp, pv, mv: (mv, []), test)
    return replace(loop, pv=loop.sp.copy())


def found(case: OwnCase, *, cv: float = 0.0, mv: float = 0.0, fades: float = 0.0) -> Cycle | None:
    loop = resting(case)
    k = np.arange(len(loop.sp))
    swing = (np.cos(2 * np.pi * (k + 0.5) / PERIOD) * np.exp(-fades * k))[:, None]
    return cycle_of(case, case.scenarios()["load"][0], replace(loop, pv=loop.pv + cv * swing, mv=loop.mv + mv * swing))


def test_a_cv_swings_beyond_the_band_of_a_settled_step_of_the_set_points(case: OwnCase) -> None:
    limit = STEP_BAND * float(case.asked[0])
    assert limit < 0.01 * 6.0  # less than a swing that is told by the range
    cycle = found(case, cv=1.3 * limit)
    assert cycle is not None
    assert (cycle.signal, cycle.unit, cycle.period_s) == ("y0", "m", pytest.approx(PERIOD))
    assert cycle.amplitude == pytest.approx(1.3 * limit, rel=0.1)
    assert cycle.times == pytest.approx(1.3, rel=0.1)
    assert found(case, cv=0.9 * limit) is None
    assert found(case) is None


def test_an_mv_swings_beyond_its_share_of_the_range_though_the_cv_rests(case: OwnCase) -> None:
    cycle = found(case, mv=1.3 * MV_SWING * 2.0)
    assert cycle is not None
    assert (cycle.signal, cycle.unit) == ("u0", "V")
    assert found(case, mv=0.9 * MV_SWING * 2.0) is None


def test_a_swing_that_dies_out_is_none(case: OwnCase) -> None:
    assert found(case, cv=100.0 * STEP_BAND * float(case.asked[0]), fades=0.3) is None


def test_what_is_lost_in_the_noise_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    noisy = controllers_of_a_lag({}, noise=0.1)
    assert STEP_BAND * float(noisy.asked[0]) < NOISES * 0.1
    assert found(noisy, cv=0.9 * NOISES * 0.1) is None
    assert found(noisy, cv=1.3 * NOISES * 0.1) is not None


def test_an_own_plant_settles_by_the_span_of_its_set_points_and_no_less_than_the_noise(case: OwnCase) -> None:
    """One and the same error settles by a share of the range, and does not by that of the set points."""
    assert case.asked[0] == pytest.approx(np.ptp([test.sp for test in case.scenarios()["held_out"]]))
    assert case.spans == pytest.approx(np.maximum(case.asked, 1e-4 / RANGE_BAND))
    test, loop = case.scenarios()["load"][0], resting(case)
    error = 0.5 * (RANGE_BAND * float(case.spans[0]) + RANGE_BAND * 6.0)
    figures = case.score(test, loop.pv + error, loop.mv)
    assert figures["settling"] == len(loop.sp)  # it never settles
    assert case.score(test, loop.pv + 0.9 * RANGE_BAND * case.spans, loop.mv)["settling"] == 0
    swinging = replace(loop, pv=loop.pv + 0.012 * case.spans * np.cos(np.pi * np.arange(len(loop.sp)))[:, None])
    assert swings_on(case, test, swinging)


def test_what_a_load_that_steps_back_starts_is_no_limit_cycle_if_it_dies_out(case: OwnCase) -> None:
    """The set point rests all the time; what counts begins after the last move of anything."""
    loop, test = resting(case), case.scenarios()["load"][0]
    n = len(loop.sp)
    k = np.arange(n) - n // 2
    course = np.where(k < 0, 1.0, 0.0)
    dies_out = np.where(k >= 0, np.cos(2 * np.pi * k / PERIOD) * np.exp(-np.maximum(k, 0) / (0.06 * n)), 0.0)[:, None]
    swinging = replace(loop, pv=loop.pv + dies_out)
    stepped = replace(test, changes={**test.changes, next(iter(test.changes)): course})
    assert cycle_of(case, replace(test, changes={}), swinging) is not None
    assert cycle_of(case, stepped, swinging) is None
    assert cycle_of(case, replace(test, changes={}, dv=course[:, None]), swinging) is None
