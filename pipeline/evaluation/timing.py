"""How long a controller's step takes, against a limit and against the perfect NMPC's."""

from __future__ import annotations

from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.verdicts import Check, Verdict

HOW = "(timed while validating, other work beside; alone: make bench)"


def step_times(evidence: Evidence) -> dict[str, float]:
    """Median step of every law that was timed [us]."""
    return {name: law.step_us for name, law in evidence.laws.items() if law.step_us is not None}


def step_within(limit_us: float, *laws: str) -> Check:
    """A check that the named laws' median steps stay within a limit [us]."""

    def check(evidence: Evidence) -> Verdict:
        times = step_times(evidence)
        what, limit = "controller step, median", f"≤ {limit_us:g} us for {', '.join(laws)} {HOW}"
        if not times:
            return Verdict(what, limit, "measured by `make bench`", None)
        shown = ", ".join(f"{n} {t:.0f} us" for n, t in times.items())
        asked = [times[n] for n in laws if n in times]
        return Verdict(what, limit, shown, max(asked) <= limit_us if asked else None)

    return check


def faster_than_nmpc(factor: float, scenario: str, title: str, *laws: str) -> Check:
    """A check that the named laws (none: all) step so many times faster than the perfect NMPC over a test.

    The NMPC's time is stored with the bounds; `make bench` measures both in one run.
    """

    def check(evidence: Evidence) -> Verdict:
        what = f"perfect NMPC's median step over the controllers' ({title}; the NMPC's as stored)"
        limit = f"at least {factor:g} for {', '.join(laws) or 'each'}"
        nmpc, times = evidence.bound(scenario, "step_ms_p50"), step_times(evidence)
        if nmpc is None or not times:
            return Verdict(what, limit, "measured by `make bench`", None)
        ratios = {n: 1e3 * nmpc / t for n, t in times.items()}
        asked = [ratios[n] for n in laws or ratios if n in ratios]
        shown = ", ".join(f"{n} {r:.0f}" for n, r in ratios.items())
        return Verdict(what, limit, shown, min(asked) >= factor if asked else None)

    return check
