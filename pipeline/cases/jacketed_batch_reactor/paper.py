"""The jacketed batch reactor: checks of what its paper states, and of its models and laws.

Source of the claims: [karer, sections 4.2, 5 and 6].
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from loopwright.pipeline.cases.jacketed_batch_reactor.case import (
    AHEAD,
    FEEDFORWARD,
    LAWS,
    OBSERVER,
    PENALTIES,
    PRINTED,
    RECIPE,
    ROUNDING,
)
from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_models import (
    COLDEST,
    drift_when_shut,
    gaps,
    one_step_errors,
    weak_cold_valve,
)
from loopwright.pipeline.cases.jacketed_batch_reactor.fuzzy_plant import MODES, FuzzyBatchReactor
from loopwright.pipeline.evaluation.case import Curve
from loopwright.pipeline.evaluation.evidence import Evidence
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

IDEAL = 1e-12  # [deg C] of rounding
OFFSET = 0.05  # [deg C]
MORE = 2  # switches: there and back
ON_ITS_MODEL = Curve(FEEDFORWARD, PRINTED)


def _ideal(evidence: Evidence) -> CheckOutcome:
    """The core against the reference that was adjusted for it two samples before."""
    names = ("adjusted_reference", "wanted_jacket", "reached_jacket")
    loop, info = evidence.info(ON_ITS_MODEL, "same_model", *names)
    adjusted, requested, reached = info.values()
    error = float(np.abs(adjusted[:-AHEAD] - loop["pv"][AHEAD:, 0]).max())
    moved = np.count_nonzero(np.abs(requested - reached) > ROUNDING)
    measured = f"largest distance {error:.1e} °C; {moved} of {len(requested)} jacket references were adjusted"
    return CheckOutcome(measured, error <= IDEAL, f"ideal is what rounding leaves, {IDEAL:g} °C")


def _feedback(evidence: Evidence) -> CheckOutcome:
    offsets = {law: [evidence.measured(law, "theta_10_noise", m) for m in ("masse", "max_asse")] for law in LAWS}
    shown = ", ".join(
        f"{law_name(law)} {number(mean, 2)} ({number(worst, 2)})" for law, (mean, worst) in offsets.items()
    )
    because = (
        "mean (largest) offset [°C] with the jacket's coefficients off by up to 10 % and noise, each law over the tied "
        f"model; enough is at most {OFFSET:g}"
    )
    return CheckOutcome(
        shown, all(worst <= OFFSET for law, (_, worst) in offsets.items() if law != FEEDFORWARD), because
    )


def _limits(evidence: Evidence) -> CheckOutcome:
    (low, high), *others = (
        [evidence.measured(curve, test, metric) for metric in ("min_jacket", "max_jacket")]
        for curve, test in ((ON_ITS_MODEL, "same_model"), (ON_ITS_MODEL, "profile"), (Curve(OBSERVER), "profile"))
    )
    other, learnt = (f"{least:.2f} to {most:.2f}" for least, most in others)
    measured = (
        f"{low:.2f} to {high:.2f} °C where the model is the plant; on the reactor {other}, with observers {learnt}"
    )
    holds = low >= 20.0 - ROUNDING and high <= 70.0 + ROUNDING
    return CheckOutcome(measured, holds, "the limits are those of the model's jacket, so they hold as it does")


def _monotone(evidence: Evidence) -> CheckOutcome:
    """The gain of the throttle in each mode, at every rule; between two it lies between their values."""
    gains = {mode: theta[2] for mode, theta in zip(MODES, FuzzyBatchReactor().consequents(), strict=True)}
    shown = ", ".join(f"{mode} {min(b):g} to {max(b):g}" for mode, b in gains.items())
    holds = all(min(b) > 0 or max(b) < 0 for b in gains.values())
    return CheckOutcome(f"gain of the throttle [°C]: {shown}", holds, "no mode's gain changes its sign")


# ---------------------------------------------------------------- beyond the requirements
def _followed(evidence: Evidence) -> CheckOutcome:
    return replace(_ideal(evidence), because="")


def _on_reactor(evidence: Evidence, metric: str, *ways: str) -> dict[str, float]:
    """A figure of the feedforward on the reactor over some of the identifications."""
    return {how: evidence.measured(Curve(FEEDFORWARD, {"part": how}), "profile", metric) for how in ways}


def _identified(evidence: Evidence) -> CheckOutcome:
    errors = _on_reactor(evidence, "tail_rms", "tied", "global", "local", "printed")
    shown = ", ".join(f"{how} {number(v)}" for how, v in errors.items())
    return CheckOutcome(f"{shown} °C", all(better < worse for better, worse in pairwise(errors.values())))


def _quiet(evidence: Evidence) -> CheckOutcome:
    """Switches over each identification; where there are too many, the levels that a shut throttle cannot hold."""
    switches = _on_reactor(evidence, "switches", "tied", "global", "local")
    noisy = [how for how, v in switches.items() if v > min(switches.values()) + MORE]
    drifts = {(how, level): drift_when_shut(evidence, how, level) for how in noisy for _, level in RECIPE}
    reasons = [
        f"{how}: at {level:g} °C a shut throttle moves the jacket by {hot:+.2f} °C a period in mode hot and "
        f"{cold:+.2f} in mode cold, so the modes alternate"
        for (how, level), (hot, cold) in drifts.items()
        if hot > ROUNDING and cold < -ROUNDING
    ]
    return CheckOutcome(", ".join(f"{how} {v:g}" for how, v in switches.items()), not noisy, "; ".join(reasons))


def _dearer(evidence: Evidence) -> CheckOutcome:
    forms = [Curve(OBSERVER, {"switch_penalty": p}) for p in PENALTIES]
    counts = [evidence.measured(curve, "same_model_noise", "switches") for curve in forms]
    holds = all(a > b for a, b in pairwise(counts))
    return CheckOutcome(", ".join(f"{v:g}" for v in counts), holds, "on same_model with noise")


CLAIMS = Claims(
    reason=plain_reason,
    statements=(
        Check("feedforward follows its adjusted reference ideally where the model is the plant", _ideal),
        Check("a simple feedback part is enough where it is not", _feedback),
        Check("the jacket stays between 20 and 70 degC", _limits),
        Check("an extreme input gives an extreme output in each mode", _monotone),
    ),
    acceptance=(
        Check("feedforward on its own model, core against adjusted reference", _followed, f"≤ {IDEAL:g} °C"),
        Check("feedforward's tail RMS on the reactor", _identified, "tied least, then global, local and printed"),
        Check(
            "feedforward's switches on the reactor, by identification", _quiet, f"at most {MORE} more than the least"
        ),
        Check(
            f"{law_name(OBSERVER)}, switches over the penalty {', '.join(f'{p:g}' for p in PENALTIES)}",
            _dearer,
            "fewer with each",
        ),
        Check(
            "one-step error of each identification", one_step_errors, "tied at most 1.25 × global's, and below local's"
        ),
        Check(
            "temperatures that neither mode reaches", gaps, "none with ties across the modes, some in every other model"
        ),
        Check(
            f"authority of the cold valve at {COLDEST:g} °C", weak_cold_valve, "printed at most half of the reactor's"
        ),
        step_within(80.0, *LAWS),
        faster_than_nmpc(20.0, "profile", "profile", *LAWS),
    ),
)
