"""Statistics of a loop: the control error, shares of time, and how well the next PVs are foreseen."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.manifest import Manifest, Signal
from loopwright.serving.monitor.cusum import ANY, COUNT, SIGN, SIZE_RANGE, Chart, KeepsState, Kept

# ------------------------------------------------------------- mean squares of errors over blocks, by their logarithms
Array: TypeAlias = NDArray[np.float64]

LEAST_SIGMA = 0.2  # of the logarithm of a block's mean square: a smaller scatter is not believed
LEAST_SQUARE = 1e-18  # of a range: the error of a plant without noise
MOST_LOG = 700.0  # whose exponential is still a number


def log_mean_square(sums: Array, count: int | Array) -> Array:
    """log(sums / count) of the sums (n,) of the squares of ``count`` errors, which are shares of their ranges.

    ``count`` is one for all, or (n,).
    """
    return np.asarray(np.log(sums / count + LEAST_SQUARE))


def rms_ratio(shift: float) -> float:
    """By how many times a root mean square is larger whose logarithm of the mean square lies ``shift`` higher."""
    return exp(min(shift / 2, MOST_LOG))


# ------------------------------------------------------------------------------------- the linear model that is learnt

PAST_PV, PAST_MV = 2, 5  # samples that it looks back
SQUARES = 1000  # scans over which squares of errors are averaged
START_VARIANCE = 100.0  # variance of its numbers before it has learnt


class OnlineArx(KeepsState):
    """y(k+1) = theta' phi(k), phi = [y(k), y(k-1), mv(k), ..., mv(k-4), 1], all of their ranges.

    By recursive least squares, until ``freeze``. y are all PVs.
    """

    KEPT: ClassVar[Kept] = {"theta": ANY, "p": ANY, "scans": COUNT, "square": SIZE_RANGE, "frozen": ANY}

    def __init__(self, manifest: Manifest) -> None:
        m = manifest
        self._low_y, self._span_y = ranges(m.pv)
        self._low_u, self._span_u = ranges(m.mv)
        self.n_y, self.n_u = len(m.pv), len(m.mv)
        self.n_phi = PAST_PV * self.n_y + PAST_MV * self.n_u + 1
        self.theta, self.p = np.zeros((self.n_phi, self.n_y)), START_VARIANCE * np.eye(self.n_phi)
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

    def add(self, pv: Array, mv: Array, fresh: Array | None = None) -> tuple[Array, Array] | None:
        """One scan: (phi of the scan before, errors (n_pv,) of what it foresaw); None right after a gap.

        ``fresh`` (n_pv,), 1 or 0, says which numbers are new readings; None: all are. The others stand in for what is
        not known, and have no error.
        """
        y, past = (pv - self._low_y) / self._span_y, self._past
        told = None
        if self._filled >= PAST_MV:
            error = y - past @ self.theta
            if fresh is not None:
                error = error * fresh
            told = past, error
            if not self.frozen:
                self._learn(past, error, fresh)
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

    def _learn(self, phi: Array, error: Array, fresh: Array | None) -> None:
        p_phi = self.p @ phi
        gain = (p_phi / (1.0 + phi @ p_phi))[:, None]
        self.theta = self.theta + gain * error
        self.p = self.p - gain * p_phi
        self.scans += 1
        # Errors of a model that is still wild say nothing of its noise.
        change = (error**2 - self.square) / max(min(self.scans, SQUARES), 20)
        self.square = self.square + (change if fresh is None else change * fresh)


def ranges(signals: Sequence[Signal]) -> tuple[Array, Array]:
    """(low ends, widths) of signals, each (n,)."""
    low = np.array([s.low for s in signals])
    return low, np.array([s.high for s in signals]) - low


# ---------------------------------------------------------------------------------------- the errors of the law itself


class Foresight(KeepsState):
    """Errors of ``next_<PV>`` of a law's info for each controlled variable, in blocks of ``block`` scans.

    The logarithm of each block's mean square goes into a chart upwards. ``told``: whether the law tells it at all.
    """

    KEPT: ClassVar[Kept] = {"sums": SIZE_RANGE, "count": COUNT, "chart": ANY, "readings": COUNT}
    LATER = frozenset({"readings"})

    def __init__(self, manifest: Manifest, *, block: int, learn: int, weekly: float, rate: float) -> None:
        m = manifest
        n_cv = self.n_cv = len(m.sp)
        names = [f"next_{s.name}" for s in m.pv[:n_cv]]
        self._places = [m.info.index(n) for n in names] if all(n in m.info for n in names) else []
        self.told = bool(self._places)
        self.block = block
        self._span = ranges(m.pv)[1][:n_cv]
        self.sums, self.count, self.readings = np.zeros(n_cv), 0, np.zeros(n_cv)  # readings: new ones of each
        self.chart = Chart(n_cv, learn, weekly=weekly, rate=rate / n_cv, least=LEAST_SIGMA, both=False)
        self._expected: Array | None = None

    def forget(self) -> None:
        """The samples before a gap say nothing of the next."""
        self._expected = None

    def recall(self, memory: Any) -> None:
        """Take them back; of an older release, which counted no readings, without its present block."""
        super().recall(memory)
        if "readings" not in memory:
            self.sums, self.count = np.zeros(self.n_cv), 0

    def add(self, pv: Array, info: Array | None, time_s: float, fresh: Array | None = None) -> Array | None:
        """One scan: PVs (n_pv,) and the law's info. The errors (n_cv,) of what it expected, of their ranges.

        Those without a new reading (``fresh`` (n_pv,) 0) have none. A block that has no reading of a variable goes on;
        once it has learnt, such a variable counts as what it was at first.
        """
        if not self.told:
            return None
        error = None
        if self._expected is not None:
            new = np.ones(self.n_cv) if fresh is None else fresh[: self.n_cv]
            error = new * (pv[: self.n_cv] - self._expected) / self._span
            self.sums = self.sums + error**2
            self.count += 1
            self.readings = self.readings + new
            if self.count >= self.block and (self.readings.all() or self.chart.learnt):
                figures = log_mean_square(self.sums, np.maximum(self.readings, 1.0))
                self.chart.add(np.where(self.readings > 0, figures, self.chart.mean), time_s)
                self.sums, self.count, self.readings = np.zeros(self.n_cv), 0, np.zeros(self.n_cv)
        self._expected = None if info is None else info[self._places]
        return error

    def ratio(self, i: int) -> float:
        """The root mean square error of late over that of the time in which it learnt."""
        return rms_ratio(self.chart.shift(i))


# --------------------------------------------------------------------------------------------------- the control error

# intervals between crossings that regularity needs: ten of noise and loads are regular by chance
REGULAR_INTERVALS = 20
ORDER = 15  # of the error's autoregressive model
LEAST_VARIANCE = 1e-12  # variance of the error up to which the index is 1: a larger one is divided by


class Swing(KeepsState):
    """Zero crossings of an error, and how regular they are.

    Regularity r = mean / (3 standard deviation) of the last ``REGULAR_INTERVALS`` intervals between crossings; above 1
    the error swings. A crossing counts once the error was beyond a band of ``band`` on the other side.

    Source: Thornhill, Huang, Zhang, "Detection of multiple oscillations in control loops", J. Process Control 13
    (2003) 91.
    """

    KEPT: ClassVar[Kept] = {
        "side": SIGN,
        "since": COUNT,
        "intervals": COUNT,
        "largest": SIZE_RANGE,
        "amplitudes": SIZE_RANGE,
    }

    def __init__(self, band: float) -> None:
        self.band = band
        self.forget()

    def forget(self) -> None:
        """The samples that follow have nothing to do with those before."""
        self.side, self.since, self.largest = 0, 0, 0.0
        self.intervals: list[int] = []
        self.amplitudes: list[float] = []

    def add(self, error: float, scans: int = 1) -> None:
        """One reading, ``scans`` scans after the one before it."""
        self.since += scans
        self.largest = max(self.largest, abs(error))
        side = 1 if error > self.band else -1 if error < -self.band else 0
        if side and side != self.side:
            if self.side:
                self.intervals = [*self.intervals, self.since][-REGULAR_INTERVALS:]
                self.amplitudes = [*self.amplitudes, self.largest][-REGULAR_INTERVALS:]
            self.side, self.since, self.largest = side, 0, 0.0
        if self.intervals and self.since > 5 * max(self.intervals):
            self.intervals, self.amplitudes = [], []  # it has stopped

    def regularity(self) -> float:
        """r; 0 as long as there are too few crossings."""
        if len(self.intervals) < REGULAR_INTERVALS:
            return 0.0
        spread = float(np.std(self.intervals))
        return min(float(np.mean(self.intervals)) / (3 * spread), 100.0) if spread else 100.0

    def period(self) -> float:
        """Scans of a whole swing."""
        return 2 * float(np.mean(self.intervals)) if self.intervals else 0.0

    def amplitude(self) -> float:
        """Mean of the largest errors between crossings."""
        return float(np.mean(self.amplitudes)) if self.amplitudes else 0.0


def harris_index(errors: Array, first: int) -> float:
    """Share of an error's variance that no controller could remove within its first answer, 0 .. 1.

        eta = var(w) sum_{i < first} f(i)^2 / var(e)

    with f the impulse response of the autoregressive model A(q) e(k) = w(k) (Yule-Walker, ``ORDER``). One is minimum
    variance; small: there is something to win. A move shows after ``first`` samples, one more than the dead time.

    Source: Harris, "Assessment of control loop performance", Can. J. Chem. Eng. 67 (1989) 856; by AR models:
    Desborough and Harris, the same journal 70 (1992) 1186.
    """
    e = errors - errors.mean()
    n = len(e)
    r = np.array([e[: n - i] @ e[i:] for i in range(ORDER + 1)]) / n
    if r[0] <= LEAST_VARIANCE:
        return 1.0
    toeplitz = r[np.abs(np.subtract.outer(np.arange(ORDER), np.arange(ORDER)))] + 1e-9 * r[0] * np.eye(ORDER)
    a = np.linalg.solve(toeplitz, r[1:])
    noise = max(float(r[0] - a @ r[1:]), 0.0)
    f = [1.0]
    for i in range(1, first):
        f.append(sum(a[j] * f[i - 1 - j] for j in range(min(i, ORDER))))
    return float(min(noise * np.sum(np.square(f)) / r[0], 1.0))


# ----------------------------------------------------------------- shares of time: saturated, in HOLD, at a rate limit
class Share(KeepsState):
    """A share of the last ``memory`` scans, and what it was when ``learn`` scans had been seen.

    share(k) = share(k-1) + (x(k) - share(k-1)) / min(k, memory)
    """

    KEPT: ClassVar[Kept] = {"value": SIZE_RANGE, "first": ANY, "count": COUNT}

    def __init__(self, learn: int, memory: int) -> None:
        self.learn, self.memory_scans = learn, memory
        self.value = 0.0
        self.first = -1.0  # not known yet
        self.count = 0

    def add(self, x: float) -> None:
        """One scan: whether, as 0 or 1; or any figure that is to be averaged."""
        self.count += 1
        self.value += (x - self.value) / min(self.count, self.memory_scans)
        if self.count == self.learn:
            self.first = self.value

    @property
    def learnt(self) -> bool:
        """Whether it has seen enough."""
        return self.count >= self.learn

    @property
    def done(self) -> float:
        """How much of that it has seen, from 0 to 1."""
        return min(self.count / self.learn, 1.0)


# ----------------------------------------------------------------------------------------------- a law's own estimates


def estimated(info: tuple[str, ...]) -> list[int]:
    """Places of the info entries that estimate what the model does not explain."""
    return [i for i, n in enumerate(info) if n.startswith("load_") or n.endswith("offset") or n == "disturbance"]


class Estimates(KeepsState):
    """The mean square of each estimate over blocks of ``block`` scans: its logarithm goes into a chart."""

    KEPT: ClassVar[Kept] = {"sums": SIZE_RANGE, "count": COUNT, "chart": ANY}

    def __init__(self, info: tuple[str, ...], *, block: int, learn: int, weekly: float, rate: float) -> None:
        self.block = block
        self.places = estimated(info)
        self.names = [info[i] for i in self.places]
        n = len(self.places)
        self.chart = Chart(n, learn, weekly=weekly, rate=rate / max(n, 1), least=LEAST_SIGMA)
        self.sums, self.count = np.zeros(n), 0

    def add(self, info: Array | None, time_s: float) -> None:
        """One scan's info."""
        if info is None or not self.places:
            return
        self.sums = self.sums + info[self.places] ** 2
        self.count += 1
        if self.count >= self.block:
            self.chart.add(log_mean_square(self.sums, self.count), time_s)
            self.sums, self.count = np.zeros(len(self.places)), 0
