"""The reversible CSTR's case: its tests against known figures, and a claim's check for each claim."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.cases.reversible_cstr.case import HOLD, LEVELS
from loopwright.pipeline.cases.reversible_cstr.paper import CLAIMS
from loopwright.pipeline.cases.reversible_cstr.pictures import PICTURES
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError

CASE = CASES["reversible_cstr"]


@pytest.fixture(scope="module")
def bare() -> Evidence:
    """Before anything was validated."""
    return Evidence(CASE, {}, {}, {})


def test_tests_follow_the_reference_model_from_rest() -> None:
    tests = CASE.scenarios()
    assert list(tests) == ["levels", "tin", "k", "ua", "dh", "held_out"]
    for found in (*(t for group in tests.values() for t in group), *CASE.development()):
        assert found.reference is not None
        assert found.reference[0, 0] == found.sp[0, 0] == pytest.approx(found.x0[0])
        assert np.abs(np.diff(found.reference[:, 0])).max() < 0.1 * max(np.ptp(found.sp), 0.01)
    (levels,) = tests["levels"]
    assert levels.sp.shape == (HOLD * len(LEVELS), 1)
    for k in range(len(LEVELS)):  # the course has arrived at the end of every hold
        assert levels.reference[(k + 1) * HOLD - 1, 0] == pytest.approx(LEVELS[k], abs=1e-5)


def test_disturbances_begin_after_rest_and_are_what_they_say() -> None:
    tests, plant = CASE.scenarios(), CASE.plant
    for name, factor in (
        ("tin", {"T_in": 1.1}),
        ("k", {"k1": 0.8, "k2": 0.8}),
        ("ua", {"h": 1.5}),
        ("dh", {"beta": 1.2}),
    ):
        (test,) = tests[name]
        assert set(test.changes) == set(factor)
        for key, times in factor.items():
            own = getattr(plant, key)
            np.testing.assert_allclose(test.changes[key], np.where(np.arange(test.samples) < 20, own, times * own))


def test_the_reference_models_own_figures() -> None:
    """What a perfect follower scores: its IAE is the reference model's, 38.7 mol/l s over the twelve levels."""
    (test,) = CASE.scenarios()["levels"]
    assert test.reference is not None
    perfect = np.column_stack([test.reference[:, 0], np.full(test.samples, 410.0)])
    found = CASE.score(test, perfect, np.full((test.samples, 1), 2.0))
    assert found["tracking"] == 0
    assert found["iae"] == pytest.approx(38.7, abs=0.1)
    assert found["itae"] == pytest.approx(897, rel=0.01)
    assert found["max_asse"] < 1e-6
    off = CASE.score(test, perfect + np.array([0.001, 0.0]), np.full((test.samples, 1), 2.0))
    assert off["tracking"] == pytest.approx(0.001)
    assert off["max_asse"] == pytest.approx(0.001, rel=1e-3)


def test_every_claim_has_its_check(bare: Evidence) -> None:
    claims = CLAIMS
    for check in (*claims.statements, *claims.acceptance):
        assert check.statement(bare).measured


def test_claims_of_the_plant_alone(bare: Evidence) -> None:
    statements = {check.what: check.statement(bare) for check in CLAIMS.statements}
    conversion = statements["feedback brings the reaction almost to complete conversion"]
    assert conversion.holds is False
    assert "0.593" in conversion.measured
    warm = statements["the temperature of the open loop rises without end"]
    assert warm.holds is False
    assert "4.9 K" in warm.measured


def test_pictures_without_measurements_are_none(bare: Evidence) -> None:
    matplotlib.use("Agg")
    for picture in PICTURES:
        if picture.name == "reference_models":
            assert picture.draw(bare).axes
            continue
        with pytest.raises(NotMeasuredError):
            picture.draw(bare)
