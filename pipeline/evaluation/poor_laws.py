"""Laws of own plants that their own tests show to be poor: why they are not shipped, in words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import ColdStart
from loopwright.pipeline.evaluation.metric import gate_ratio
from loopwright.pipeline.evaluation.model_evidence import IDENTIFIED
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX

CLEARLY: Final = 0.9  # of the error without control: a law that leaves more of it follows no set point
# % of an MV's range that a cold start at a rest of the record may be off: valves are read to about 1 %, and laws of
# linear models are off by less than .01 %
COLD_NEAR: Final = 2.0
# the same, at a quarter of the rests: a law that is farther off at three quarters of them rests elsewhere than the
# plant. On six plants networks were off by 0 to .6, with loads at the outputs by 2.6 at most, linear models by 0
# (docs/benchmarks.md)
COLD_FAR: Final = 5.0


def why_poor(evidence: Evidence, law: str) -> str:
    """Why a law is not shipped although it locked up nowhere, and what to do; empty where nothing speaks against it.

    The first of: it ends in a limit cycle on a model that did not go wrong; it controls no better than no control; it
    is worse than the old loop in every test; started cold at a rest of the record, it asks for another MV than held the
    plant there. The evidence needs the figures of both laws alone.
    """
    if figures := limit_cycle(evidence, law):
        return f"ends in a limit cycle ({figures}); give it calmer numbers, or its model better data"
    if figures := no_better_than_no_control(evidence, law):
        return f"controls no better than no control ({figures}); give it other numbers, or its MVs more room"
    if figures := worse_than_before_everywhere(evidence, law):
        return f"is worse than the old loop in every test ({figures}); give it other numbers"
    if figures := far_at_a_rest(evidence.laws[law].metrics.cold_start):
        return (
            f"asks for another MV than the record's where it is started cold at its rests ({figures}); give its model "
            "a measured disturbance that tells these rests from others, or rows of a step test around them"
        )
    return ""


def no_better_than_no_control(evidence: Evidence, law: str) -> str:
    """The figures of tests in which a law is no better than MVs at rest, in words; empty where it is.

    Where set points move its error must be below CLEARLY of that without control, elsewhere no higher, tests on plants
    that went wrong apart; and the mean of these ratios, weighted as in the gate, must be below 1. Errors that noise can
    hide are small enough.
    """
    weights, ratios, found = evidence.case.weights, {}, []
    for test, weight in weights.items():
        own, rest, floor = evidence.figure(law, test), evidence.at_rest(test), evidence.floor(test)
        if own is None or rest is None:
            continue
        ratios[test] = weight, gate_ratio(own, rest, floor) if max(rest, floor) > 0 else 1.0
        share = CLEARLY if _moves(evidence, test) else 1.0
        if test.removesuffix(NOISE_SUFFIX) not in evidence.case.gone_wrong and own > max(share * rest, floor):
            found.append(test)
    if not found and len(ratios) == len(weights) and sum(w * r for w, r in ratios.values()) >= sum(weights.values()):
        found = [test for test, (_, ratio) in ratios.items() if ratio >= 1]
    return _figures(evidence, law, ((test, evidence.at_rest(test)) for test in found), "with the MVs at rest")


def limit_cycle(evidence: Evidence, law: str) -> str:
    """The worst limit cycle of a law on models that did not go wrong, in words; empty where there is none.

    Models have no valve that sticks and no coarse reading, so that the law alone makes it. A simulator may have both.
    """
    worst = worst_cycle(evidence, law)
    if worst is None or evidence.case.stand_in != IDENTIFIED or worst in evidence.case.gone_wrong:
        return ""
    return f"{evidence.laws[law].metrics.cycles[worst].words} in {worst}"


def worst_cycle(evidence: Evidence, law: str) -> str | None:
    """The test with the worst limit cycle of a law, on a plant gone wrong only where there is no other; None: none."""
    cycles, wrong = evidence.laws[law].metrics.cycles, evidence.case.gone_wrong
    return max(cycles, key=lambda test: (test not in wrong, cycles[test].times), default=None)


def worse_than_before_everywhere(evidence: Evidence, law: str) -> str:
    """The figures of a law that is worse than the old loop in each test that has both, in words; else empty."""
    tests = evidence.beside_before(law)
    if not tests or len(evidence.worse_than_before(law)) < len(tests):
        return ""
    return _figures(evidence, law, ((test, evidence.figure(evidence.old_loop, test)) for test in tests), "before")


def far_at_a_rest(found: ColdStart | None) -> str:
    """The figures of a law that begins far from the record's MV at most of its rests, or refuses some; else empty.

    At three quarters of the rests it is farther off than ``COLD_FAR``. One rest alone does not withhold a law: a model
    is least exact where its record ends.
    """
    if found is None or not found.rests:
        return ""
    if found.refused:
        return f"refused at {found.refused} of {found.rests} rests"
    away = found.farthest
    if away is None or found.quarter is None or found.quarter <= COLD_FAR:
        return ""
    return (
        f"more than {found.quarter:.3g} % of its range off at three quarters of {found.rests} rests, {COLD_FAR:g} % is "
        f"allowed; {found.mv} {away:.3g} % off at {rest_words(found)}"
    )


def rest_words(found: ColdStart) -> str:
    """The levels of the rest at which a law is farthest from the record's MV: ``y 3.2, u 41``."""
    return ", ".join(f"{name} {level:.4g}" for name, level in found.at.items())


def _moves(evidence: Evidence, test: str) -> bool:
    """Whether a set point of the test moves."""
    tests = evidence.tests.get(test.removesuffix(NOISE_SUFFIX), ())
    return any(np.ptp(one.sp, axis=0).any() for one in tests)


def _figures(evidence: Evidence, law: str, others: Iterable[tuple[str, float | None]], what: str) -> str:
    """``MAE 0.5 degC in held_out, 0.48 before``: figures of a law in tests without noise, each beside another one."""
    short, unit = evidence.case.criterion.short, f" {evidence.case.unit}".rstrip()
    known = dict(others)
    bare = {test: other for test, other in known.items() if test.removesuffix(NOISE_SUFFIX) == test}
    rows = ((test, evidence.figure(law, test), other) for test, other in (bare or known).items())
    words = [
        f"{own:.3g}{unit} in {test}, {other:.3g} {what}"
        for test, own, other in rows
        if own is not None and other is not None
    ]
    return f"{short} {'; '.join(words)}" if words else ""
