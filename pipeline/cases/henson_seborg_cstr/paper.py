"""The coolant-held CSTR: checks of the paper's claims, of its stability evidence and of its speed.

Source of the claims: [gao2002, sections IV and V].
"""

from __future__ import annotations

import numpy as np
from scipy import optimize

from loopwright.pipeline.cases.henson_seborg_cstr.case import ALONE, AUTO, FAST, GAINS, PID_1, TUNED
from loopwright.pipeline.evaluation.case import Curve
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
from loopwright.pipeline.plants.equations import EquationPlant
from loopwright.pipeline.plants.steady import Linearization

SET = "local_models"
SMALL = 0.10  # of a step: an overshoot that deserves the name
HIGH_FIT, HIGH_STEADY = 98.0, 0.02  # what "high accuracy" asks for: fit of every state [%], relative steady error
WORTH = 2.0  # [%] of fit: what another network has to be ahead to be worth it
PRINTED_HOPF = (0.13566, 110.8)  # mol/l, l/min
NEAR = 0.01
PRINTED_QC_2, ROUNDED = 98.899, 5e-4  # l/min, and what its last digit leaves open
FITS = {"fit_C": 96.0, "fit_T": 98.0}
RADIUS = 0.98
RECOVERED = 0.99
MARGINS = (("PID 1", PID_1), ("a PID tuned in closed loop", TUNED), ("one knob", AUTO), ("wc = 7", FAST))
TESTS = ("up", "down", "jump", "jump_down", "feed_temperature", "feed_concentration", "held_out")
ULTIMATE = 1e12  # [l^2/(min mol)] the largest gain that is tried
BOTH = (GAINS, AUTO)


# ---------------------------------------------------------------- the paper's claims
def _overshoot(evidence: Evidence) -> CheckOutcome:
    last, most = (evidence.measured(GAINS, "up", f"overshoot_{which}") for which in ("last", "max"))
    measured = f"{100 * last:.1f} % of the step to 0.13 mol/l; up to {100 * most:.0f} % on the way"
    return CheckOutcome(measured, last <= SMALL, f"small is up to {100 * SMALL:g} %")


def _accuracy(evidence: Evidence) -> CheckOutcome:
    names = ("staircase.fit_C", "staircase.fit_T", "staircase.largest_error", "steady_error", "random.fit_C")
    fit_c, fit_t, largest, steady, drawn = (evidence.measured(SET, "", name) for name in names)
    measured = (
        f"staircase: fit {fit_c:.1f} % (C), {fit_t:.1f} % (T), largest error {largest:.2g} mol/l; random levels: fit "
        f"{drawn:.1f} % (C); steady error between the points to {100 * steady:+.1f} %"
    )
    holds = min(fit_c, fit_t) >= HIGH_FIT and abs(steady) <= HIGH_STEADY
    return CheckOutcome(measured, holds, f"high is {HIGH_FIT:g} % and {100 * HIGH_STEADY:g} % of steady error")


def _five(evidence: Evidence) -> CheckOutcome:
    fits = {int(n): float(v) for n, v in (evidence.part(SET, SET).get("sizes") or {}).items()}
    if 5 not in fits or len(fits) < 3:
        raise NotMeasuredError
    fewer, more = ([v for n, v in fits.items() if (n - 5) * side > 0] for side in (-1, 1))
    holds = bool(fewer and more) and fits[5] - max(fewer) > WORTH and max(more) - fits[5] < WORTH
    measured = "fit of C on the staircase " + ", ".join(f"{n}: {v:.1f} %" for n, v in sorted(fits.items()))
    return CheckOutcome(measured, holds, f"points at equal distances of q_c; {WORTH:g} % of fit are worth a model more")


def _hopf(evidence: Evidence) -> CheckOutcome:
    plant = evidence.case.equations
    at = hopf_point(plant)
    measured = f"the eigenvalues cross the imaginary axis at C = {at[0]:.5f} mol/l, q_c = {at[1]:.2f} l/min"
    holds = all(abs(ours - printed) <= NEAR * printed for ours, printed in zip(at, PRINTED_HOPF, strict=True))
    stable = plant.linearize(*plant.steady_state_at(PRINTED_HOPF[0])).eigenvalues[0].real < 0
    because = f"within {100 * NEAR:g} %; the printed point is {'still a stable' if stable else 'an unstable'} one"
    return CheckOutcome(measured, holds, because)


def hopf_point(plant: EquationPlant) -> tuple[float, float]:
    """(C, q_c) where the ignited branch loses its stability; raises ValueError where it does not."""
    sp = plant.sp_signals[0]

    def growth(cv: float) -> float:
        return float(plant.linearize(*plant.steady_state_at(cv)).eigenvalues[0].real)

    cv = float(optimize.brentq(growth, 0.9 * sp.high, 1.02 * sp.high, xtol=1e-12))
    return cv, float(plant.steady_state_at(cv)[1][0])


def rekindling_flow(plant: EquationPlant) -> float:
    """The coolant flow [l/min] below which the reactor cannot stay gone out: the least steady flow of that branch.

    At temperature T the concentration is steady at C = 1/(1 + (V/q) K0 exp(-(E/R)/T)) C_f; what coolant
    then holds T is the steady flow, and the branch gone out ends where that is least.
    """
    of = dict(zip(plant.parameter_names(), plant.parameters(), strict=True))

    def flow(t: float) -> float:
        c = of["C_f"] / (1 + of["V"] / of["q"] * of["K0"] * np.exp(-of["E_R"] / t))

        def growth(q_c: float) -> float:
            return float(np.array(plant.rate([c, t], [q_c], [], plant.parameters()))[1, 0])

        return float(optimize.brentq(growth, 1e-3, 1e3))

    return float(optimize.minimize_scalar(flow, bounds=(of["T_f"] + 5.0, of["T_f"] + 40.0), method="bounded").fun)


def _second_point(evidence: Evidence) -> CheckOutcome:
    ours = evidence.measured(SET, "", "operating_points.2.q_c")
    measured = f"q_c = {ours:.3f} l/min at T = 442 K, C as printed"
    return CheckOutcome(measured, abs(ours - PRINTED_QC_2) <= ROUNDED, "from the plant's own balances")


def _ahead(evidence: Evidence) -> CheckOutcome:
    errors = {test: [evidence.figure(c.law, test, "iae", c.setting) for c in (GAINS, PID_1)] for test in TESTS}
    measured = {
        test: (ours, single) for test, (ours, single) in errors.items() if ours is not None and single is not None
    }
    if not measured:
        raise NotMeasuredError
    shown = ", ".join(f"{test} {number(ours)} : {number(single)}" for test, (ours, single) in measured.items())
    wins = [test for test, (ours, single) in measured.items() if ours < single]
    beside = [
        f"{words} {number(iae)} with a gain margin of {number(margin)}"
        for words, curve in MARGINS
        if (iae := evidence.figure(curve.law, "up", "iae", curve.setting)) is not None
        and (margin := evidence.figure(curve.law, "", "gain_margin", curve.setting)) is not None
    ]
    because = f"ahead on {', '.join(wins) or 'none'}" + (f"; on up, {', '.join(beside)}" if beside else "")
    return CheckOutcome(f"IAE network : PID 1 alone, {shown}", 2 * len(wins) > len(measured), because)


def _ziegler_nichols(evidence: Evidence) -> CheckOutcome:
    """Whether proportional feedback has an ultimate gain on the local models, and what the sampling makes of it."""
    plant = evidence.case.equations
    points = (evidence.part(SET, SET).get("operating_points") or {}).values()
    lins = [plant.linearize(*plant.steady_state_at(float(p["C"]))) for p in points]
    if not lins:
        raise NotMeasuredError
    stable = all(np.linalg.eigvals(lin.a - ULTIMATE * lin.b @ lin.c[:1]).real.max() < 0 for lin in lins)
    sampled = [ultimate_gain(lin, plant.period_s) for lin in lins]
    measured = (
        f"in continuous time every gain up to {ULTIMATE:.0e} is stable at all {len(lins)} points"
        if stable
        else "some gain is unstable in continuous time"
    )
    because = f"only the sampling makes an ultimate gain: {', '.join(f'{k:,.0f}' for k in sampled)}"
    return CheckOutcome(measured, not stable, because)


def ultimate_gain(lin: Linearization, period_s: float) -> float:
    """The proportional gain at which the sampled loop of a linearization is no longer stable; raises ValueError."""
    phi, gamma = lin.sampled(period_s)

    def beyond(log_gain: float) -> float:
        return float(np.abs(np.linalg.eigvals(phi - 10**log_gain * gamma @ lin.c[:1])).max()) - 1.0

    return float(10 ** optimize.brentq(beyond, 1.0, np.log10(ULTIMATE)))


# ---------------------------------------------------------------- acceptance
def _fits(evidence: Evidence) -> CheckOutcome:
    fits = {name: evidence.measured(SET, "", f"staircase.{name}") for name in FITS}
    shown = ", ".join(f"{name[-1]} {v:.2f} %" for name, v in fits.items())
    return CheckOutcome(shown, all(fits[name] >= v for name, v in FITS.items()))


def _analyses(evidence: Evidence, figure: str, *curves: Curve) -> dict[str, float]:
    """A figure of the laws' analyses, by law."""
    return {curve.law: evidence.measured(curve, "", figure) for curve in curves}


def _radius(evidence: Evidence) -> CheckOutcome:
    radii = _analyses(evidence, "frozen_radius", *BOTH)
    return CheckOutcome(", ".join(f"{law} {v:.4f}" for law, v in radii.items()), max(radii.values()) <= RADIUS)


def _pairs(evidence: Evidence) -> CheckOutcome:
    proved, pairs = (_analyses(evidence, figure, AUTO, GAINS) for figure in ("lyapunov_pairs", "neighbour_pairs"))
    shown = ", ".join(f"{law} {proved[law]:.0f} of {pairs[law]:.0f}" for law in pairs)
    return CheckOutcome(shown, proved[AUTO.law] == pairs[AUTO.law])


def _recovered(evidence: Evidence) -> CheckOutcome:
    recovered, starts, left = (_analyses(evidence, figure, *BOTH) for figure in ("recovered", "starts", "left_range"))
    shown = ", ".join(f"{law} {recovered[law]:.0f} of {starts[law]:.0f}" for law in starts)
    out = "gone out: " + ", ".join(f"{law} {v:.0f}" for law, v in left.items())
    return CheckOutcome(shown, all(recovered[law] >= RECOVERED * starts[law] for law in starts), out)


def _gone_out(evidence: Evidence) -> CheckOutcome:
    """The state in which the reaction has gone out is shown: no law of this case ends it."""
    states = _analyses(evidence, "states_of_no_return", *BOTH)
    plant, mv = evidence.case.equations, evidence.case.plant_class.mv_signals[0]
    because = (
        f"there the law asks for the least {mv.name}, {mv.low:g} {mv.unit}; to take fire again by itself the reactor "
        f"needs less than {rekindling_flow(plant):.1f} {mv.unit}"
    )
    return CheckOutcome(
        ", ".join(f"{law} {v:.0f}" for law, v in states.items()), set(states.values()) == {1.0}, because
    )


def _in_order(evidence: Evidence) -> CheckOutcome:
    """One knob is ahead of PID 1, and none of PIDs 2 to 5 holds the whole range as PID 1 does."""
    knob, first, *others = (
        [evidence.measured(curve, test, "iae") for test in TESTS[:3]] for curve in (AUTO, PID_1, *ALONE)
    )
    least = [min(of_test) for of_test in zip(*others, strict=True)]
    rows = list(zip(knob, first, least, strict=True))
    shown = ", ".join(f"{number(a)} : {number(b)} : {number(c)}" for a, b, c in rows)
    each = "; ".join(f"PID {i}: {', '.join(number(v) for v in row)}" for i, row in enumerate(others, start=2))
    return CheckOutcome(shown, all(a < b < c for a, b, c in rows), each)


CLAIMS = Claims(
    reason=plain_reason,
    statements=(
        Check("only a small overshoot at C = 0.13", _overshoot),
        Check("the network matches the plant with high accuracy", _accuracy),
        Check("five local models are the best tradeoff", _five),
        Check("stable for C below 0.13566 and q_c below 110.8", _hopf),
        Check("the second operating point has q_c = 98.899", _second_point),
        Check("the network is ahead of a single PID", _ahead),
        Check("the local PIDs are from Ziegler-Nichols' ultimate gain", _ziegler_nichols),
    ),
    acceptance=(
        Check("local model network, staircase fit", _fits, ", ".join(f"{n[-1]} ≥ {v:g} %" for n, v in FITS.items())),
        Check("frozen spectral radius over C", _radius, f"< {RADIUS:g}"),
        Check("neighbour pairs with a common quadratic Lyapunov function", _pairs, f"all, for {AUTO.law}"),
        Check("Monte Carlo starts that recovered", _recovered, f"≥ {100 * RECOVERED:g} % for each"),
        Check("states from which the loop does not return", _gone_out, "shown: 1, the reaction gone out"),
        Check("one knob : PID 1 alone : least of PIDs 2 to 5 alone, IAE on up, down and the jump", _in_order, "rising"),
        step_within(80.0, *(curve.law for curve in BOTH)),
        faster_than_nmpc(20.0, "up", "set points up", *(curve.law for curve in BOTH)),
    ),
)
