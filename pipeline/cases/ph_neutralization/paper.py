"""The pH neutralization: why a figure may differ from the paper's, and checks of its claims.

Source of the claims: [chen2004, sections 2.1 and 5.1].
"""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.cases.ph_neutralization.case import ADAPTIVE, FIXED, LINEARIZED, RECURSIVE, SELF_TUNING
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
from loopwright.pipeline.pictures.loop_pictures import LONGEST_PID_TIME
from loopwright.pipeline.pictures.numbers import number, ratio
from loopwright.pipeline.pictures.words import curve_label

SET, DISTURBED = "set_point", "disturbance"
PENALTY_1, PENALTY_LOW = (Curve("linearized_pid", {"penalty": value}) for value in (1.0, 0.4))
RECURSIVE_1 = Curve("recursive_pid", {"penalty": 1.0})
# pH -> base flow [ml/min] of the nominal steady state
FLOWS = {7.0: 933.0, 8.0: 991.0, 9.0: 1020.5}
FLOW_ERROR = 0.5  # [ml/min]
PRINTED = (990.0, 1020.0)  # [ml/min] ends of the paper's disturbance
SLOW = 2.0  # times the SSE with a penalty of 1
NEEDED = 0.9
OVERSHOOT = 0.10  # of a step: less does not count as overshoot
UNPRINTED = "the first and smallest penalty, its thresholds and the sampling period"
REST = 0.05  # [pH] of steady error: a loop that comes to rest has less


# ---------------------------------------------------------------- why a figure differs
def reason(row: PaperFigure, ours: float, evidence: Evidence) -> str:
    """The words for a figure of Tables 1 and 3 that does not reproduce, by what was measured."""
    plain, spread = plain_reason(row, ours, evidence), _spread(row, evidence)
    if not row.scenario and "recursive" in row.metric:
        return f"{plain}: a recursive model that forgets fast depends on its starting values, which are not printed"
    if not row.scenario:
        unknown = "the paper prints neither the training data nor the weights"
        return f"{plain}: this is the error of the network, and {unknown}{spread}"
    if row.law == "self_tuning_pid":
        bound = evidence.bound(row.scenario)
        beside = "" if bound is None else f" and gives {ratio(ours / bound)} × the perfect NMPC's {number(bound)}"
        return f"{plain}: the paper does not print its tuning; ours is from development sequences{beside}{spread}"
    one = evidence.figure(row.law, row.scenario, "sse", {"penalty": 1.0})
    if row.law == "recursive_pid":
        unknown, kind = "the paper prints neither the forgetting factor nor the starting model", "a"
    else:
        unknown, kind = f"the paper does not print {UNPRINTED}, and the figure is sensitive to them", "a fixed"
    at_one = "" if one is None else f"; with {kind} penalty of 1 it is {number(one)}"
    return f"{plain}: {unknown}{at_one}{spread}"


def _spread(row: PaperFigure, evidence: Evidence) -> str:
    low, high = (evidence.figure(row.law, row.scenario, row.metric, row.setting, how) for how in ("min", "max"))
    if low is None or high is None or low == high:
        return ""
    words = f"; our networks give {number(low)} to {number(high)}"
    return words + (", and the paper's lies between" if low <= row.paper <= high else "")


# ---------------------------------------------------------------- the paper's claims
def _compared(evidence: Evidence, scenario: str, *curves: Curve) -> tuple[list[float], str]:
    """SSE of some controllers over a test, and the words for them."""
    values = [evidence.measured(curve, scenario, "sse") for curve in curves]
    shown = (f"{curve_label(evidence, curve)} {number(v)}" for curve, v in zip(curves, values, strict=True))
    return values, f"SSE on {scenario}: {', '.join(shown)}"


def _fixed(evidence: Evidence) -> CheckOutcome:
    overshoot = evidence.measured(FIXED, SET, "overshoot")
    (rule, tuned, adaptive), shown = _compared(evidence, SET, FIXED, Curve("pid"), ADAPTIVE)
    ahead = [words for words, sse in (("by the rule", rule), ("tuned in closed loop", tuned)) if sse < adaptive]
    because = f"the PID {' and '.join(ahead)} has a lower SSE than the adaptive form" if ahead else ""
    return CheckOutcome(f"overshoot {100 * overshoot:.0f} % of the step; {shown}", overshoot > OVERSHOOT, because)


def _slow(evidence: Evidence) -> CheckOutcome:
    (slow, one), shown = _compared(evidence, SET, LINEARIZED, PENALTY_1)
    return CheckOutcome(shown, slow > SLOW * one, f"slow means an SSE above {SLOW:g} × that with a penalty of 1")


def _adaptive(evidence: Evidence) -> CheckOutcome:
    forms = (ADAPTIVE, PENALTY_1, PENALTY_LOW)
    measured = [c for c in forms if evidence.figure(c.law, SET, "sse", c.setting) is not None]
    if len(measured) < 2:
        raise NotMeasuredError
    (adaptive, *fixed), shown = _compared(evidence, SET, *measured)
    _, disturbed = _compared(evidence, DISTURBED, *measured)
    because = f"needed means an SSE below {NEEDED:g} × that of the best fixed penalty"
    return CheckOutcome(f"{shown}; {disturbed}", adaptive < NEEDED * min(fixed), because)


def _ahead_of_recursive(evidence: Evidence) -> CheckOutcome:
    pairs = ((PENALTY_1, RECURSIVE_1), (ADAPTIVE, RECURSIVE))
    compared = [_compared(evidence, SET, *pair) for pair in pairs]
    holds = all(ours < other for (ours, other), _ in compared)
    return CheckOutcome(
        "; ".join(shown for _, shown in compared), holds, "first with equal penalties, then as in Table 3"
    )


def _ahead_of_self_tuning(evidence: Evidence) -> CheckOutcome:
    (other, adaptive, fixed), shown = _compared(evidence, SET, SELF_TUNING, ADAPTIVE, PENALTY_1)
    best = "; the self-tuning PID also beats the fixed penalty of 1" if other < fixed else ""
    return CheckOutcome(shown, adaptive < other, f"the paper's form has the adaptive penalty{best}")


def _unstable(evidence: Evidence) -> CheckOutcome:
    shown, holds = [], False
    for curve in (RECURSIVE, RECURSIVE_1):
        sse, steady = (evidence.measured(curve, DISTURBED, metric) for metric in ("sse", "max_asse"))
        holds |= steady > REST
        penalty = f"penalty {curve.setting['penalty']:g}"
        shown.append(f"{penalty}: SSE {number(sse)}, steady error {number(steady, 2)}")
    return CheckOutcome("; ".join(shown), holds, f"a stable loop has a steady error below {REST:g} pH")


def _buffer_flow(evidence: Evidence) -> CheckOutcome:
    """How far the printed disturbance would move pH, as one of the buffer's flow and as one of the acid's."""
    plant = evidence.case.equations
    _, mv = plant.steady_state_at(8.0)

    def rest(name: str, flow: float) -> float:
        changed = plant.with_parameters({name: flow})
        (state,) = changed.steady_states(float(mv[0]))
        return float(changed.measure(state)[0])

    low, high = PRINTED
    moved = {name: abs(rest(name, high) - rest(name, low)) for name in ("q2", "q1")}
    measured = (
        f"with the base flow held, a step from {low:g} to {high:g} ml/min moves pH by {moved['q2']:.2g} as buffer flow "
        f"and by {moved['q1']:.2g} as acid flow"
    )
    nominal = dict(zip(plant.parameter_names(), plant.parameters(), strict=True))
    because = (
        f"the nominal acid flow is {nominal['q1']:g} ml/min, the buffer flow {nominal['q2']:g}; we test it as acid flow"
    )
    return CheckOutcome(measured, moved["q2"] > evidence.noise, because)


def _at_bounds(evidence: Evidence) -> CheckOutcome:
    """The share of samples in which the best move needs a negative gain: a bound is active there."""
    _, info = evidence.info(ADAPTIVE, SET, "kc", "tau_i_s", "tau_d_s")
    too_long = info["tau_i_s"] > LONGEST_PID_TIME * evidence.case.plant.period_s
    share = float(np.mean((info["kc"] <= 0) | too_long | (info["tau_d_s"] <= 0)))
    because = "without bounds, many settings give the same move; the law takes the one with the smallest change"
    return CheckOutcome(f"a bound is active in {100 * share:.0f} % of the samples on {SET}", share > 0, because)


# ---------------------------------------------------------------- the plant itself
def _flows(evidence: Evidence) -> CheckOutcome:
    flows = {ph: float(evidence.case.equations.steady_state_at(ph)[1][0]) for ph in FLOWS}
    holds = all(abs(flows[ph] - flow) <= FLOW_ERROR for ph, flow in FLOWS.items())
    return CheckOutcome(", ".join(f"{flow:.1f}" for flow in flows.values()), holds)


def _one_step_order(evidence: Evidence) -> CheckOutcome:
    names = ("nnarx", "linearized", "recursive_0.8", "recursive_0.5")
    values = [evidence.measured("identification_example", "", f"one_step.{name}") for name in names]
    white = [evidence.figure("identification_example", "", f"one_step_white.{name}") for name in names]
    shown = (" < " if values == sorted(values) else ", ").join(map(number, values))
    whites = ", ".join(number(v) for v in white if v is not None)
    other = f"; with a white input, in the same order: {whites}" if None not in white else ""
    return CheckOutcome(f"SSE {shown}", values == sorted(values), f"with a smooth input{other}")


CLAIMS = Claims(
    reason=reason,
    statements=(
        Check("the PID with fixed settings overshoots and oscillates", _fixed),
        Check("a fixed penalty of 20 is slow", _slow),
        Check("the adaptive penalty is needed", _adaptive),
        Check("the linearized PID is ahead of the recursive one", _ahead_of_recursive),
        Check("the linearized PID is ahead of the self-tuning one", _ahead_of_self_tuning),
        Check("the recursive PID is unstable under disturbances", _unstable),
        Check("the disturbance is one of the buffer's flow", _buffer_flow),
        Check("the best settings without bounds are negative", _at_bounds),
    ),
    acceptance=(
        Check(
            f"base flow at pH {', '.join(f'{ph:g}' for ph in FLOWS)}",
            _flows,
            ", ".join(f"{flow:g}" for flow in FLOWS.values()) + f" within {FLOW_ERROR:g} ml/min",
        ),
        Check("identification example, order of the one-step errors", _one_step_order, "as in Table 1"),
        step_within(80.0, "linearized_pid"),
        faster_than_nmpc(20.0, SET, SET, "linearized_pid"),
    ),
)
