"""Whether a record proves its model: the answers of models that are right, or the controller read backwards."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_records import OperatedLoop

from loopwright.pipeline.models.identified.model_validation import ProvenAnswer, Region, proof_figures, proven_answers
from loopwright.pipeline.models.identified.scaled_record import ScaledRecord, Scales
from loopwright.pipeline.models.identified.structure import Structure

MOVED = OperatedLoop(gain=-2.0, dead=3, kc=0.5, ti=10.0, hold=100)
AT_REST = OperatedLoop(gain=-2.0, dead=3, kc=0.5, ti=10.0)
LENGTH = 60
PLAIN = Structure("balanced", 2, (0, 0), (0,))
GOOD = {"model": 2.0, "low": 1.8, "high": 2.2, "first": 5, "last": 9, "direct": 1.9, "sd": 0.2, "halves": (8.0, 7.0)}


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [
        ({}, "proven"),
        ({"model": 5.0, "low": 4.0, "high": 6.0}, "proven"),  # within a factor of three
        ({"model": 6.5, "low": 6.0, "high": 7.0}, "size"),
        ({"direct": 1.9, "sd": 0.7}, "uncertain"),
        ({"direct": None, "sd": None}, "uncertain"),
        ({"low": -0.1}, "uncertain"),  # a model as likely has the other sign
        ({"direct": -1.9}, "opposite"),
        ({"halves": (8.0, -2.5)}, "halves"),
        ({"halves": (8.0, -1.5)}, "proven"),  # no half is certain of the other sign
    ],
)
def test_what_speaks_against_an_answer(changed: dict[str, float], verdict: str) -> None:
    assert ProvenAnswer(**{**GOOD, **changed}).verdict == verdict


def test_units_scale_all_that_has_one() -> None:
    found = ProvenAnswer(**GOOD, regions=(Region(-1.0, 0.5, True, ProvenAnswer(**GOOD)),)).times(10.0, 40.0, 50.0)
    assert (found.model, found.direct, found.sd) == (20.0, 19.0, 2.0)
    assert (found.first, found.halves, found.verdict) == (5, (8.0, 7.0), "proven")
    (region,) = found.regions
    assert (region.start, region.end, region.answer.low, region.small) == (10.0, 70.0, 18.0, True)
    assert [of["from"] for of in found.to_dict()["regions"]] == [10.0]
    assert "regions" not in ProvenAnswer(**GOOD).to_dict()


UP, DOWN = (
    ProvenAnswer(**GOOD),
    ProvenAnswer(**{**GOOD, "model": -1.0, "low": -1.1, "high": -0.9, "direct": -1.0, "halves": ()}),
)
MEAN = {**GOOD, "model": 0.1, "low": -0.1}  # of a gain that turns: uncertain


def regions(*of: ProvenAnswer, small: tuple[int, ...] = ()) -> tuple[Region, ...]:
    return tuple(Region(float(i), i + 1.0, i in small, answer) for i, answer in enumerate(of))


@pytest.mark.parametrize(
    ("changed", "by", "verdict"),
    [
        ({}, (UP, DOWN), "turns"),
        ({"direct": -1.9}, (UP, DOWN), "turns"),  # the mean over the regions has the other sign by right
        ({}, (UP, UP), "fades"),
        ({"low": 1.8, "model": 2.0}, (UP, DOWN), "proven"),
        ({}, (UP, ProvenAnswer(**{**GOOD, "direct": -1.9})), "uncertain"),  # a region speaks against its model
        ({}, (UP, ProvenAnswer(**{**GOOD, "halves": (8.0, -2.5)})), "uncertain"),
        ({}, (UP, ProvenAnswer(**{**GOOD, "sd": 0.7})), "fades"),  # uncertain in a region is no contradiction yet
    ],
)
def test_an_answer_that_changes_is_judged_by_its_regions(
    changed: dict[str, float], by: tuple[ProvenAnswer, ...], verdict: str
) -> None:
    assert ProvenAnswer(**{**MEAN, **changed}, regions=regions(*by)).verdict == verdict


def test_a_region_of_small_gain_decides_nothing() -> None:
    against = ProvenAnswer(**{**GOOD, "direct": -1.9})
    assert ProvenAnswer(**MEAN, regions=regions(UP, against, DOWN, small=(1,))).verdict == "turns"
    assert ProvenAnswer(**MEAN, regions=regions(against, small=(0,))).verdict == "uncertain"


def of(loop: OperatedLoop, curve: np.ndarray, structure: Structure = PLAIN) -> ProvenAnswer:
    """Of a model whose answer to a step of 1 % is ``curve`` (LENGTH,) [degC]."""
    record = loop.record(2_400, 4)
    scales = Scales.of(record, 1)
    rows = ScaledRecord.of(record, scales)
    scaled = curve * scales.v_scale[0] / scales.y_scale[0]
    members = np.array([0.95, 1.0, 1.05])[:, None, None, None] * scaled[None, None, :, None]
    found, surprise = proven_answers(members, structure, rows, np.ones(1), 1)
    assert surprise[0] * scales.y_scale[0] == pytest.approx(0.23, abs=0.05)
    table = proof_figures(found, record, scales, [{"y": {"free_run_rmse": 0.5, "held_sd": 1.3}}], np.array([0.3]))
    run = {"missed": pytest.approx(0.4), "motion": pytest.approx(np.sqrt(1.6)), "share": pytest.approx(0.5 / 1.3)}
    assert table["free_run"]["y"] == run
    entry = table["answers"]["y"]["u"]
    assert entry["verdict"] == found[0, 0].verdict
    assert 0 < entry["follows"] <= 1
    return found[0, 0].times(float(scales.y_scale[0] / scales.v_scale[0]))


def true_curve(loop: OperatedLoop) -> np.ndarray:
    return loop.answer(np.ones(LENGTH + 1))[1:]


def test_the_true_model_is_proven_where_set_points_moved() -> None:
    found = of(MOVED, true_curve(MOVED))
    assert found.verdict == "proven"
    assert found.model < 0
    assert (found.first, found.last) == (10, 26)  # half and nine tenths of a lag of 10 rows behind three


def test_a_model_of_the_wrong_sign_is_not_proven() -> None:
    assert of(MOVED, -true_curve(MOVED)).verdict == "opposite"


def test_no_model_is_proven_by_a_record_whose_mv_only_follows_the_pv() -> None:
    assert of(AT_REST, true_curve(AT_REST)).verdict == "uncertain"
    assert of(AT_REST, -true_curve(AT_REST)).verdict == "uncertain"


def test_the_controller_read_backwards_is_not_proven() -> None:
    """PV = set point - MV / Kc at once, and back as the integral takes over."""
    back = 1 / AT_REST.kc * np.exp(-np.arange(LENGTH) / AT_REST.ti)
    for loop in (MOVED, AT_REST):
        found = of(loop, back)
        assert (found.first, found.last) == (1, 1)
        assert found.verdict in {"uncertain", "opposite"}


def test_rows_count_from_the_step_whatever_the_dead_times_and_the_rows_convention() -> None:
    curve = true_curve(MOVED)
    late = of(MOVED, curve[3:], Structure("balanced", 2, (0, 0), (3,)))
    assert (late.first, late.last) == (10, 26)
    same = of(MOVED, curve, Structure("balanced", 2, (0, 0), (0,), same_row=True))
    assert (same.first, same.last) == (9, 25)


@pytest.mark.parametrize(("weight", "verdict"), [(1.0, "uncertain"), (0.3, "proven")])
def test_one_poor_model_of_many_vetoes_nothing(weight: float, verdict: str) -> None:
    """Of ten models one has the other sign; it counts by how likely it is."""
    record = MOVED.record(2_400, 4)
    scales = Scales.of(record, 1)
    unit = scales.v_scale[0] / scales.y_scale[0]
    signs = np.r_[np.ones(9), -1.0][:, None, None, None]
    curves, weights = signs * true_curve(MOVED)[None, None, :, None] * unit, np.r_[np.ones(9), weight]
    found, _ = proven_answers(curves, PLAIN, ScaledRecord.of(record, scales), np.ones(1), 1, None, weights)
    assert found[0, 0].verdict == verdict


def test_a_weak_answer_of_several_decides_nothing() -> None:
    rng = np.random.default_rng(0)
    record = MOVED.record(600, 4)
    rows = ScaledRecord.of(record, Scales.of(record, 1))
    two = ScaledRecord(rows.y, np.hstack([rows.v, rng.uniform(-1, 1, (600, 1))]), rows.run)
    curves = np.ones((2, 2, LENGTH, 1)) * np.array([1.0, 0.2])[None, :, None, None]
    found, _ = proven_answers(curves, Structure("balanced", 2, (0, 0), (0, 0)), two, np.ones(2), 2)
    assert list(found) == [(0, 0)]
