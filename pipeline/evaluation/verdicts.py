"""Parts that a case adds to its tests: claims of its paper, further checks, reasons for differences.

A figure reproduces if it differs from the paper's by at most ``RELATIVE`` or ``ABSOLUTE``; a figure
with a tolerance of its own (``PaperFigure.within``), by at most that. Otherwise the measured figures
select the words for the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from loopwright.pipeline.evaluation.case import PaperFigure
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.validation import CheckedStatement

RELATIVE = 0.25  # of the paper's figure: a difference that still reproduces it
ABSOLUTE = 1e-4  # in the figure's unit: the same for figures near zero


@dataclass(frozen=True, slots=True)
class CheckOutcome:
    """The result of a check in words, and whether its statement holds; None: not known."""

    measured: str
    holds: bool | None
    because: str = ""


@dataclass(frozen=True, slots=True)
class Check:
    """A statement of the paper, or a requirement; ``measure`` may raise NotMeasuredError.

    ``limit`` is the requirement's limit in words; it is empty for a statement of the paper.
    """

    what: str
    measure: Callable[[Evidence], CheckOutcome]
    limit: str = ""

    def statement(self, evidence: Evidence) -> CheckedStatement:
        """The check with its outcome; ``holds`` is None if a figure was not measured."""
        try:
            outcome = self.measure(evidence)
        except NotMeasuredError as missing:
            outcome = CheckOutcome(str(missing), None)
        holds = None if outcome.holds is None else bool(outcome.holds)
        return CheckedStatement(self.what, self.limit, outcome.measured, holds, outcome.because)


Reason = Callable[[PaperFigure, float, Evidence], str]


@dataclass(frozen=True, slots=True)
class Claims:
    """The claims, reasons and checks of one case.

    ``reason`` gives the words for a table's figure that does not reproduce; ``statements`` are the paper's;
    ``acceptance`` are checks beyond ``Case.requirements``.
    """

    reason: Reason
    statements: tuple[Check, ...] = ()
    acceptance: tuple[Check, ...] = ()


def close(ours: float, paper: float, within: float | None = None) -> bool:
    """Whether a figure reproduces the paper's; ``within`` is its own tolerance, where it has one."""
    return abs(ours - paper) <= (max(RELATIVE * abs(paper), ABSOLUTE) if within is None else within)


def plain_reason(row: PaperFigure, ours: float, evidence: Evidence) -> str:
    """The reason if only the two numbers are known."""
    if row.within is not None:
        return f"it is {ours - row.paper:+.2g} from the paper's, where {row.within:.2g} is allowed"
    return f"it is {f'{ours / row.paper:.2g} times' if row.paper else 'above'} the paper's"


PLAIN = Claims(plain_reason)
