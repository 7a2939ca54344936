"""The plan of a certificate: all that is fixed and written down before the first loop runs.

The seed follows from the plan's digest, and the plan names the controller, the family of plants, what a failure is and
how many loops run. So nobody picks the plants, nor stops before the first failure: with one loop more or less, all
others are drawn anew, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from loopwright.pipeline.config.params import CertificateParams
from loopwright.pipeline.errors import ParamsError, nearest
from loopwright.pipeline.evaluation.case import Case
from loopwright.pipeline.evaluation.certificate.bound import at_most_fail
from loopwright.pipeline.evaluation.stress.draws import (
    DRAWN_LOADS,
    KINDS,
    LATE_LOOPS,
    MOST_SPAN,
    MOST_ZERO,
    NOISE,
    STROKE,
    STUCK_FOR,
    STUCK_FROM,
    Drawing,
)
from loopwright.pipeline.evaluation.stress.loops import LOOP_FAILURES, SWINGS, StressOutcome
from loopwright.pipeline.files import digest
from loopwright.pipeline.plants.plant_digest import plant_digest
from loopwright.pipeline.plants.simulator import Simulator
from loopwright.serving.certificate import LISTED, MOST_LOOPS, Certificate, CertifiedFamily
from loopwright.serving.version import __version__

SEED_DIGITS = 12  # hexadecimal, of the plan's digest: a number that every reader of JSON takes


@dataclass(frozen=True)
class CertificatePlan:
    """The plan for one law: ``law`` is its digest (``Controller.law_sha256``), ``params`` say which loops run.

    Raises PlantError where no other plant can be drawn, ParamsError for a limit on a figure that the case has not.
    """

    law: str
    case: Case
    params: CertificateParams

    def __post_init__(self) -> None:
        if not 1 <= self.params.loops <= MOST_LOOPS:
            raise ParamsError(f"a certificate of {self.params.loops} loops; give from 1 to {MOST_LOOPS}")
        for name in self.params.limits:
            if name not in self.case.metrics:
                raise ParamsError(f"no loop has the figure {name!r}{nearest(name, self.case.metrics)}")
        _ = self.family  # raises where no other plant can be drawn

    @property
    def _drawing(self) -> Drawing:
        return Drawing(self.case, 0, self.params.spread / 100, self.params.faults / 100)

    @cached_property
    def family(self) -> CertifiedFamily:
        """The plants, tests, noise and faults that loops are drawn from, with a digest of all that decides a draw."""
        drawing, case = self._drawing, self.case
        plants = {id(p): p for tests in drawing.tests.values() for p in map(drawing.plant_of, tests)}
        ranges: dict[str, tuple[float, float]] = {}
        for plant in plants.values():
            for name, (low, high) in drawing.ranges(plant).items():
                known = ranges.get(name, (low, high))
                ranges[name] = (min(low, known[0]), max(high, known[1]))
        family = CertifiedFamily(
            case=case.name,
            sha256="",
            plants=len(plants),
            tests=tuple(drawing.tests),
            held_out=tuple(case.held_out_seeds),
            parameters=ranges,
            spread=drawing.spread,
            loads=DRAWN_LOADS,
            noise=NOISE,
            late=LATE_LOOPS,
            faulty=drawing.faults,
            faults=KINDS,
            without=_not_drawn(list(plants.values()), ranges, drawing),
        )
        return replace(family, sha256=self._family_digest(family, list(plants.values())))

    def _family_digest(self, family: CertifiedFamily, plants: Sequence[Simulator]) -> str:
        drawing, case = self._drawing, self.case
        return digest(
            {
                "case": case.name,
                "plants": [[plant_digest(p), _ends(drawing.ranges(p))] for p in plants],
                "tests": {name: [test.digest() for test in tests] for name, tests in drawing.tests.items()},
                "noise": [f"{v:.9g}" for v in (*case.noise_std, *family.noise)],
                "asked": [f"{v:.9g}" for v in case.asked],
                "loads": [*family.loads, family.late],
                "actuators": [family.faulty, *KINDS, *STUCK_FROM, *STUCK_FOR, MOST_ZERO, MOST_SPAN, *STROKE],
            }
        )

    @property
    def fails_if(self) -> tuple[str, ...]:
        """The failures that count, in words that go on ``a loop that ...``."""
        return (*LOOP_FAILURES, *([SWINGS] if self.params.swings else ()))

    @cached_property
    def sha256(self) -> str:
        """Digest of the plan."""
        return digest(self._fixed())

    def _fixed(self) -> dict[str, Any]:
        return {
            "law": self.law,
            "family": self.family.sha256,
            "fails_if": list(self.fails_if),
            "limits": dict(self.params.limits),
            "loops": self.params.loops,
            "confidence": self.confidence,
        }

    @property
    def confidence(self) -> float:
        """The confidence as a share."""
        return round(self.params.confidence / 100, 12)

    @property
    def seed(self) -> int:
        """The seed of all draws: the first digits of the plan's digest."""
        return int(self.sha256[:SEED_DIGITS], 16)

    def drawing(self) -> Drawing:
        """How the loops are drawn."""
        return replace(self._drawing, seed=self.seed)

    def record(self) -> dict[str, Any]:
        """JSON-ready values of the record that is written before the first loop runs."""
        made = {"release": __version__, "family": self.family.to_dict()}
        return {"plan": self.sha256, "seed": self.seed, **self._fixed(), **made}

    def failures(self, outcome: StressOutcome) -> tuple[str, ...]:
        """How a loop failed by this plan; empty where it did not."""
        over = (name for name, most in self.params.limits.items() if outcome.figures.get(name, most) > most)
        return (
            *outcome.failures,
            *([SWINGS] if self.params.swings and outcome.swings else ()),
            *(f"{name} {outcome.figures[name]:.4g}" for name in over),
        )

    def certificate(self, outcomes: Sequence[StressOutcome], stepped_by: str) -> Certificate:
        """The certificate that the loops of this plan show; ``stepped_by`` computed the law's steps.

        Raises ValueError for the loops of another number than the plan's.
        """
        if [o.index for o in outcomes] != list(range(self.params.loops)):
            raise ValueError(f"{len(outcomes)} loops; the plan has the loops 0 to {self.params.loops - 1}")
        found = {str(o.index): how for o in outcomes if (how := self.failures(o))}
        loops, failures = self.params.loops, len(found)
        return Certificate(
            law=self.law,
            plan=self.sha256,
            seed=self.seed,
            loops=loops,
            failures=failures,
            confidence=self.confidence,
            at_most=at_most_fail(failures, loops, self.confidence),
            fails_if=self.fails_if,
            family=self.family,
            limits=dict(self.params.limits),
            failed=dict(list(found.items())[:LISTED]),
            stepped_by=stepped_by,
        )


def plan_again(certificate: Certificate, case: Case) -> CertificatePlan:
    """The plan of a certificate that was made before, of ``case`` with the certificate's held-out sequences.

    ParamsError where today's plant or tests are others, so that the same numbers would draw other loops.
    """
    family = certificate.family
    params = CertificateParams(
        loops=certificate.loops,
        confidence=round(100 * certificate.confidence, 9),
        spread=round(100 * family.spread, 9),
        faults=round(100 * family.faulty, 9),
        limits=certificate.limits,
        swings=SWINGS in certificate.fails_if,
    )
    plan = CertificatePlan(certificate.law, case.with_held_out(family.held_out), params)
    if plan.family.sha256 != family.sha256:
        raise ParamsError(
            f"the family of plants of {case.name} is another one than when the certificate was made "
            f"({plan.family.sha256[:12]}..., then {family.sha256[:12]}...): its plant, its tests or its noise have "
            "changed, so these loops cannot be run again; certify the file anew"
        )
    if plan.sha256 != certificate.plan:
        raise ParamsError("the certificate's plan has another digest than its own entries; certify the file anew")
    return plan


def _ends(ranges: Mapping[str, tuple[float, float]]) -> dict[str, list[str]]:
    return {name: [f"{v:.9g}" for v in ends] for name, ends in ranges.items()}


def _not_drawn(plants: Sequence[Simulator], ranges: Mapping[str, Any], drawing: Drawing) -> tuple[str, ...]:
    """All that no loop of the family meets, in words."""
    names = dict.fromkeys(name for plant in plants for name in plant.parameter_names())
    still = [name for name in names if name not in ranges and name not in drawing.disturbed]
    return (
        "plants of another structure",
        *([f"other values of {', '.join(still)}"] if still else ()),
        "set points and disturbances beyond those of the tests, and what takes longer than one",
        "sensors that fail or drift",
        "faults of two actuators at once" if drawing.faults else "faults of actuators",
        "operators' changes",
        "lost samples and late scans",
    )
