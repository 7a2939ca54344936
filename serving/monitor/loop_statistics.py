"""Statistics of a loop: the control error, shares of time, and the law's own estimates of its model's error."""

from __future__ import annotations

from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from loopwright.serving.monitor.cusum import Chart
from loopwright.serving.monitor.learning import ANY, COUNT, SIGN, SIZE, Kept, Remembers
from loopwright.serving.monitor.prediction_error import LEAST_SIGMA, log_mean_square

# --------------------------------------------------------------------------------------------------- the control error
Array: TypeAlias = NDArray[np.float64]

CROSSINGS = 20  # intervals between crossings that regularity needs: ten of noise and loads are regular by chance
ORDER = 15  # of the error's autoregressive model
LEAST = 1e-12


class Swing(Remembers):
    """Zero crossings of an error, and how regular they are.

    Regularity r = mean / (3 standard deviation) of the last ``CROSSINGS`` intervals between crossings; above 1 the
    error swings. A crossing counts once the error was beyond a band of ``band`` on the other side.

    Source: Thornhill, Huang, Zhang, "Detection of multiple oscillations in control loops", J. Process Control 13
    (2003) 91.
    """

    KEPT: ClassVar[Kept] = {"side": SIGN, "since": COUNT, "intervals": COUNT, "largest": SIZE, "amplitudes": SIZE}

    def __init__(self, band: float) -> None:
        self.band = band
        self.forget()

    def forget(self) -> None:
        """The samples that follow have nothing to do with those before."""
        self.side, self.since, self.largest = 0, 0, 0.0
        self.intervals: list[int] = []
        self.amplitudes: list[float] = []

    def add(self, error: float) -> None:
        """One scan."""
        self.since += 1
        self.largest = max(self.largest, abs(error))
        side = 1 if error > self.band else -1 if error < -self.band else 0
        if side and side != self.side:
            if self.side:
                self.intervals = [*self.intervals, self.since][-CROSSINGS:]
                self.amplitudes = [*self.amplitudes, self.largest][-CROSSINGS:]
            self.side, self.since, self.largest = side, 0, 0.0
        if self.intervals and self.since > 5 * max(self.intervals):
            self.intervals, self.amplitudes = [], []  # it has stopped

    def regularity(self) -> float:
        """r; 0 as long as there are too few crossings."""
        if len(self.intervals) < CROSSINGS:
            return 0.0
        spread = float(np.std(self.intervals))
        return min(float(np.mean(self.intervals)) / (3 * spread), 100.0) if spread else 100.0

    def period(self) -> float:
        """Scans of a whole swing."""
        return 2 * float(np.mean(self.intervals)) if self.intervals else 0.0

    def amplitude(self) -> float:
        """Mean of the largest errors between crossings."""
        return float(np.mean(self.amplitudes)) if self.amplitudes else 0.0


def harris_index(errors: Array, dead: int) -> float:
    """Share of an error's variance that no controller could remove for the dead time of ``dead`` samples, 0 .. 1.

    With the autoregressive model A(q) e(k) = w(k) (Yule-Walker, ``ORDER``) and its impulse response f:
    eta = var(w) sum_{i < dead} f(i)^2 / var(e). One is minimum variance; small: there is something to win.

    Source: Harris, "Assessment of control loop performance", Can. J. Chem. Eng. 67 (1989) 856; by AR models:
    Desborough and Harris, the same journal 70 (1992) 1186.
    """
    e = errors - errors.mean()
    n = len(e)
    r = np.array([e[: n - i] @ e[i:] for i in range(ORDER + 1)]) / n
    if r[0] <= LEAST:
        return 1.0
    toeplitz = r[np.abs(np.subtract.outer(np.arange(ORDER), np.arange(ORDER)))] + 1e-9 * r[0] * np.eye(ORDER)
    a = np.linalg.solve(toeplitz, r[1:])
    noise = max(float(r[0] - a @ r[1:]), 0.0)
    f = [1.0]
    for i in range(1, dead):
        f.append(sum(a[j] * f[i - 1 - j] for j in range(min(i, ORDER))))
    return float(min(noise * np.sum(np.square(f)) / r[0], 1.0))


# ----------------------------------------------------------------- shares of time: saturated, in HOLD, at a rate limit
class Share(Remembers):
    """A share of the last ``memory`` scans, and what it was when ``learn`` scans had been seen.

    share(k) = share(k-1) + (x(k) - share(k-1)) / min(k, memory)
    """

    KEPT: ClassVar[Kept] = {"value": SIZE, "first": ANY, "count": COUNT}

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


class Estimates(Remembers):
    """The mean square of each estimate over blocks of ``block`` scans: its logarithm goes into a chart."""

    KEPT: ClassVar[Kept] = {"sums": SIZE, "count": COUNT, "chart": ANY}

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
