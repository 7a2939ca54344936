"""Does it reproduce? The paper's figures, the requirements and the claims against what was measured.

A figure reproduces when it lies within ``RELATIVE`` of the paper's, or within ``ABSOLUTE`` of it;
one that says itself how near it must be (``PaperFigure.within``) within that alone.
What a row says when it does not is chosen by what was measured, never written down beforehand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.figure import Figure as Canvas

from pipeline.evaluation.case import PaperFigure, PaperTable, Requirement
from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.metric import Metric

RELATIVE = 0.25
ABSOLUTE = 1e-4


@dataclass(frozen=True, slots=True)
class Verdict:
    """A statement in the words of its check, what was measured, and whether that holds; None: nothing was measured."""

    what: str
    limit: str
    measured: str
    holds: bool | None
    because: str = ""


Reason = Callable[[PaperFigure, float, Evidence], str]
Check = Callable[[Evidence], Verdict]


@dataclass(frozen=True, slots=True)
class CasePicture:
    """A picture that only this case has: figures/<name>.png, below its title; ``draw`` gives None where it cannot."""

    name: str
    title: str
    draw: Callable[[Evidence], Canvas | None]


@dataclass(frozen=True, slots=True)
class Claim:
    """A statement of the paper, and the check of it."""

    text: str
    check: Check


@dataclass(frozen=True, slots=True)
class Claims:
    """What only somebody who knows the case can say: reasons for differences, and further checks and pictures.

    ``reason`` gives the words for a table's figure that does not reproduce; ``statements`` are the paper's;
    ``acceptance`` are checks beyond ``Case.requirements``.
    """

    reason: Reason
    statements: tuple[Claim, ...] = ()
    acceptance: tuple[Check, ...] = ()
    pictures: tuple[CasePicture, ...] = ()


@dataclass(frozen=True, slots=True)
class Met:
    """A requirement against what was measured; ``holds`` None: nothing was measured, or the bound is missing.

    ``law`` is the one that was asked for, or the case's best. ``high`` is the limit in the metric's own unit, a
    bound's figure counted in; None where that bound is missing.
    """

    need: Requirement
    law: str | None
    metric: Metric
    high: float | None
    measured: float | None
    holds: bool | None


@dataclass(frozen=True, slots=True)
class Reproduction:
    """A figure of the paper's tables against ours, the median, least and largest over the data seeds.

    ``reason`` says in words why it does not reproduce; ``as_independent``: ours is then what the independent
    implementation found.
    """

    figure: PaperFigure
    ours: float | None
    low: float | None
    high: float | None
    holds: bool | None
    reason: str = ""
    as_independent: bool = False


def close(ours: float, paper: float, within: float | None = None) -> bool:
    """Whether a figure reproduces the paper's; ``within`` is its own tolerance, where it has one."""
    return abs(ours - paper) <= (max(RELATIVE * abs(paper), ABSOLUTE) if within is None else within)


def plain_reason(row: PaperFigure, ours: float, evidence: Evidence) -> str:
    """The words where nobody knows more than the two numbers."""
    whose = f"{'the paper' if row.printed else 'the independent implementation'}'s"
    if row.within is not None:
        return f"it is {ours - row.paper:+.2g} from {whose}, where {row.within:.2g} is allowed"
    return f"it is {_times(ours, row.paper)} {whose}"


PLAIN = Claims(plain_reason)


def _times(ours: float, paper: float) -> str:
    return f"{ours / paper:.2g} times" if paper else "above"


def paper_row(row: PaperFigure, evidence: Evidence, reason: Reason) -> Reproduction:
    """One row of a paper's table, judged."""
    ours, low, high = (
        evidence.figure(row.law, row.scenario, row.metric, row.setting, how) for how in ("median", "min", "max")
    )
    if ours is None:
        return Reproduction(row, None, low, high, None)
    if close(ours, row.paper, row.within):
        return Reproduction(row, ours, low, high, True)
    as_independent = row.independent is not None and close(ours, row.independent, row.within)
    return Reproduction(row, ours, low, high, False, reason(row, ours, evidence), as_independent)


def requirement(need: Requirement, evidence: Evidence) -> Met:
    """One row of the acceptance list; the limit of a ratio is its factor times the bound's figure."""
    law, metric, high = need.law or evidence.best, evidence.case.metrics[need.metric], need.high
    if need.times is not None:
        bound = evidence.bound(need.scenario, need.metric, need.times)
        if bound is None:
            return Met(need, law, metric, None, None, None)
        high *= bound
    value = None if law is None else evidence.figure(law, need.scenario, need.metric, need.setting)
    return Met(need, law, metric, high, value, None if value is None else bool(need.low <= value <= high))


def acceptance(evidence: Evidence, claims: Claims) -> list[Verdict | Met]:
    """The whole acceptance list: the case's requirements, what every case must show, and its own checks."""
    best = evidence.laws[evidence.best] if evidence.best else None
    seeds = 1 if evidence.own_data else evidence.case.data_seeds  # a plant's own record is one
    locked = {name: law.lock_ups for name, law in evidence.laws.items()}
    common = [
        Verdict(
            "best controller, data seeds",
            f"≥ {seeds}",
            "none is without a lock-up" if best is None else str(best.seeds),
            best is not None and best.seeds >= seeds,
        ),
        Verdict(
            "best controller, lock-ups over all seeds and scenarios",
            "0",
            "every law locks up" if best is None else str(best.lock_ups),
            best is not None and best.lock_ups == 0,
            "lock-ups of all laws: " + ", ".join(f"{n} {v}" for n, v in locked.items()),
        ),
    ]
    rows = [requirement(need, evidence) for need in evidence.case.requirements]
    return [*rows, *common, *(check(evidence) for check in claims.acceptance)]


@dataclass(frozen=True, slots=True)
class Judged:
    """A case held against its paper: the paper's tables, what it had to show, and what the paper states."""

    tables: tuple[tuple[PaperTable, tuple[Reproduction, ...]], ...]
    acceptance: tuple[Verdict | Met, ...]
    statements: tuple[Verdict, ...]


def judge(evidence: Evidence, claims: Claims) -> Judged:
    """All verdicts of a case; checks that take long are asked once."""
    # What is known of the paper's record says nothing of a user's own.
    reason = plain_reason if evidence.own_data else claims.reason
    tables = tuple((t, tuple(paper_row(row, evidence, reason) for row in t.rows)) for t in evidence.case.tables)
    return Judged(tables, tuple(acceptance(evidence, claims)), tuple(statements(evidence, claims)))


def statements(evidence: Evidence, claims: Claims) -> list[Verdict]:
    """The paper's claims in words, each with its check's outcome."""
    found = [(claim.text, claim.check(evidence)) for claim in claims.statements]
    return [Verdict(text, "", verdict.measured, verdict.holds, verdict.because) for text, verdict in found]
