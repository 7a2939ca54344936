"""The jacketed batch reactor: checks of what its paper states, and of its models and laws.

Source of the claims: [karer, sections 4.2, 5 and 6].
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from pipeline.cases.jacketed_batch_reactor.case import FEEDFORWARD, OBSERVER, PI, PRINTED, RECIPE, ROUNDING
from pipeline.cases.jacketed_batch_reactor.fuzzy_models import (
    coefficients_picture,
    cold_authority,
    drift_when_shut,
    one_step_errors_as,
    printed_gap,
    reach_picture,
    ties_close_the_gap,
)
from pipeline.cases.jacketed_batch_reactor.fuzzy_plant import MODES, FuzzyBatchReactor
from pipeline.cases.jacketed_batch_reactor.pictures import AHEAD, offsets_picture, recipe_picture, switches_picture
from pipeline.evaluation.case import Curve
from pipeline.evaluation.evidence import Evidence
from pipeline.evaluation.timing import faster_than_nmpc, step_within
from pipeline.evaluation.verdicts import CasePicture, Claim, Claims, Verdict, plain_reason
from pipeline.pictures.words import law_name, number

SET = "hybrid_fuzzy"
IDEAL = 1e-12  # [deg C] of rounding
OFFSET = 0.05  # [deg C]
PENALTIES = (0.0, 0.1, 0.3, 0.6)
# Of the feedforward on the reactor, over each identification: [deg C] tail RMS, and switches of the mode.
EXPECTED = {"tied": 0.23, "global": 0.63, "local": 1.84, "printed": 2.24}
SWITCHES = {"tied": 6, "global": 6, "local": 8}
WITHIN = 0.25
MORE = 2  # switches: there and back
LAWS = (FEEDFORWARD, PI, OBSERVER)


def _missing(what: str = "", limit: str = "") -> Verdict:
    return Verdict(what, limit, "not measured", None)


def _ideal(evidence: Evidence) -> Verdict:
    """The core against the reference that was adjusted for it two samples before."""
    loop, law = evidence.loop(Curve(FEEDFORWARD, PRINTED), "same_model"), evidence.laws.get(FEEDFORWARD)
    names = () if law is None else law.info(PRINTED)
    if loop is None or "adjusted_reference" not in names:
        return _missing()
    adjusted = loop["info"][:, names.index("adjusted_reference")]
    error = float(np.abs(adjusted[:-AHEAD] - loop["pv"][AHEAD:, 0]).max())
    wanted, reached = (loop["info"][:, names.index(n)] for n in ("wanted_jacket", "reached_jacket"))
    moved = np.count_nonzero(np.abs(wanted - reached) > ROUNDING)
    measured = f"largest distance {error:.1e} °C; {moved} of {len(wanted)} jacket references were adjusted"
    return Verdict("", "", measured, error <= IDEAL, f"ideal is what rounding leaves, {IDEAL:g} °C")


def _feedback(evidence: Evidence) -> Verdict:
    shown, holds = [], True
    for law in LAWS:
        mean, worst = (evidence.figure(law, "theta_10_noise", metric) for metric in ("masse", "max_asse"))
        if mean is None or worst is None:
            return _missing()
        shown.append(f"{law_name(law)} {number(mean, 2)} ({number(worst, 2)})")
        holds &= law == FEEDFORWARD or worst <= OFFSET
    because = (
        "mean (largest) offset [°C] with the jacket's coefficients off by up to 10 % and noise, each law over the tied "
        f"model; enough is at most {OFFSET:g}"
    )
    return Verdict("", "", ", ".join(shown), holds, because)


def _limits(evidence: Evidence) -> Verdict:
    found = [evidence.figure(FEEDFORWARD, "same_model", m, PRINTED) for m in ("min_jacket", "max_jacket")]
    off = [evidence.figure(FEEDFORWARD, "profile", m, PRINTED) for m in ("min_jacket", "max_jacket")]
    observed = [evidence.figure(OBSERVER, "profile", m) for m in ("min_jacket", "max_jacket")]
    known = [[v for v in row if v is not None] for row in (found, off, observed)]
    if any(len(row) < 2 for row in known):
        return _missing()
    same, other, learnt = (f"{row[0]:.2f} to {row[1]:.2f}" for row in known)
    measured = f"{same} °C where the model is the plant; on the reactor {other}, with observers {learnt}"
    holds = known[0][0] >= 20.0 - ROUNDING and known[0][1] <= 70.0 + ROUNDING
    return Verdict("", "", measured, holds, "the limits are those of the model's jacket, so they hold as it does")


def _monotone(evidence: Evidence) -> Verdict:
    """The gain of the throttle in each mode, at every rule; between two it lies between their values."""
    gains = {mode: theta[2] for mode, theta in zip(MODES, FuzzyBatchReactor().consequents(), strict=True)}
    shown = ", ".join(f"{mode} {min(b):g} to {max(b):g}" for mode, b in gains.items())
    holds = all(min(b) > 0 or max(b) < 0 for b in gains.values())
    return Verdict("", "", f"gain of the throttle [°C]: {shown}", holds, "no mode's gain changes its sign")


# ---------------------------------------------------------------- beyond the requirements
def _identified(evidence: Evidence) -> Verdict:
    what = "feedforward's tail RMS on the reactor, by identification"
    limit = ", ".join(f"{how} {number(v)}" for how, v in EXPECTED.items()) + f" °C, each within {WITHIN:.0%}"
    known = _by_identification(evidence, "tail_rms", EXPECTED)
    if known is None:
        return _missing(what, limit)
    holds = all(abs(known[how] - v) <= WITHIN * v for how, v in EXPECTED.items())
    return Verdict(what, limit, ", ".join(f"{how} {number(v)}" for how, v in known.items()) + " °C", holds)


def _quiet(evidence: Evidence) -> Verdict:
    """Switches over each identification; where there are too many, the levels that a shut throttle cannot hold."""
    what = "feedforward's switches on the reactor, by identification"
    limit = ", ".join(f"{how} {v}" for how, v in SWITCHES.items()) + f", each at most {MORE} more"
    known = _by_identification(evidence, "switches", SWITCHES)
    if known is None:
        return _missing(what, limit)
    noisy = [how for how, v in known.items() if v > SWITCHES[how] + MORE]
    reasons = []
    for how in noisy:
        for _, level in RECIPE:
            hot, cold = drift_when_shut(evidence, SET, how, level) or (0.0, 0.0)
            if hot > ROUNDING and cold < -ROUNDING:
                drifts = f"by {hot:+.2f} °C a period in mode hot and {cold:+.2f} in mode cold"
                reasons.append(
                    f"{how}: at {level:g} °C a shut throttle moves the jacket {drifts}, so the modes alternate"
                )
    because = "; ".join(reasons)
    return Verdict(what, limit, ", ".join(f"{how} {v:g}" for how, v in known.items()), not noisy, because)


def _by_identification(evidence: Evidence, metric: str, which: Iterable[str]) -> dict[str, float] | None:
    """A figure of the feedforward on the reactor over each of the identifications; None unless all are known."""
    rows = {how: evidence.figure(FEEDFORWARD, "profile", metric, {"part": how}) for how in which}
    known = {how: value for how, value in rows.items() if value is not None}
    return known if len(known) == len(rows) else None


def _dearer(evidence: Evidence) -> Verdict:
    what = f"{law_name(OBSERVER)}, switches over the penalty {', '.join(f'{p:g}' for p in PENALTIES)}"
    limit = "fewer with each"
    found = [evidence.figure(OBSERVER, "same_model_noise", "switches", {"switch_penalty": p}) for p in PENALTIES]
    counts = [v for v in found if v is not None]
    if len(counts) < len(PENALTIES):
        return _missing(what, limit)
    holds = all(a > b for a, b in pairwise(counts))
    return Verdict(what, limit, ", ".join(f"{v:g}" for v in counts), holds, "on same_model with noise")


def _followed(evidence: Evidence) -> Verdict:
    found = _ideal(evidence)
    what, limit = "feedforward on its own model, core against adjusted reference", f"≤ {IDEAL:g} °C"
    return Verdict(what, limit, found.measured, found.holds)


NOISY = {"profile_noise": "on the reactor", "same_model_noise": "on the printed model"}
OFF = {
    "profile_noise": "reactor",
    "theta_10_noise": "printed model,\njacket off by 10 %",
    "theta_20_noise": "printed model,\njacket off by 20 %",
    "held_out_noise": "random recipes\non the reactor",
}
CLAIMS = Claims(
    reason=plain_reason,
    statements=(
        Claim("feedforward follows its adjusted reference ideally where the model is the plant", _ideal),
        Claim("a simple feedback part is enough where it is not", _feedback),
        Claim("the jacket stays between 20 and 70 degC", _limits),
        Claim("an extreme input gives an extreme output in each mode", _monotone),
    ),
    acceptance=(
        _followed,
        _identified,
        _quiet,
        _dearer,
        one_step_errors_as(SET, {"tied": 0.076, "global": 0.070, "local": 0.18}),
        ties_close_the_gap(SET),
        printed_gap(SET, 1.4),
        cold_authority(SET, 20.0, 3.6),
        step_within(80.0, *LAWS),
        faster_than_nmpc(20.0, "profile", "profile", *LAWS),
    ),
    pictures=(
        CasePicture(
            "recipe_same_model",
            "The recipe by feedforward on the printed model itself",
            recipe_picture(Curve(FEEDFORWARD, PRINTED), "same_model"),
        ),
        CasePicture(
            "recipe_reactor",
            "The recipe on the reactor with noise, by a tied model with offset observers",
            recipe_picture(Curve(OBSERVER), "profile_noise"),
        ),
        CasePicture("offsets", "Offset where the model is not the plant, with noise", offsets_picture(LAWS, OFF)),
        CasePicture(
            "switches", "What a price on switching does, with noise", switches_picture(OBSERVER, PENALTIES, NOISY)
        ),
        CasePicture("reach", "What the modes reach under each identification", reach_picture(SET)),
        CasePicture("coefficients", "Coefficients beside the reactor's", coefficients_picture(SET)),
    ),
)
