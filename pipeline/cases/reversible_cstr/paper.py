"""The reversible CSTR: checks of the paper's claims, of the trained laws and of the reference models.

Source of the claims: [reference_ann, sections "Optimal Models for Model Reference Control",
"ANN Controller Design" and "Simulation Result and Discussion"].
"""

from __future__ import annotations

import numpy as np

from loopwright.pipeline.cases.reversible_cstr.case import NETWORK, ON_TEST, PI, PLAIN, PRINTED, PRINTED_SIGN, TUNED
from loopwright.pipeline.cases.reversible_cstr.pictures import beats_the_classic_tables
from loopwright.pipeline.cases.reversible_cstr.plant import R, ReversibleCstr
from loopwright.pipeline.evaluation.case import Curve
from loopwright.pipeline.evaluation.closed_loop import overshoots
from loopwright.pipeline.evaluation.evidence import Evidence, NotMeasuredError
from loopwright.pipeline.evaluation.law_evidence import Array
from loopwright.pipeline.evaluation.verdicts import Check, CheckOutcome, Claims, plain_reason, step_within
from loopwright.pipeline.pictures.model_pictures import free_run_fit_at_least, one_step_says_little
from loopwright.pipeline.pictures.numbers import number

SET = "plant_network"
ALMOST = 0.95  # of the feed: what "almost complete" asks for
RISE = 20.0  # K above the feed: more is a temperature that rises without end
OVERSHOOT = 0.05  # of a step: what deserves the name; the reference model itself has 0.028
OFFSET = 2e-4  # mol/l
SATURATED = 0.5  # of the samples


# ---------------------------------------------------------------- the plant
def _at_rest(evidence: Evidence) -> tuple[ReversibleCstr, Array, Array]:
    """The plant, and its steady states within the MV's range: C_B [mol/l] (n,) and T [K] (n,)."""
    plant = evidence.case.equations
    assert isinstance(plant, ReversibleCstr)
    mv, (cvs, xs, mvs) = plant.mv_signals[0], plant.steady_curve
    inside = (mvs >= mv.low) & (mvs <= mv.high)
    return plant, cvs[inside], xs[inside, 1]


def _conversion(evidence: Evidence) -> CheckOutcome:
    plant, cvs, temperatures = _at_rest(evidence)
    mv, t = plant.mv_signals[0], np.array([temperatures.min(), temperatures.max()])
    forward, back = plant.k1 * np.exp(-plant.E1 / (R * t)), plant.k2 * np.exp(-plant.E2 / (R * t))
    there = np.sort(forward / (forward + back)) * plant.C_t
    most = float(cvs.max())
    measured = (
        f"at most {most:.3f} mol/l of {plant.C_t:g} with {mv.name} from {mv.low:.3g} to {mv.high:g} {mv.unit}; the "
        f"reaction itself is in equilibrium at {there[0]:.2f} to {there[1]:.2f} mol/l"
    )
    return CheckOutcome(measured, most >= ALMOST * plant.C_t, f"almost complete is {100 * ALMOST:g} % and more")


def _temperature(evidence: Evidence) -> CheckOutcome:
    plant, _, temperatures = _at_rest(evidence)
    low, high = float(temperatures.min()), float(temperatures.max())
    most = plant.beta * plant.C_t
    measured = (
        f"full conversion warms the feed by {most:.1f} K; with the heat loss the reactor rests at {low:.0f} to "
        f"{high:.0f} K, the feed at {plant.T_in:g} K"
    )
    return CheckOutcome(measured, max(most, high - plant.T_in) > RISE)


# ---------------------------------------------------------------- the loops
def _figures(evidence: Evidence, scenario: str, metric: str, *curves: Curve) -> list[float]:
    return [evidence.measured(curve, scenario, metric) for curve in curves]


def _sign(evidence: Evidence) -> CheckOutcome:
    offset, settled = _figures(evidence, "levels", "max_asse", PRINTED_SIGN, PRINTED)
    loop = evidence.loop(PRINTED_SIGN, "levels")
    if loop is None:
        raise NotMeasuredError
    mv = evidence.case.plant_class.mv_signals[0]
    near = 1e-6 * (mv.high - mv.low)
    u = loop["mv"][:, 0]
    share = float(np.mean((u <= mv.low + near) | (u >= mv.high - near)))
    measured = (
        f"with +3.15 {mv.name} is at an end of its range in {100 * share:.0f} % of the samples, end offset up to "
        f"{number(offset)} mol/l; with -3.15 up to {number(settled, 2)}"
    )
    cvs, _, mvs = evidence.case.equations.steady_curve
    gains = np.gradient(cvs, mvs)[(mvs >= mv.low) & (mvs <= mv.high)]
    because = f"the plant's gain lies between {gains.min():.2f} and {gains.max():.2f} mol/l per {mv.unit}"
    return CheckOutcome(measured, share < SATURATED and offset <= settled, because)


def _overshoot(evidence: Evidence) -> CheckOutcome:
    network, pid = _figures(evidence, "levels", "overshoot", NETWORK, PRINTED)
    measured = f"mean overshoot on the levels: network {100 * network:.1f} % of the step, PID {100 * pid:.1f} %"
    (test,) = evidence.tests["levels"]
    if test.reference is None:
        raise NotMeasuredError
    sp = evidence.case.plant.sp_signals[0]
    reference = np.mean(overshoots(test.sp[:, 0], test.reference[:, 0], test.hold, sp.high - sp.low))
    because = f"the reference model's own is {100 * reference:.1f} %"
    return CheckOutcome(measured, network <= OVERSHOOT < pid, because)


def _hotter(evidence: Evidence) -> CheckOutcome:
    errors = _figures(evidence, "tin", "iae", NETWORK, PRINTED, PI, TUNED)
    network, pid, pi, tuned = map(number, errors)
    because = f"PI control tuned for its loop is quicker still: {pi} on the reference model, {tuned} without one"
    holds = errors[0] < errors[1]
    return CheckOutcome(f"IAE {network} against {pid} mol/l s", holds, because if max(errors[2:]) < errors[0] else "")


def _heat(evidence: Evidence) -> CheckOutcome:
    network, pid = _figures(evidence, "dh", "iae", NETWORK, PRINTED)
    loop = evidence.loop(PRINTED, "dh")
    if loop is None:
        raise NotMeasuredError
    most = float(np.abs(loop["sp"][:, 0] - loop["pv"][:, 0]).max())
    measured = f"IAE {number(network)} against {number(pid)} mol/l s; C_B moves by {most:.1g} mol/l at most"
    because = "heat is a small matter here: slower reactions and a larger heat loss are tested beside it"
    return CheckOutcome(measured, network > pid, because)


def _no_memory(evidence: Evidence) -> CheckOutcome:
    plain, network = _figures(evidence, "levels", "max_asse", PLAIN, NETWORK)
    measured = f"end offset up to {number(plain, 2)} mol/l; of the incremental network {number(network, 2)}"
    because = "both errors are zero only where the one MV that it then gives is the steady one"
    return CheckOutcome(measured, plain <= OFFSET, because)


def _ahead(evidence: Evidence) -> CheckOutcome:
    tests = {"levels": "levels", "held_out": "random levels", "held_out_noise": "with noise"}
    errors = {words: _figures(evidence, test, "tracking", NETWORK, PI) for test, words in tests.items()}
    shown = ", ".join(f"{words} {number(ours, 2)} against {number(pi, 2)}" for words, (ours, pi) in errors.items())
    holds = all(ours < pi for ours, pi in errors.values())
    return CheckOutcome(f"RMS from the reference model [mol/l]: {shown}", holds, _other_side(evidence))


def _other_side(evidence: Evidence) -> str:
    """Where controllers with fixed gains are ahead, and how near a PI comes that is tuned on the scored levels."""
    tests = {"tin": "hotter feed", "k": "slower reactions", "ua": "heat loss"}
    errors = {words: _figures(evidence, test, "iae", PI, NETWORK) for test, words in tests.items()}
    faster = [f"{words} {number(pi, 2)} against {number(own, 2)}" for words, (pi, own) in errors.items() if pi < own]
    rows = (
        [f"but the PI is ahead after disturbances without noise, IAE [mol/l s]: {', '.join(faster)}"] if faster else []
    )
    tuned, network = _figures(evidence, "levels", "iae", TUNED, NETWORK)
    if tuned < network:
        rows.append(
            "and a PID tuned for the set point alone, which follows no model, arrives sooner: IAE "
            f"{number(tuned)} against {number(network)} on the levels"
        )
    nearest = evidence.figure(ON_TEST.law, "levels", "tracking", ON_TEST.setting)
    if nearest is not None:
        rows.append(f"a PI tuned on the levels themselves leaves {number(nearest, 2)} there")
    return "; ".join(rows)


def _one_step(evidence: Evidence) -> CheckOutcome:
    outcome = one_step_says_little(SET, "nnarx", "C_B", "mol/l", evidence)
    return CheckOutcome(outcome.measured, not outcome.holds, outcome.because)


# ---------------------------------------------------------------- what is asked for
def _no_other_root(evidence: Evidence) -> CheckOutcome:
    roots, least, largest = (
        evidence.measured(NETWORK, "", figure) for figure in ("other_roots", "least_gain", "largest_gain")
    )
    measured = f"{roots:.0f} over a grid; gain on a constant error {least:.3g} to {largest:.3g} l/s per mol/l"
    return CheckOutcome(measured, roots == 0, "its form leaves no room for one")


CLAIMS = Claims(
    reason=plain_reason,
    statements=(
        Check("feedback brings the reaction almost to complete conversion", _conversion),
        Check("the temperature of the open loop rises without end", _temperature),
        Check("the best PID setting has Kc = +3.15", _sign),
        Check("the network follows random set points without overshoot, the PID overshoots", _overshoot),
        Check("under a hotter feed the network returns sooner than the PID", _hotter),
        Check("with a 20 % change of the heat of reaction the network is far slower than the PID", _heat),
        Check("a network of two errors needs no integral action", _no_memory),
        Check("a network follows set points better than a controller with fixed gains", _ahead),
        Check("a small one-step error makes a good plant model", _one_step),
        Check("a random search finds better reference models than the tables in use", beats_the_classic_tables),
    ),
    acceptance=(
        free_run_fit_at_least(99.0, SET, "state_space", "C_B", "T"),
        Check("incremental network at rest: roots of its move beside zero error", _no_other_root, "none"),
        Check(
            "ITAE of the reference models that the random neighbourhood search found",
            beats_the_classic_tables,
            "below the classic table's for every order from 2",
        ),
        step_within(80.0, "model_reference"),
    ),
)
