"""Laws on each kind of plant gone wrong: their errors, and where the dead time alone makes the worst of them."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass

from loopwright.pipeline.cases.own_model import LATE, GoneWrong
from loopwright.pipeline.evaluation.evidence import Evidence
from loopwright.pipeline.report.identified_model import say_dead_times

# Growth of a law's error on the late plants over that on the worst others, from which on the dead time is to blame. On
# one kind the growth differed by a tenth between the sequences of examples/own_plant: half as much again is no chance.
LATE_ALONE_FACTOR = 1.5


@dataclass(frozen=True, slots=True)
class WrongRow:
    """A kind of plant gone wrong, in words, and each law's mean error on it, in the case's metric.

    ``grown``: how many times the law's error on the same sequences of the models as they are, where both are known.
    """

    test: str
    kind: str
    words: str
    errors: Mapping[str, float]
    grown: Mapping[str, float]


def wrong_rows(evidence: Evidence) -> list[WrongRow]:
    """A row for each kind of plant gone wrong; none where its laws have no figures of single sequences."""
    rows = []
    for name in evidence.case.gone_wrong:
        tests = evidence.tests.get(name, ())
        for kind in dict.fromkeys(test.kind for test in tests if test.kind):
            those = [test for test in tests if test.kind == kind]
            seeds = [str(test.seed) for test in those]
            errors = {law: error for law in evidence.laws if (error := _mean(evidence, law, name, seeds)) is not None}
            before = {law: _mean(evidence, law, "held_out", seeds) for law in errors}
            grown = {law: error / own for law, error in errors.items() if (own := before[law])}
            words = " or ".join(dict.fromkeys(str(GoneWrong.on(test)) for test in those))
            if errors:
                rows.append(WrongRow(name, kind, words, errors, grown))
    return rows


def _mean(evidence: Evidence, law: str, test: str, seeds: list[str]) -> float | None:
    """A law's mean error over sequences of a test; None where one of them has none."""
    found = evidence.laws[law].metrics.sequences.get(test, {})
    errors = [found.get(seed, {}).get(evidence.case.metric) for seed in seeds]
    known = [float(error) for error in errors if error is not None]
    return statistics.fmean(known) if known and len(known) == len(errors) else None


def late_factor(evidence: Evidence, law: str) -> float | None:
    """How many times as much a law's error grows on the late plants as on the worst others; None where one is unknown.

    The record leaves the dead time open where there are late plants at all.
    """
    grown = {row.kind: row.grown[law] for row in wrong_rows(evidence) if law in row.grown}
    late, others = grown.pop(LATE, None), max(grown.values(), default=None)
    return late / others if late is not None and others else None


def dead_time_to_state(evidence: Evidence, law: str) -> str:
    """The remedy for a law whose error the dead time alone makes, which the record leaves open; empty for any other."""
    factor = late_factor(evidence, law)
    if factor is None or factor < LATE_ALONE_FACTOR:
        return ""
    return f"the dead time alone makes {law}'s error here, and the record leaves it open: {say_dead_times(evidence)}"
