"""The batch reactor: why a figure may differ from the paper's, and checks of its claims.

Source of the claims: [chen2004, section 5.2].
"""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.cases.batch_reactor.case import CALMED, PLAIN
from loopwright.pipeline.evaluation.case import Curve, PaperFigure
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.verdicts import (
    Check,
    CheckOutcome,
    Claims,
    faster_than_nmpc,
    plain_reason,
    step_within,
)
from loopwright.pipeline.pictures.numbers import number
from loopwright.pipeline.pictures.words import law_name

TEST, NOISY = "trajectory", "trajectory_noise"


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


def _ahead(evidence: Evidence) -> CheckOutcome:
    laws, late_s = ("linearized_pid", "recursive_pid"), evidence.late_s(TEST)
    errors = {law: [evidence.measured(law, NOISY, metric) for metric in ("sse", "sse_late")] for law in laws}
    measured = "; ".join(
        f"{law_name(law)}: SSE {number(sse, 4)}, {number(late)} of it from {late_s:g} s on"
        for law, (sse, late) in errors.items()
    )
    holds = all(ours < other for ours, other in zip(*errors.values(), strict=True))
    return CheckOutcome(measured, holds, "both figures have to be lower; the start is out of every controller's reach")


def _calm(evidence: Evidence) -> CheckOutcome:
    """Travel of kc over the late part, as a multiple of its mean, without and with filter and update criterion."""
    plain, calm = (_travel(evidence, curve) for curve in (PLAIN, CALMED))
    measured = f"kc travels {number(plain)} times its mean without them, {number(calm)} times with them"
    return CheckOutcome(measured, calm < plain, f"on {NOISY}, from {evidence.late_s(TEST):g} s on")


def _travel(evidence: Evidence, curve: Curve) -> float:
    _, info = evidence.info(curve, NOISY, "kc")
    kc = info["kc"][evidence.late_from(NOISY) :]
    if not kc.any():
        raise NotMeasuredError
    return float(np.sum(np.abs(np.diff(kc)))) / float(np.mean(np.abs(kc)))


CLAIMS = Claims(
    reason=reason,
    statements=(
        Check("the linearized PID tracks better than the recursive one", _ahead),
        Check("filter and update criterion calm the settings", _calm),
    ),
    acceptance=(step_within(80.0, "linearized_pid"), faster_than_nmpc(20.0, TEST, TEST, "linearized_pid")),
)
