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
from pipeline.pictures.words import law_label, metric_name, number

RELATIVE = 0.25
ABSOLUTE = 1e-4
FINE = 5  # digits shown of a figure that has to be near
RULE = (
    f"A figure reproduces when it lies within {100 * RELATIVE:g} % of the paper's or within {ABSOLUTE:g} of it "
    "(in its own unit), or within what its row names. Ours are medians over the data seeds, whose models were each "
    "learnt from another record."
)


@dataclass(frozen=True, slots=True)
class Verdict:
    """A statement, what was measured, and whether that holds; None: nothing was measured."""

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
class Row:
    """A row of one of the paper's tables beside ours."""

    label: str
    metric: str
    paper: float | None
    ours: float | None
    low: float | None
    high: float | None
    independent: float | None
    verdict: str
    holds: bool | None
    digits: int = 3  # to be shown of its numbers


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


def paper_row(row: PaperFigure, evidence: Evidence, reason: Reason) -> Row:
    """One row of a paper's table, judged."""

    def ours(how: str) -> float | None:
        return evidence.figure(row.law, row.scenario, row.metric, row.setting, how)

    median, digits = ours("median"), 3 if row.within is None else FINE
    if median is None:
        verdict, holds = f"not measured: {_unmeasured(row)}", None
    elif close(median, row.paper, row.within):
        verdict, holds = "reproduces" + ("" if row.within is None else f" within {row.within:.2g}"), True
    else:
        verdict, holds = f"does not, because {reason(row, median, evidence)}", False
        if row.independent is not None and close(median, row.independent, row.within):
            verdict += f"; an independent implementation found {number(row.independent, max(digits, 4))} too"
    metric = metric_name(row.metric, evidence.case.metric_words)
    paper = row.paper if row.printed else None
    low, high = ours("min"), ours("max")
    return Row(row.label, metric, paper, median, low, high, row.independent, verdict, holds, digits)


def _unmeasured(row: PaperFigure) -> str:
    return "this setting was not validated" if row.scenario else f"no such figure of {row.law}"


def requirement(need: Requirement, evidence: Evidence) -> Verdict:
    """One row of the acceptance list; the limit of a ratio is its factor times the bound's figure."""
    law = need.law or evidence.best
    who = _who(need, law)
    value = None if law is None else evidence.figure(law, need.scenario, need.metric, need.setting)
    high, metric = need.high, metric_name(need.metric, evidence.case.metric_words)
    limit = f"{metric} ≤ {number(need.high, 6)}"
    if need.low:
        limit = f"{number(need.low, 6)} ≤ {limit}"
    if need.times is not None:
        bound = evidence.bound(need.scenario, need.metric, need.times)
        limit = f"{metric} ≤ {need.high:g} × {_bound_name(need.times)}"
        if bound is None:
            return Verdict(f"{who}, {need.scenario}", limit, "the bound is missing", None)
        high *= bound
        limit += f" = {number(high, 4)}"
    if value is None:
        return Verdict(f"{who}, {need.scenario}", limit, "not measured", None)
    measured = number(value, 4)
    if need.times is not None and high:
        measured += f" ({value / high * need.high:.3f} ×)"
    return Verdict(f"{who}, {need.scenario}", limit, measured, need.low <= value <= high)


def _bound_name(kind: str) -> str:
    return {"nmpc": "perfect NMPC", "offline": "offline optimum"}.get(kind, kind)


def _who(need: Requirement, law: str | None) -> str:
    """Who is meant: a law with its setting, or the best controller by name."""
    return law_label(need.law, need.setting) if need.law else f"best controller ({law or 'none'})"


def acceptance(evidence: Evidence, claims: Claims) -> list[Verdict]:
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

    tables: tuple[tuple[PaperTable, tuple[Row, ...]], ...]
    acceptance: tuple[Verdict, ...]
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
