"""How long a controller's step takes, against a limit and against the perfect NMPC's."""

from __future__ import annotations

from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.verdicts import Check, CheckOutcome

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
