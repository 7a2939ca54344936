"""PID settings from a linearized plant: IMC, SIMC, ITAE, and the IMC filter that is best in closed loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import floor, inf

import numpy as np
from numpy.typing import NDArray

from loopwright.pipeline.errors import LawError
from loopwright.pipeline.plants.simulator import Array
from loopwright.pipeline.plants.steady import Linearization
from loopwright.pipeline.tuning.reduction import LagWithDeadTime, minimal

LONGEST_FILTER = 40.0  # periods; an IMC filter is looked for between half a period and this
RULE_ROUNDING = 1e-9  # of a period: no part of a dead time


@dataclass(frozen=True, slots=True)
class PidSettings:
    """Settings of the ideal PID  Kc (b r - y + 1/(Ti s) (r - y) - Td s/(Tf s + 1) y).

    Raises LawError for numbers with which it would not act, or act wrongly.
    """

    kc: float  # [mv/pv]
    ti_s: float
    td_s: float = 0.0
    filter_s: float = 0.0  # Tf
    set_point_weight: float = 1.0  # b
    tracking_s: float | None = None  # time constant of the anti-windup; None: see ``tracking_time_s``

    def __post_init__(self) -> None:
        for name, allowed, words in (
            ("kc", 0 < abs(self.kc) < inf, "finite and not 0, or the PID does nothing"),
            ("ti_s", self.ti_s > 0, "above 0 s"),
            ("td_s", 0 <= self.td_s < inf, "0 s or above, and finite"),
            ("filter_s", 0 <= self.filter_s < inf, "0 s or above, and finite"),
            ("set_point_weight", 0 <= self.set_point_weight < inf, "0 or above, and finite"),
            ("tracking_s", self.tracking_s is None or self.tracking_s > 0, "above 0 s"),
        ):
            if not allowed:
                raise LawError(f"{name} of the PID is {getattr(self, name)}; it must be {words}")

    @property
    def tracking_time_s(self) -> float:
        """Time constant with which the request follows a saturated actuator.

        sqrt(Ti Td), and Ti without a derivative: shorter than the integral's, longer than the
        derivative's, so that neither a saturated integral nor a kick of the derivative decides.
        Source: Astrom and Hagglund, Advanced PID Control, section 3.5.
        """
        if self.tracking_s is not None:
            return self.tracking_s
        return float(np.sqrt(self.ti_s * self.td_s)) if self.td_s > 0 else self.ti_s


@dataclass(frozen=True, slots=True)
class AllPole:
    """The transfer function G(s) = b0 exp(-theta s) / prod(s - p_i)."""

    b0: float
    poles: NDArray[np.complex128]  # largest real part first
    dead_time_s: float = 0.0  # theta

    @classmethod
    def of(cls, lin: Linearization, pv: int = 0, mv: int = 0, *, dead_time_s: float = 0.0) -> AllPole:
        """G from one MV to one PV of a linearized plant behind a dead time; poles that zeros cancel are not counted.

        Raises LawError where G has a finite zero or more than two poles: the tuning rules of this
        file do not hold there.
        """
        small = minimal(lin, pv, mv)
        a, b, c = small.a, small.b[:, 0], small.c[0]
        n = len(a)
        markov = [float(c @ np.linalg.matrix_power(a, k) @ b) for k in range(n)]
        size = np.linalg.norm(c) * np.linalg.norm(b)
        if n > 2 or any(abs(m) > 1e-9 * size * np.linalg.norm(a) ** k for k, m in enumerate(markov[:-1])):
            raise LawError(
                f"IMC and SIMC need one or two poles and no zero; the linearized plant has {n} poles and the Markov "
                f"parameters {', '.join(f'{m:.3g}' for m in markov)}: choose tuning {_applicable(small)}"
            )
        values = np.linalg.eigvals(a).astype(np.complex128)
        return cls(markov[-1], values[np.argsort(-values.real)], dead_time_s)

    @classmethod
    def near(cls, lin: Linearization, pv: int = 0, mv: int = 0) -> AllPole | LagWithDeadTime:
        """G as ``of`` gives it; of another stable plant a lag, or a lag with dead time, that resembles it.

        The lag has the initial slope and the final gain of the step response. Where these differ in sign
        (an inverse response) or the slope is zero (dead time, a chain of lags), it is the lag with dead
        time of ``LagWithDeadTime.of``. For tunings that are then judged in closed loop over the plant itself.

        Raises LawError where neither resembles the plant, and where it is not stable.
        """
        try:
            return cls.of(lin, pv, mv)
        except LawError as error:
            refused = error
        small = minimal(lin, pv, mv)
        if small.eigenvalues[0].real >= 0:
            raise refused
        slope = float(small.c[0] @ small.b[:, 0])
        try:
            gain = -float(small.c[0] @ np.linalg.solve(small.a, small.b[:, 0]))
        except np.linalg.LinAlgError:  # a pole at zero but for rounding
            raise refused from None
        size = float(np.linalg.norm(small.c[0]) * np.linalg.norm(small.b[:, 0]))
        if slope * gain > 0 and abs(slope) > 1e-9 * size:
            return cls(slope, np.array([-slope / gain + 0j]))
        try:
            return LagWithDeadTime.of(small)
        except LawError:
            raise refused from None


def _applicable(small: Linearization) -> str:
    """The tunings that a linearized plant of least order has when IMC and SIMC do not hold for it, in words."""
    try:
        LagWithDeadTime.of(small)
    except LawError:
        return "`manual`"
    return "`optimized` or `itae`, which take it for a lag with dead time"


def imc_pid(process: AllPole | LagWithDeadTime, lambda_s: float) -> PidSettings:
    """The PID that internal model control gives for one or two poles without zeros, or for a lag with dead time.

        C = G^-1 f / (1 - f),   f = 1/(lambda s + 1)  or, with one pole p > 0,
        f = (alpha s + 1)/(lambda s + 1)^2,   alpha = lambda^2 p + 2 lambda

    For an unstable plant f(p) = 1, which alpha ensures, makes 1 - f cancel the pole, as internal
    stability demands: 1 - f = lambda^2 s (s - p)/(lambda s + 1)^2. The rest is a PID exactly:

        poles p > 0 > -1/tau:   Kc = (1 + alpha/tau)/(b0 lambda^2),  Ti = alpha + tau,  Td = alpha tau/(alpha + tau)
        two stable poles:       Kc = a1/(b0 (lambda + theta)),  Ti = a1/a0,  Td = 1/a1,  of s^2 + a1 s + a0

    and a PI for one pole; theta is the dead time before stable poles, taken as exp(-theta s) = 1 - theta s.
    For the lag with dead time k exp(-theta s)/(tau s + 1), with the dead time as its first-order Pade approximation:

        Kc = (tau + theta/2)/(k (lambda + theta/2)),  Ti = tau + theta/2,  Td = tau theta/(2 tau + theta)

    Raises LawError for two poles that are not stable, and for a dead time before one.

    Source: [inverse_rbf, section 4.3] names the procedure; the filter for
    unstable plants is the textbook's (Morari and Zafiriou, Robust Process Control). The lag with dead
    time: Rivera, Morari and Skogestad, Internal Model Control: PID Controller Design, 1986, table 2.
    """
    if not lambda_s > 0:
        raise LawError(f"lambda_s is {lambda_s}; the IMC filter's time constant must be above 0")
    if isinstance(process, LagWithDeadTime):
        half, tau = process.dead_time_s / 2, process.tau_s
        kc = (tau + half) / (process.gain * (lambda_s + half))
        return PidSettings(kc, ti_s=tau + half, td_s=tau * half / (tau + half))
    b0, poles = process.b0, process.poles
    unstable = [float(p.real) for p in poles if p.real >= 0]
    if len(unstable) > 1:
        raise LawError(
            f"IMC gives no PID for two poles in the right half plane ({poles[0]:.3g}, {poles[1]:.3g}); use `manual`"
        )
    if not unstable:
        slower_s = lambda_s + process.dead_time_s
        if len(poles) == 1:
            p = float(poles[0].real)
            return PidSettings(kc=1 / (b0 * slower_s), ti_s=-1 / p)
        a1, a0 = float(-(poles[0] + poles[1]).real), float((poles[0] * poles[1]).real)
        return PidSettings(kc=a1 / (b0 * slower_s), ti_s=a1 / a0, td_s=1 / a1)
    if process.dead_time_s:
        raise LawError(
            f"IMC gives no PID for an unstable plant with a dead time of {process.dead_time_s:.3g} s; use `manual`"
        )
    alpha = lambda_s**2 * unstable[0] + 2 * lambda_s
    if len(poles) == 1:
        return PidSettings(kc=alpha / (b0 * lambda_s**2), ti_s=alpha)
    tau = -1 / float(poles[1].real)
    return PidSettings(kc=(1 + alpha / tau) / (b0 * lambda_s**2), ti_s=alpha + tau, td_s=alpha * tau / (alpha + tau))


def simc_pid(process: AllPole, period_s: float, tau_c_s: float | None = None) -> PidSettings:
    """Skogestad's rule for a stable plant with real poles; half a period of sampling counts as dead time.

        series form  Kc = tau1/(k (tau_c + theta)),  tauI = min(tau1, 4 (tau_c + theta)),  tauD = tau2
        ideal form   Kc (1 + tauD/tauI),  Ti = tauI + tauD,  Td = tauI tauD/(tauI + tauD)

    theta is the plant's dead time and half a period. ``tau_c_s`` is the wanted closed-loop time constant; None
    takes tau_c = theta + period, tight but with a sample to spare. Two poles need no half rule: a PID holds both
    time constants.

    Raises LawError for poles that are unstable or complex.

    Source: Skogestad, Simple analytic rules for model reduction and PID controller tuning, 2003.
    """
    poles = process.poles
    if np.any(poles.real >= 0) or np.any(np.abs(poles.imag) > 1e-9 * np.abs(poles)):
        shown = ", ".join(f"{p:.3g}" for p in poles)
        raise LawError(f"SIMC needs stable real poles; the plant has {shown} here: choose `imc` or another point")
    taus = -1 / poles.real
    gain = process.b0 / float(np.prod(-poles.real))
    theta = process.dead_time_s + period_s / 2
    closed = theta + (theta + period_s if tau_c_s is None else tau_c_s)
    tau1, tau_d = float(taus[0]), float(taus[1]) if len(taus) > 1 else 0.0
    kc, tau_i = tau1 / (gain * closed), min(tau1, 4 * closed)
    return PidSettings(kc=kc * (1 + tau_d / tau_i), ti_s=tau_i + tau_d, td_s=tau_i * tau_d / (tau_i + tau_d))


def itae_pid(process: LagWithDeadTime, period_s: float, sampling: float = 0.5) -> PidSettings:
    """The PID with the least time-weighted absolute error after a set-point step, for a lag with dead time.

        Kc = 0.965/k (theta/tau)^-0.855,  Ti = tau/(0.796 - 0.147 theta/tau),  Td = 0.308 tau (theta/tau)^0.9292

    with theta the process's dead time and, for the sampling, ``sampling`` periods: half of one, as
    an MV held over a period lags by that much. A lag without a dead time of its own then has a
    sampled loop near its limit of stability; a whole period leaves a margin. Fitted for theta/tau
    from 0.1 to 1. Raises LawError where theta/tau is so large that Ti has no meaning.

    Source: Rovira, Murrill and Smith, 1969, as in Smith and Corripio, Principles and Practice of
    Automatic Process Control, 2nd ed., section 7-4.3; the half period is theirs too (section 7-4.4).
    """
    theta, tau = process.dead_time_s + sampling * period_s, process.tau_s
    ratio = theta / tau
    if not 0 < 0.147 * ratio < 0.796:
        raise LawError(
            f"the ITAE rule is for dead times above 0 and up to the time constant ({tau:.3g} s); here {theta:.3g} s, "
            f"of it {sampling * period_s:.3g} s for the sampling: take another period, or tuning `imc`, `simc` or "
            "`optimized`"
        )
    return PidSettings(
        kc=0.965 / process.gain * ratio**-0.855,
        ti_s=tau / (0.796 - 0.147 * ratio),
        td_s=0.308 * tau * ratio**0.9292,
    )


def sampled_loop(lin: Linearization, settings: PidSettings, period_s: float, late: float = 0.0) -> Array:
    """The matrix that takes [dx, mv, y, d, earlier mv] of the sampled closed loop one period on, set point at rest.

    ``late``: periods of dead time before the plant, whole or not, for which so many earlier MVs are kept, the latest
    first. The loop is stable where all eigenvalues lie inside the unit circle.
    """
    whole, part, kept = _periods(late)
    phi, gamma = lin.sampled(period_s)
    n, h, s = len(phi), period_s, settings
    columns = []
    for state in np.eye(n + 3 + kept):
        x, mv, y1, d1, line = state[:n], state[n], state[n + 1], state[n + 2], state[n + 3 :]
        y = float(lin.c[0] @ x)
        d = (s.filter_s * d1 + s.td_s * (y - y1)) / (s.filter_s + h)
        mv = mv + s.kc * (-(y - y1) - h / s.ti_s * y - (d - d1))
        line = np.concatenate([[mv], line])
        acting = line[whole] if not part else (1 - part) * line[whole] + part * line[whole + 1]
        columns.append(np.concatenate([phi @ x + gamma[:, 0] * acting, [mv, y, d], line[:kept]]))
    return np.array(columns).T


def _periods(late: float) -> tuple[int, float, int]:
    """(whole periods of a dead time, the part of one beyond them, earlier MVs that they need); rounding is no part."""
    whole = floor(late + RULE_ROUNDING)
    part = max(0.0, late - whole)
    part = 0.0 if part < RULE_ROUNDING else part
    return whole, part, whole + bool(part)


def peak_sensitivity(lin: Linearization, settings: PidSettings, period_s: float, late: float = 0.0) -> float:
    """Largest |1/(1 + C G)| of the sampled loop over frequency; infinite where the loop is unstable.

    1/peak is the distance of the loop's Nyquist curve from -1: 1.4 is cautious, 2 is tight. ``late``: as for
    ``sampled_loop``.
    """
    if not _settles(lin, settings, period_s, late):
        return inf
    return float(_peaks(lin, [settings], period_s, late)[0])


def _settles(lin: Linearization, settings: PidSettings, period_s: float, late: float) -> bool:
    return bool(np.abs(np.linalg.eigvals(sampled_loop(lin, settings, period_s, late))).max() < 1)


def _peaks(lin: Linearization, tried: Sequence[PidSettings], period_s: float, late: float) -> Array:
    """Largest |1/(1 + C G)| over frequency of each loop (n,), as if all were stable."""
    (phi, gamma), (whole, part, _) = lin.sampled(period_s), _periods(late)
    z = np.exp(1j * np.geomspace(1e-4, np.pi, 400))
    resolvent = np.linalg.solve(
        z[:, None, None] * np.eye(len(phi)) - phi, np.broadcast_to(gamma, (len(z), *gamma.shape))
    )
    g, back = (lin.c[0] @ resolvent)[:, 0] * (z**-whole * (1 - part + part / z)), 1 - 1 / z
    found = []
    for s in tried:
        derivative = s.td_s * back / (s.filter_s * back + period_s)
        loop = s.kc * (1 + period_s / s.ti_s / back + derivative) * g
        found.append(np.abs(1 / (1 + loop)).max())
    return np.array(found)


def longest_filter(process: AllPole | LagWithDeadTime, period_s: float) -> float:
    """Periods of the longest IMC filter that is looked at; one much shorter than the dead time has no margin."""
    return max(LONGEST_FILTER, 3 * process.dead_time_s / period_s)


def robust_imc(lin: Linearization, period_s: float, peak: float = 2.0, *, dead_time_s: float = 0.0) -> PidSettings:
    """IMC with the shortest filter whose sampled loop keeps its peak sensitivity at ``peak`` or below.

    ``dead_time_s``: before the plant. Where no filter does, the one with the smallest peak. Raises LawError where no
    filter stabilizes.
    """
    process, lin = AllPole.of(lin, dead_time_s=dead_time_s), minimal(lin)
    late, longest = dead_time_s / period_s, longest_filter(process, period_s)
    tried = [imc_pid(process, float(v)) for v in np.geomspace(0.5, longest, 90) * period_s]
    peaks = _peaks(lin, tried, period_s, late)
    # Eigenvalues cost the cube of a dead time: only those are asked that can be the first.
    later = [i for i in peaks.argsort(kind="stable").tolist() if peaks[i] > peak]
    for i in (*np.flatnonzero(peaks <= peak).tolist(), *later):
        if _settles(lin, tried[i], period_s, late):
            return tried[i]
    raise LawError(
        f"no IMC filter from {0.5 * period_s:g} to {longest * period_s:g} s stabilizes the sampled loop; "
        "shorten the period or tune by hand (`manual`)"
    )


def optimized_imc(
    process: AllPole | LagWithDeadTime,
    period_s: float,
    cost: Callable[[Sequence[PidSettings]], Array],
    base: PidSettings,
    *,
    optimize_weight: bool = True,
) -> PidSettings:
    """IMC with the filter, and the set-point weight if wanted, that cost least in closed loop.

    ``cost`` takes candidates to their costs (infinite where the loop breaks), all at once: a
    closed loop runs about as fast for fifty of them as for one. A coarse grid, then a finer one
    around its best: the cost of a nonlinear loop has steps and many minima, so no descent.
    ``base`` gives what IMC does not choose: ``filter_s``, ``tracking_s``, and the set-point weight
    where that is not optimized. Raises LawError where every candidate's cost is infinite.
    """

    def cheapest(filters: Array, weights: Sequence[float]) -> tuple[float, PidSettings]:
        rows = []
        for value in filters:
            imc = replace(imc_pid(process, float(value)), filter_s=base.filter_s, tracking_s=base.tracking_s)
            rows += [(float(value), replace(imc, set_point_weight=b)) for b in weights]
        costs = cost([settings for _, settings in rows])
        best = int(costs.argmin())
        if not np.isfinite(costs[best]):
            raise LawError("no IMC filter gave a finite closed loop; check the MV's range or tune by hand (`manual`)")
        return rows[best]

    coarse = np.geomspace(0.8, longest_filter(process, period_s), 12) * period_s
    at, first = cheapest(coarse, (0.3, 0.6, 1.0) if optimize_weight else (base.set_point_weight,))
    ratio = float(np.sqrt(coarse[1] / coarse[0]))
    weight = first.set_point_weight
    around = (weight - 0.2, weight - 0.1, weight, weight + 0.1) if optimize_weight else (weight,)
    return cheapest(np.geomspace(at / ratio, at * ratio, 7), around)[1]
