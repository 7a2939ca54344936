"""The batch reactor: why a figure may differ from the paper's, and checks of its claims.

Source of the claims: [chen2004, section 5.2].
"""

from __future__ import annotations

import numpy as np

from pipeline.evaluation.case import Curve, PaperFigure
from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.timing import faster_than_nmpc, step_within
from pipeline.evaluation.verdicts import Claim, Claims, Verdict, plain_reason
from pipeline.pictures.words import law_name, number

TEST, NOISY = "trajectory", "trajectory_noise"
PLAIN, CALM = (Curve("linearized_pid", {form: True}) for form in ("without_recipe", "calmed"))


def reason(row: PaperFigure, ours: float, evidence: Evidence) -> str:
    """The words for a figure of Table 3 that does not reproduce: what of it any controller could avoid."""
    bound = evidence.bound(TEST)
    if bound is None:
        return plain_reason(row, ours, evidence)
    late, late_s = evidence.figure(row.law, row.scenario, "sse_late", row.setting), evidence.late_s(TEST)
    after = "" if late is None else f", {number(late)} of it from {late_s:g} s on"
    return (
        f"{number(bound)} is lost while full heating cannot reach the profile, whatever the controller: ours adds "
        f"{number(ours - bound)}{after}, the paper's {number(row.paper - bound)}, where its forgetting factor and "
        "starting model are not printed"
    )


def _ahead(evidence: Evidence) -> Verdict:
    laws = ("linearized_pid", "recursive_pid")
    rows = {law: [evidence.figure(law, NOISY, metric) for metric in ("sse", "sse_late")] for law in laws}
    found = {law: [v for v in values if v is not None] for law, values in rows.items()}
    if any(len(values) < 2 for values in found.values()):
        return Verdict("", "", "not measured", None)
    measured = "; ".join(
        f"{law_name(law)}: SSE {number(sse, 4)}, {number(late)} of it from {evidence.late_s(TEST):g} s on"
        for law, (sse, late) in found.items()
    )
    ours, other = (found[law] for law in laws)
    holds = ours[0] < other[0] and ours[1] < other[1]
    return Verdict(
        "", "", measured, holds, "both figures have to be lower; the start is out of every controller's reach"
    )


def _calm(evidence: Evidence) -> Verdict:
    """Travel of kc over the late part, as a multiple of its mean, without and with filter and update criterion."""
    travel = [_travel(evidence, curve) for curve in (PLAIN, CALM)]
    known = [t for t in travel if t is not None]
    if len(known) < 2:
        return Verdict("", "", "not measured", None)
    plain, calm = known
    measured = f"kc travels {number(plain)} times its mean without them, {number(calm)} times with them"
    return Verdict("", "", measured, calm < plain, f"on {NOISY}, from {evidence.late_s(TEST):g} s on")


def _travel(evidence: Evidence, curve: Curve) -> float | None:
    law, loop = evidence.laws.get(curve.law), evidence.loop(curve, NOISY)
    if law is None or loop is None or "info" not in loop or "kc" not in law.info(curve.setting):
        return None
    kc = loop["info"][evidence.late_from(NOISY) :, law.info(curve.setting).index("kc")]
    mean = float(np.mean(np.abs(kc)))
    return float(np.sum(np.abs(np.diff(kc)))) / mean if mean else None


CLAIMS = Claims(
    reason=reason,
    statements=(
        Claim("the linearized PID tracks better than the recursive one", _ahead),
        Claim("filter and update criterion calm the settings", _calm),
    ),
    acceptance=(
        step_within(80.0, "linearized_pid"),
        faster_than_nmpc(20.0, TEST, TEST, "linearized_pid"),
    ),
)
