"""Process variables that no MV moves, and which ones a controller takes where there are more of them than MVs."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.pipeline.historian.excitation import SEEN
from loopwright.pipeline.historian.findings import Finding, Verdict, counted


def of_answers(pvs: Sequence[str], verdict: Verdict) -> list[Finding]:
    """One finding for each PV that answers to no MV, and one where not every PV can be controlled.

    Empty where no PV answers at all: then the verdict says what is wrong with the MVs. ``pvs`` are names, in order.
    """
    mvs = [i for i in verdict.inputs if i.role == "mv"]
    unmoved = [n for n in pvs if not any(i.answers.get(n, 0.0) > SEEN or n in i.first_answer_s for i in mvs)]
    found = []
    if len(unmoved) < len(pvs):
        found += [Finding("unmoved", n, "answers to no MV: leave its role empty, or make it dv") for n in unmoved]
    if len(pvs) > len(mvs):
        first, others = ", ".join(pvs[: len(mvs)]), ", ".join(pvs[len(mvs) :])
        words = (
            f"will be controlled, the first of {counted(len(pvs), 'PV')} for {counted(len(mvs), 'MV')}; {others} will "
            "not: to change it, put the PVs to control first"
        )
        found.append(Finding("controlled", first, words))
    return found
