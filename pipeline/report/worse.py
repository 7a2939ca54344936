"""Reasons against a shipped controller: tests in which it is worse than the baseline, or swings to the end."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.evaluation.law_evidence import lock_up_text
from loopwright.pipeline.evaluation.poor_laws import worst_cycle
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.pictures.words import law_name
from loopwright.pipeline.simulation.scenario import NOISE_SUFFIX


@dataclass(frozen=True, slots=True)
class Worse:
    """A test in which a law's error is above the limit that the baseline's sets."""

    test: str
    own: float  # in the case's metric
    limit: float

    @property
    def factor(self) -> float:
        """How many times the limit the error is; infinite where nothing may be missed."""
        return self.own / self.limit if self.limit > 0 else float("inf")


def limit_of(evidence: Evidence, test: str) -> float | None:
    """The baseline's error in a test, at least what noise can hide; None where there is no baseline to beat."""
    case = evidence.case
    if case.baseline not in evidence.laws or evidence.no_baseline:
        return None
    other = evidence.figure(case.baseline, test)
    return None if other is None else max(other, evidence.floor(test))


def worse_tests(evidence: Evidence, law: str) -> list[Worse]:
    """Tests of the gate in which an own plant's law is worse than its baseline, the worst first."""
    if not evidence.case.on_models or law == evidence.case.baseline:
        return []
    found = []
    for test in (*evidence.case.weights, *evidence.daily):
        own, limit = evidence.figure(law, test), limit_of(evidence, test)
        if own is not None and limit is not None and own > limit:
            found.append(Worse(test, own, limit))
    return sorted(found, key=lambda one: -one.factor)


def shipped_laws(evidence: Evidence) -> list[str]:
    """Laws whose file is shipped."""
    laws = {n: law for n, law in evidence.laws.items() if n != evidence.old_loop}
    return [n for n, law in laws.items() if not (evidence.case.on_models and law.withheld)]


def worst_test(evidence: Evidence, law: str) -> str | None:
    """The test whose picture says most against an own plant's law: where it is worst, or swings; None without one.

    A limit cycle has a picture of its own.
    """
    if not evidence.case.on_models:
        return None
    worse = worse_tests(evidence, law)
    swinging = [t for t in evidence.laws[law].metrics.swings if t.removesuffix(NOISE_SUFFIX) in evidence.tests]
    if worse or evidence.laws[law].metrics.cycles:
        return worse[0].test if worse else None
    return next(iter(swinging), None)


def against(evidence: Evidence) -> list[dict[str, str]]:
    """A row for each shipped law that something speaks against: its name, and clauses."""
    rows, case = [], evidence.case
    for law in shipped_laws(evidence):
        clauses = []
        if worse := worse_tests(evidence, law):
            each = ", ".join(_words(evidence, one) for one in worse)
            clauses.append(f"has a higher {case.criterion.short} than the {law_name(case.baseline)} in {each}")
        if swings := evidence.laws[law].metrics.swings:
            worst = worst_cycle(evidence, law)
            most = f": at worst {evidence.laws[law].metrics.cycles[worst].words} in {worst}" if worst else ""
            clauses.append(f"swings to the end in {lock_up_text(swings)}{most}")
        if clauses:
            rows.append({"law": law, "words": "; it ".join(clauses)})
    return rows


def beyond_reach(evidence: Evidence) -> list[str]:
    """A sentence for each shipped law that had holds whose set point no control gets to, which are no lock-ups."""
    found = {law: evidence.laws[law].metrics.beyond_reach for law in shipped_laws(evidence)}
    return [
        f"Holds of {law} at an end of the MVs count as no lock-up in {lock_up_text(tests)}: "
        "no control gets to their set point in time."
        for law, tests in found.items()
        if tests
    ]


def _words(evidence: Evidence, one: Worse) -> str:
    unit = f" {evidence.case.unit}".rstrip()
    return f"{one.test} (× {one.factor:.3g}: {number(one.own)}{unit} against {number(one.limit)}{unit})"
