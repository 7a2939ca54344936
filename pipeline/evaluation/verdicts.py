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


# -------------------------------------- the time of a controller's step, against a limit and against the perfect NMPC's
HOW = "(timed during validation, beside other work; `make bench` times it alone)"


def step_times(evidence: Evidence) -> dict[str, float]:
    """Median step of every law that was timed [us]; raises NotMeasuredError where none was."""
    times = {name: law.step_us for name, law in evidence.laws.items() if law.step_us is not None}
    if not times:
        raise NotMeasuredError("measured by `make bench`")
    return times


def step_within(limit_us: float, *laws: str) -> Check:
    """A check that the named laws' median steps stay within a limit [us]."""

    def measure(evidence: Evidence) -> CheckOutcome:
        times = step_times(evidence)
        shown = ", ".join(f"{n} {t:.0f} us" for n, t in times.items())
        own = [times[n] for n in laws if n in times]
        return CheckOutcome(shown, max(own) <= limit_us if own else None)

    return Check("controller step, median", measure, f"≤ {limit_us:g} us for {', '.join(laws)} {HOW}")


def faster_than_nmpc(factor: float, scenario: str, title: str, *laws: str) -> Check:
    """A check that the named laws (none: all) step so many times faster than the perfect NMPC over a test.

    The NMPC's time is stored with the bounds; `make bench` measures both in one run.
    """

    def measure(evidence: Evidence) -> CheckOutcome:
        nmpc, times = evidence.bound(scenario, "step_ms_p50"), step_times(evidence)
        if nmpc is None:
            raise NotMeasuredError("measured by `make bench`")
        ratios = {n: 1e3 * nmpc / t for n, t in times.items()}
        own = [ratios[n] for n in laws or ratios if n in ratios]
        return CheckOutcome(", ".join(f"{n} {r:.0f}" for n, r in ratios.items()), min(own) >= factor if own else None)

    what = f"median step of the perfect NMPC / of the controller ({title}; the NMPC's time is stored)"
    return Check(what, measure, f"at least {factor:g} for {', '.join(laws) or 'each'}")
