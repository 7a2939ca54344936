"""A plant as tuning rules want it: without states that do not count, or as lags, with or without dead time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from loopwright.pipeline.dynamics.step_response import CV_ANSWERED, first_change
from loopwright.pipeline.errors import LawError, PlantError
from loopwright.pipeline.plants.simulator import Array, Simulator
from loopwright.pipeline.plants.steady import Linearization

RANK = 1e-8  # singular values of the Hankel matrix below this share of the largest are rounding
NO_RESPONSE = 1e-14  # a largest one below this share of |C| |B| is nothing at all
DIFFERENCE = 1e-4  # of a signal's size: the step of the central differences
LAG_OVERSHOOT = 0.02  # of its end, by which an answer swings beyond it: no lags do
LONGEST_ANSWER = 20  # mean residence times in which an answer ends
START_AT_REST = 1e-6  # of a state's size: what the start may move in one period and count as at rest


def minimal(lin: Linearization, pv: int = 0, mv: int = 0) -> Linearization:
    """From one MV to one PV, with the states alone that both see: a linearization of least order.

    The Markov parameters h_k = C A^k B fill the Hankel matrix H_ij = h_(i+j), whose rank is the
    least order; with its singular value decomposition U S V' a realization of that order is

        A = S^-1/2 U' H' V S^-1/2,   B = S^1/2 V' e_1,   C = e_1' U S^1/2,   H'_ij = h_(i+j+1)

    They do not depend on the units of the states. Time is counted in units of the fastest mode.
    A linearization that is of least order comes back as it is, but for the other PVs and MVs.

    Raises LawError where the MV does not act on the PV.

    Source: Ho and Kalman, Regelungstechnik 14 (1966), 545.
    """
    b, c, n = lin.b[:, mv : mv + 1], lin.c[pv : pv + 1], len(lin.a)
    rate = float(np.abs(np.linalg.eigvals(lin.a)).max()) or 1.0
    unit_a = lin.a / rate
    markov = np.array([float((c @ np.linalg.matrix_power(unit_a, k) @ b)[0, 0]) for k in range(2 * n)])
    at = np.arange(n)[:, None] + np.arange(n)
    u, s, vt = np.linalg.svd(markov[at])
    if not s[0] > NO_RESPONSE * float(np.linalg.norm(c) * np.linalg.norm(b)):
        raise LawError("the MV does not act on the controlled variable of the linearized plant; check the pairing")
    order = int((s > RANK * s[0]).sum())
    if order == n:
        return Linearization(lin.x, lin.mv, lin.a, b, c)
    root = np.sqrt(s[:order])
    left, right = u[:, :order] / root, vt[:order].T / root
    return Linearization(
        np.zeros(order),
        lin.mv,
        rate * (left.T @ markov[at + 1] @ right),
        (root * vt[:order, 0])[:, None],
        (u[0, :order] * root)[None, :],
    )


@dataclass(frozen=True, slots=True)
class LagWithDeadTime:
    """The transfer function k exp(-theta s) / (tau s + 1)."""

    gain: float  # k [pv/mv]
    tau_s: float
    dead_time_s: float

    @classmethod
    def of(cls, lin: Linearization, pv: int = 0, mv: int = 0, *, dead_time_s: float = 0.0) -> Self:
        """The lag whose impulse response has the area, the mean and the variance of the plant's.

            k = G(0),   theta + tau = -G'(0)/G(0),   tau^2 = G''(0)/G(0) - (theta + tau)^2

        ``dead_time_s``, of the plant before its linearization, is added to theta. Exact for a lag; never a negative
        dead time. Raises LawError for an unstable plant, and for one whose impulse response has no variance above 0
        (it oscillates or changes its sign).

        Source: Astrom and Hagglund, Advanced PID Control, section 2.4 (method of moments).
        """
        small = minimal(lin, pv, mv)
        worst = float(small.eigenvalues[0].real)
        if worst >= 0:
            raise LawError(
                f"a lag with dead time needs a stable plant; this one has a pole at {worst:.3g} 1/s here: choose "
                "another operating_cv, or tuning `imc`"
            )
        # G(s) = C (s I - A)^-1 B and its derivatives at s = 0
        first = np.linalg.solve(small.a, small.b)
        second = np.linalg.solve(small.a, first)
        third = np.linalg.solve(small.a, second)
        gain, slope, bend = (float((small.c @ v)[0, 0]) for v in (-first, -second, -2 * third))
        mean = -slope / gain if gain else float("nan")
        variance = bend / gain - mean**2 if gain else float("nan")
        if not (variance > 0 and mean > 0):
            raise LawError(
                f"no lag with dead time has this plant's moments (gain {gain:.3g}, mean {mean:.3g} s, variance "
                f"{variance:.3g} s2); choose tuning `optimized` or `manual`"
            )
        tau = min(float(np.sqrt(variance)), mean)
        return cls(gain, tau, mean - tau + dead_time_s)


def start_lags(plant: Simulator) -> tuple[Linearization, float]:
    """One or two lags, and a dead time [s] before them, that resemble the plant near its start, first MV to CV.

        r(k) = 1 - y(k)/K,   T = h sum_k r(k) - h/2,   S = 2 h^2 sum_k k r(k) - T^2,
        C = 3 h^3 sum_k k^2 r(k) - 3 T S - T^3
        G(s) = K exp(-theta s) / ((t1 s + 1) (t2 s + 1)),   t1 + t2 = T - theta,   t1^2 + t2^2 = S,   t1^3 + t2^3 = C/2

    y is the response to a unit step of the MV, K its end, h the period; it follows from central differences of
    ``step`` and ``measure``. T, S and C are the first three cumulants of the residence times: the first two do not
    tell a dead time from a lag. Where C is too small for two lags (a chain of them), they are equal; theta is at least
    the time in which the CV does not answer at all, and no more where its answer overshoots, as no lags do. Where the
    smaller lag would be below h/2, there is one lag. Raises PlantError where the start is not at rest or not stable,
    or the CV does not follow the MV.

    Source: Astrom and Hagglund, Advanced PID Control, section 2.4 (method of moments), with one moment more.
    """
    x0, mv0 = (np.asarray(v, dtype=np.float64) for v in plant.start)
    dv, p, h = plant.dv_nominal, plant.parameters(), plant.period_s
    size = np.maximum(np.abs(x0), 1e-3 * max(1.0, float(np.abs(x0).max())))
    moved = np.abs(plant.step(x0, mv0, dv, p) - x0)
    remedy = "tune the controller by hand (`manual`), or give the plant's equations"
    if not (moved <= START_AT_REST * size).all():
        raise PlantError(
            f"plant {plant.name!r} is not at rest at its start: its state moves by up to {moved.max():.3g} in a period "
            f"with the MV held; give a start at rest, {remedy}"
        )
    span = DIFFERENCE * np.array([s.high - s.low for s in plant.mv_signals])
    phi = _slope(lambda x: plant.step(x, mv0, dv, p), x0, DIFFERENCE * size)
    low, high = (np.array([getattr(s, end) for s in plant.mv_signals]) for end in ("low", "high"))
    gamma = _slope(lambda mv: plant.step(x0, mv, dv, p), mv0, span, low, high)[:, 0]
    c = _slope(plant.measure, x0, DIFFERENCE * size)[0]
    radius = float(np.abs(np.linalg.eigvals(phi)).max())
    if not radius < 1 - 1e-6:
        raise PlantError(
            f"plant {plant.name!r} is not stable at its start (a sampled pole of size {radius:.6g}); {remedy}"
        )
    ends = np.linalg.inv(np.eye(len(phi)) - phi)
    rest = ends @ gamma
    gain = float(c @ rest)
    time_s = h * float(c @ ends @ rest) / gain - h / 2 if gain else 0.0
    if not time_s > 0:
        raise PlantError(
            f"plant {plant.name!r} is no lag at its start: gain {gain:.3g}, mean residence time {time_s:.3g} s; "
            f"{remedy}"
        )
    second = c @ phi @ ends @ ends @ rest / gain  # sum_k k r(k)
    third = 2 * c @ phi @ phi @ ends @ ends @ ends @ rest / gain + second  # sum_k k^2 r(k)
    variance = max(0.0, 2 * h**2 * float(second) - time_s**2)
    skew = 3 * h**3 * float(third) - 3 * time_s * variance - time_s**3
    answers, state = [], gamma
    for _ in range(max(len(phi), int(LONGEST_ANSWER * time_s / h) + 1)):
        answers.append(float(c @ state))
        state = phi @ state
    silent = int(first_change(np.array(answers), CV_ANSWERED))
    dead_s, seen_s = h * silent, time_s - _sum_of_two(variance, skew)
    # Less than half a period more is the sampling, or the error of a difference.
    if seen_s > dead_s + h / 2 and not (np.cumsum(answers) / gain).max() > 1 + LAG_OVERSHOOT:
        dead_s = seen_s
    dead_s = min(dead_s, max(time_s - h / 2, 0.0))  # of a dead time alone, the lag is that of a held MV
    left_s = time_s - dead_s
    apart = np.sqrt(max(0.0, variance / 2 - left_s**2 / 4))
    slow, fast = left_s / 2 + apart, left_s / 2 - apart
    if fast < h / 2:
        rate = np.array([[1 / left_s]])
        return Linearization(np.zeros(1), mv0[:1], -rate, gain * rate, np.eye(1)), dead_s
    a, b = np.array([[-1 / slow, 0.0], [1 / fast, -1 / fast]]), np.array([[gain / slow], [0.0]])
    return Linearization(np.zeros(2), mv0[:1], a, b, np.array([[0.0, 1.0]])), dead_s


def _sum_of_two(squares: float, twice_cubes: float) -> float:
    """t1 + t2 of the lags whose squares and, twice, whose cubes have these sums; of equal or one lag where none have.

    With s = (t1 + t2)/sqrt(t1^2 + t2^2), s^3 - 3 s + 2 c = 0 and c = (t1^3 + t2^3)/(t1^2 + t2^2)^1.5, 1/sqrt 2 to 1.
    """
    if not squares > 0:
        return 0.0
    cubes = float(np.clip(twice_cubes / (2 * squares**1.5), np.sqrt(0.5), 1.0))
    return float(np.sqrt(squares) * 2 * np.cos(np.arccos(-cubes) / 3))


def _slope(f: Callable[[Array], Array], at: Array, by: Array, low: ArrayLike = -inf, high: ArrayLike = inf) -> Array:
    """Central differences of ``f`` (m,) at ``at`` (n,), steps ``by`` (n,), one-sided at a limit; shape (m, n)."""
    ends = [(np.clip(at - d, low, high), np.clip(at + d, low, high)) for d in np.diag(by)]
    return np.column_stack([(f(above) - f(below)) / (above - below).sum() for below, above in ends])
