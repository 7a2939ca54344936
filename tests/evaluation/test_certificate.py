"""Certificates: the exact bound, its coverage, and a plan that nobody can pick plants by."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from loopwright.pipeline.cases import CASES
from loopwright.pipeline.config.params import CertificateParams
from loopwright.pipeline.errors import ParamsError, PlantError
from loopwright.pipeline.evaluation.certificate.bound import at_most_fail
from loopwright.pipeline.evaluation.certificate.plan import CertificatePlan, plan_again
from loopwright.pipeline.evaluation.stress.draws import LATE_LOOPS, NOISE, Drawing
from loopwright.pipeline.evaluation.stress.loops import StressOutcome
from loopwright.serving.certificate import Certificate, failures_probability, loops_without_failure

PH_CASE = CASES["ph_neutralization"]
SURE = 0.99


def plan(**options: Any) -> CertificatePlan:
    return CertificatePlan("a" * 64, PH_CASE, CertificateParams(**options))


def outcome(index: int, **how: Any) -> StressOutcome:
    whole: dict[str, Any] = {"figures": {"mae": 0.1}, "locked_up": False, "left_limits": False, "refused": 0}
    return StressOutcome(index, broke=False, **{**whole, **how})


# ---------------------------------------------------------------------- the bound
def test_no_failure_in_459_loops_shows_one_percent_and_in_4603_a_tenth_of_it() -> None:
    assert loops_without_failure(0.01, SURE) == 459
    assert loops_without_failure(0.001, SURE) == 4603
    assert at_most_fail(0, 459, SURE) <= 0.01 < at_most_fail(0, 458, SURE)
    assert at_most_fail(0, 4603, SURE) <= 0.001 < at_most_fail(0, 4602, SURE)
    assert at_most_fail(90, 90, SURE) == 1.0


@pytest.mark.parametrize("loops", [7, 90, 459, 4603])
def test_the_bound_is_the_share_at_which_so_few_failures_are_as_rare_as_the_confidence_says(loops: int) -> None:
    """P(at most k of n fail | p) = 1 - c at p = the bound, by scipy's binomial and by the runtime's own sum."""
    for failures in {0, 1, loops // 10, loops // 2, loops - 1}:
        for confidence in (0.9, 0.99, 0.999):
            p = at_most_fail(failures, loops, confidence)
            assert binom.cdf(failures, loops, p) == pytest.approx(1 - confidence, rel=1e-8)
            assert failures_probability(failures, loops, p) == pytest.approx(1 - confidence, rel=1e-8)


def test_the_bound_covers_every_true_share() -> None:
    """Exact coverage, no draws: a bound below the true share has a probability of at most 1 - c, whatever the share."""
    for loops in (90, 459):
        bounds = np.array([at_most_fail(k, loops, SURE) for k in range(loops + 1)])
        for share in (1e-4, 0.001, 0.01, 0.02, 0.05, 0.1, 0.3, 0.7, 0.99):
            missed = binom.pmf(np.arange(loops + 1), loops, share)[bounds < share].sum()
            assert missed <= 1 - SURE + 1e-12


def test_of_a_hundred_families_of_known_failure_rate_the_bound_holds_in_99(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole certificates: each law's digest gives its plan, its plan its seed, its seed the loops that fail."""
    monkeypatch.setattr(CertificatePlan, "family", plan().family)
    rates, held = np.geomspace(0.001, 0.5, 100), 0
    for i, rate in enumerate(rates):
        one = CertificatePlan(f"law {i}", PH_CASE, CertificateParams(loops=459))
        fails = np.random.default_rng(one.seed).uniform(size=459) < rate
        found = one.certificate([outcome(k, locked_up=bool(f)) for k, f in enumerate(fails)], "")
        assert found.failures == fails.sum()
        held += rate <= found.at_most
    assert held >= 99


# ---------------------------------------------------------------------- the plan
def test_the_seed_follows_from_all_that_is_fixed_and_from_nothing_else() -> None:
    first = plan()
    assert plan().sha256 == first.sha256
    assert first.seed == int(first.sha256[:12], 16)
    others = [
        plan(loops=91),
        plan(confidence=95.0),
        plan(spread=3.0),
        plan(faults=40.0),
        plan(swings=True),
        plan(limits={"mae": 1.0}),
        CertificatePlan("b" * 64, PH_CASE, CertificateParams()),
        CertificatePlan("a" * 64, PH_CASE.with_held_out((9001, 9002)), CertificateParams()),
        CertificatePlan("a" * 64, CASES["ph_neutralization_15s"], CertificateParams()),
    ]
    assert len({one.seed for one in (first, *others)}) == len(others) + 1
    assert first.drawing().seed == first.seed


@pytest.mark.parametrize("case", CASES)
def test_every_case_has_a_family(case: str) -> None:
    family = CertificatePlan("a" * 64, CASES[case], CertificateParams()).family
    assert family.parameters
    assert family.tests == tuple(CASES[case].tests())
    assert family.without


def test_the_family_is_drawn_as_a_stress_test_draws() -> None:
    drawing = Drawing(PH_CASE, spread=0.03, faults=0.4)
    family = plan(spread=3.0, faults=40.0).family
    assert family.parameters == drawing.ranges(PH_CASE.plant)
    assert (family.noise, family.late, family.faulty) == (NOISE, LATE_LOOPS, 0.4)


def test_what_no_loop_meets_is_named() -> None:
    assert any("Wb1" in words for words in plan().family.without)  # a parameter of 0, which no share changes
    assert "faults of actuators" in plan(faults=0.0).family.without


def test_a_failure_is_what_the_plan_says() -> None:
    strict = plan(limits={"mae": 0.5}, swings=True)
    plain = plan()
    swinging, slow = outcome(0, swings=True), outcome(1, figures={"mae": 0.6})
    assert strict.failures(swinging)
    assert strict.failures(slow) == ("mae 0.6",)
    assert not plain.failures(swinging)
    assert not plain.failures(slow)
    assert not strict.failures(outcome(2))
    for how in ({"locked_up": True}, {"left_limits": True}, {"refused": 2}, {"figures": {"mae": float("inf")}}):
        assert strict.failures(outcome(3, **how))


def test_a_certificate_is_of_the_loops_of_its_plan() -> None:
    one = plan(loops=8)
    outcomes = [outcome(k, left_limits=k in (3, 5)) for k in range(8)]
    found = one.certificate(outcomes, "a host")
    assert (found.failures, found.loops, list(found.failed)) == (2, 8, ["3", "5"])
    assert found.at_most == at_most_fail(2, 8, SURE)
    assert (found.plan, found.seed, found.law) == (one.sha256, one.seed, one.law)
    assert Certificate.from_dict(found.to_dict()) == found
    with pytest.raises(ValueError, match="7 loops"):
        one.certificate(outcomes[:-1], "")
    with pytest.raises(ValueError, match="8 loops"):
        one.certificate(outcomes[::-1], "")


def test_the_plan_of_a_certificate_is_found_again() -> None:
    one = plan(loops=8, confidence=97.5, spread=2.5, faults=30.0, limits={"mae": 0.5}, swings=True)
    found = one.certificate([outcome(k) for k in range(8)], "")
    again = plan_again(Certificate.from_dict(found.to_dict()), PH_CASE.with_held_out((1, 2)))
    assert again.sha256 == one.sha256
    assert again.drawing().draw(5).parameters == one.drawing().draw(5).parameters


def test_another_family_than_then_is_refused() -> None:
    found = plan(loops=8).certificate([outcome(k) for k in range(8)], "")
    with pytest.raises(ParamsError, match="another one than when the certificate was made"):
        plan_again(found, CASES["ph_neutralization_15s"])
    with pytest.raises(ParamsError, match="another digest"):
        plan_again(replace(found, plan="0" * 64), PH_CASE)


# ---------------------------------------------------------------------- what cannot be
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"loops": 6}, "too few to say anything"),
        ({"loops": 1, "confidence": 90.0}, "give 4 or more"),
        ({"confidence": 100.0}, "confidence is 100 %"),
        ({"spread": -1.0}, "spread is -1 %"),
        ({"faults": 101.0}, "faults is 101 %"),
    ],
)
def test_what_no_certificate_can_rest_on_is_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        CertificateParams(**options)


def test_a_limit_on_no_figure_is_refused() -> None:
    with pytest.raises(ParamsError, match="did you mean 'mae'"):
        plan(limits={"maee": 1.0})


def test_without_other_plants_there_is_no_family(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> dict[str, tuple[float, float]]:
        raise PlantError("plant 'bare' has no parameters")

    monkeypatch.setattr("loopwright.pipeline.evaluation.stress.draws.Drawing.ranges", none)
    with pytest.raises(PlantError, match="no parameters"):
        plan()
