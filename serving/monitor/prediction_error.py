"""How well the next PVs are foreseen: by the law itself, and by a linear model that is learnt beside it."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.monitor.cusum import Chart
from loopwright.serving.monitor.learning import ANY, COUNT, SIZE, Kept, Remembers

# ------------------------------------------------------------- mean squares of errors over blocks, by their logarithms
Array: TypeAlias = NDArray[np.float64]

LEAST_SIGMA = 0.2  # of the logarithm of a block's mean square: a smaller scatter is not believed
LEAST_SQUARE = 1e-18  # of a range: the error of a plant without noise
MOST_LOG = 700.0  # whose exponential is still a number


def log_mean_square(sums: Array, count: int) -> Array:
    """log(sums / count) of the sums (n,) of the squares of ``count`` errors, which are shares of their ranges."""
    return np.asarray(np.log(sums / count + LEAST_SQUARE))


def rms_ratio(shift: float) -> float:
    """By how many times a root mean square is larger whose logarithm of the mean square lies ``shift`` higher."""
    return exp(min(shift / 2, MOST_LOG))


# ------------------------------------------------------------------------------------- the linear model that is learnt

PAST_PV, PAST_MV = 2, 5  # samples that it looks back
SQUARES = 1000  # scans over which squares of errors are averaged
DOUBT = 100.0  # variance of its numbers before it has learnt


class BesideModel(Remembers):
    """y(k+1) = theta' phi(k), phi = [y(k), y(k-1), mv(k), ..., mv(k-4), 1], all of their ranges.

    By recursive least squares, until ``freeze``. y are all PVs.
    """

    KEPT: ClassVar[Kept] = {"theta": ANY, "p": ANY, "scans": COUNT, "square": SIZE, "frozen": ANY}

    def __init__(self, manifest: Manifest) -> None:
        m = manifest
        self._low_y, self._span_y = ranges(m.pv)
        self._low_u, self._span_u = ranges(m.mv)
        self.n_y, self.n_u = len(m.pv), len(m.mv)
        self.n_phi = PAST_PV * self.n_y + PAST_MV * self.n_u + 1
        self.theta, self.p = np.zeros((self.n_phi, self.n_y)), DOUBT * np.eye(self.n_phi)
        self.scans, self.frozen = 0, False
        self.square = np.zeros(self.n_y)  # mean square of its errors while it learnt
        self._past = np.zeros(self.n_phi)
        self._past[-1] = 1.0
        n_y, n_u, first = self.n_y, self.n_u, PAST_PV * self.n_y  # where each entry of the next phi stands in this one
        self._older = np.arange(self.n_phi)
        self._older[n_y:first] -= n_y
        self._older[first + n_u : -1] -= n_u
        self._filled = 0
        self._basis: Array | None = None

    def forget(self) -> None:
        """The samples before a gap say nothing of the next."""
        self._filled = 0

    def add(self, pv: Array, mv: Array) -> tuple[Array, Array] | None:
        """One scan: (phi of the scan before, errors (n_pv,) of what it foresaw); None right after a gap."""
        y, past = (pv - self._low_y) / self._span_y, self._past
        told = None
        if self._filled >= PAST_MV:
            error = y - past @ self.theta
            told = past, error
            if not self.frozen:
                self._learn(past, error)
        first = PAST_PV * self.n_y
        self._past = past[self._older]
        self._past[: self.n_y] = y
        self._past[first : first + self.n_u] = (mv - self._low_u) / self._span_u
        self._filled += 1
        return told

    def freeze(self) -> None:
        """It has learnt enough."""
        self.frozen, self._basis = True, None

    @property
    def basis(self) -> Array:
        """W (n_phi, n_phi): over the learning time the entries of W' phi were uncorrelated with mean square 1."""
        if self._basis is None:
            values, vectors = np.linalg.eigh(self.p * max(self.scans, 1))
            self._basis = vectors * np.sqrt(np.maximum(values, 1e-12))
        return self._basis

    def _learn(self, phi: Array, error: Array) -> None:
        p_phi = self.p @ phi
        gain = (p_phi / (1.0 + phi @ p_phi))[:, None]
        self.theta = self.theta + gain * error
        self.p = self.p - gain * p_phi
        self.scans += 1
        # Errors of a model that is still wild say nothing of its noise.
        self.square = self.square + (error**2 - self.square) / max(min(self.scans, SQUARES), 20)


def ranges(signals: Sequence[Signal]) -> tuple[Array, Array]:
    """(low ends, widths) of signals, each (n,)."""
    low = np.array([s.low for s in signals])
    return low, np.array([s.high for s in signals]) - low


# ---------------------------------------------------------------------------------------- the errors of the law itself


class Foresight(Remembers):
    """Errors of ``next_<PV>`` of a law's info for each controlled variable, in blocks of ``block`` scans.

    The logarithm of each block's mean square goes into a chart upwards. ``told``: whether the law tells it at all.
    """

    KEPT: ClassVar[Kept] = {"sums": SIZE, "count": COUNT, "chart": ANY}

    def __init__(self, manifest: Manifest, *, block: int, learn: int, weekly: float, rate: float) -> None:
        m = manifest
        n_cv = self.n_cv = len(m.sp)
        names = [f"next_{s.name}" for s in m.pv[:n_cv]]
        self._places = [m.info.index(n) for n in names] if all(n in m.info for n in names) else []
        self.told = bool(self._places)
        self.block = block
        self._span = ranges(m.pv)[1][:n_cv]
        self.sums, self.count = np.zeros(n_cv), 0
        self.chart = Chart(n_cv, learn, weekly=weekly, rate=rate / n_cv, least=LEAST_SIGMA, both=False)
        self._expected: Array | None = None

    def forget(self) -> None:
        """The samples before a gap say nothing of the next."""
        self._expected = None

    def add(self, pv: Array, info: Array | None, time_s: float) -> Array | None:
        """One scan: PVs (n_pv,) and the law's info. The errors (n_cv,) of what it expected, of their ranges."""
        if not self.told:
            return None
        error = None
        if self._expected is not None:
            error = (pv[: self.n_cv] - self._expected) / self._span
            self.sums = self.sums + error**2
            self.count += 1
            if self.count >= self.block:
                self.chart.add(log_mean_square(self.sums, self.count), time_s)
                self.sums, self.count = np.zeros(self.n_cv), 0
        self._expected = None if info is None else info[self._places]
        return error

    def ratio(self, i: int) -> float:
        """The root mean square error of late over that of the time in which it learnt."""
        return rms_ratio(self.chart.shift(i))
